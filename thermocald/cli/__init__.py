"""The command line: one application with every command of `commands`.

Exit status: 0 done, 1 the data do not allow it, 2 wrong usage or configuration, 3 a device failed.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
from typing import Any

# Small matrices: threads of the linear algebra would only wait for one another (30 × slower on two
# busy cores). It must be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from thermocald import __version__
from thermocald.cli.commands import COMMANDS, Group, add_commands
from thermocald.cli.common import log_to_stderr, say
from thermocald.errors import ThermocaldError
from thermocald.files import cannot_write

_INTERRUPTED = 130
_USAGE_ERROR: Any = typer.BadParameter.__base__  # of click, which Typer brings along
_VERBOSE = ("--verbose", "-v")


def application(loaded: str | None = None) -> typer.Typer:
    """Return the application with every command.

    loaded: the only one that is imported, "" for none; the others are listed.
    """
    app = typer.Typer(
        cls=Group,
        help="Thermal calibration of low-cost cameras: live, with true standard deviations.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    add_commands(app, lambda name: loaded in (None, name))
    return app


def _called() -> str:
    """Return the command that is called, "" where it is none: a help, a wrong word."""
    words = sys.argv
    if "_THERMOCALD_COMPLETE" in os.environ:  # a shell asks how it goes on
        typed = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
        words = typed.split()
    word = next((word for word in words[1:] if word not in _VERBOSE), "")
    return word if word in COMMANDS else ""


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


def _options(
    version: bool = typer.Option(
        False, "--version", help="Say the version and stop.", is_eager=True, callback=_say_version
    ),
    verbose: bool = typer.Option(False, *_VERBOSE, help="Log more."),
) -> None:
    del version  # said already, before a command is asked for
    log_to_stderr("INFO" if verbose else "WARNING")


def main() -> None:
    """Run the command line; every foreseen error is one line, none is a traceback."""
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, _end)  # so that nothing half-written stays
    _settle_process()
    try:
        status = application(_called())(prog_name="thermocald", standalone_mode=False)
        sys.stdout.flush()
        sys.exit(status or 0)
    except _USAGE_ERROR as error:
        sys.exit(_say_usage(error))
    except ThermocaldError as error:
        say(f"error: {error}")
        sys.exit(error.exit_status)
    except (KeyboardInterrupt, typer.Abort):
        say("interrupted")
        sys.exit(_INTERRUPTED)
    except UnicodeEncodeError as error:
        if error.encoding != "utf-8":
            raise
        # bytes of a file's name, which neither a server nor a library of C++ can be given
        say(f"error: {error.object[:200]}: is not UTF-8 text; choose another name")
        sys.exit(2)
    except BrokenPipeError:
        # The reader of our output has gone, as `head` does.
        sys.stderr.close()
        sys.exit(0)
    except OSError as error:
        # a folder that may not be written, a full disk: wherever it shows first
        if error.filename is None and error.errno is None:
            raise
        where = "its folder" if isinstance(error, FileNotFoundError) else "standard output"
        failed = cannot_write(str(error.filename or where), error)
        what = error.strerror if isinstance(error.filename, str) and _is_read(error) else None
        say(f"error: {error.filename}: cannot be read: {what}" if what else f"error: {failed}")
        with contextlib.suppress(OSError):
            sys.stdout.close()  # else Python writes what is left in it again, and fails again
        sys.exit(failed.exit_status)


def _say_usage(error: Any) -> int:
    """Say in one line what of the command was not understood; a help where nothing was typed."""
    status: int = error.exit_code
    command = "thermocald" if error.ctx is None else error.ctx.command_path
    said = error.format_message()
    if not said or "Usage:" in said:  # the whole help, where nothing was typed
        error.show()
        return status
    said = re.sub(r"^Invalid value for '([^']+)': (?:Input )?", r"\1: ", said)
    said = said[0].lower() + said[1:]
    say(f"error: {' '.join(said.split()).rstrip('.')}; see '{command} --help'")
    return status


def _settle_process() -> None:
    """Let no file be written by everybody, or read by nobody, and no output fail for its script."""
    given = os.umask(0o077)
    os.umask((given | 0o002) & ~0o700)
    # what was closed (`>&-`): no store may take its number, and a result for it is an error
    while (number := os.open(os.devnull, os.O_RDWR if sys.stderr is None else os.O_RDONLY)) < 3:
        pass
    os.close(number)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _end(*_: object) -> None:
    sys.exit(128 + signal.SIGTERM)


def _is_read(error: OSError) -> bool:
    """Whether it is an input that is missing or may not be read."""
    return isinstance(error, FileNotFoundError) and not os.path.lexists(str(error.filename))
