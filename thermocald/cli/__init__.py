"""The command line: one application with every command of `commands`.

Exit status: 0 done, 1 the data do not allow it, 2 wrong usage or configuration, 3 a device failed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import Annotated

# Small matrices: threads of the linear algebra would only wait for one another (30 × slower on two
# busy cores). It must be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from thermocald import __version__
from thermocald.atomic_file import cannot_write
from thermocald.cli.commands import COMMANDS, GROUPS, command, group
from thermocald.cli.common import log_to_stderr, say
from thermocald.errors import ThermocaldError

__all__ = ["application", "main"]

_INTERRUPTED = 130
_VERBOSE = ("--verbose", "-v")


def application(only: str | None = None) -> typer.Typer:
    """The application with every command, or with one of them: the others are not imported."""
    app = typer.Typer(
        help="Thermal calibration of low-cost cameras: live, with true standard deviations.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    for name in COMMANDS:
        if only in (None, name):
            app.command(name)(command(name))
    for name in GROUPS:
        if only in (None, name):
            app.add_typer(group(name), name=name)
    return app


def _called(arguments: list[str]) -> str | None:
    """The command that is called, None where all have to be known: a help, a wrong word."""
    word = next((word for word in arguments if word not in _VERBOSE), None)
    return word if word in COMMANDS or word in GROUPS else None


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Say the version and stop.", is_eager=True, callback=_say_version
        ),
    ] = False,
    verbose: Annotated[bool, typer.Option(*_VERBOSE, help="Log more.")] = False,
) -> None:
    del version  # said already, before a command is asked for
    log_to_stderr("INFO" if verbose else "WARNING")


def main() -> None:
    """Run the command line; every foreseen error is one line, none is a traceback."""
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, _end)  # so that nothing half-written stays
    try:
        application(_called(sys.argv[1:]))()
        sys.stdout.flush()
    except ThermocaldError as error:
        say(f"error: {error}")
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has gone, as `head` does.
        sys.stderr.close()
        sys.exit(0)
    except OSError as error:
        # a folder that may not be written, a full disk: wherever it shows first
        if error.filename is None and error.errno is None:
            raise
        failed = cannot_write(str(error.filename or "standard output"), error)
        what = error.strerror if isinstance(error.filename, str) and _is_read(error) else None
        say(f"error: {error.filename}: cannot be read: {what}" if what else f"error: {failed}")
        with contextlib.suppress(OSError):
            sys.stdout.close()  # else Python writes what is left in it again, and fails again
        sys.exit(failed.exit_status)


def _end(*_: object) -> None:
    sys.exit(128 + signal.SIGTERM)


def _is_read(error: OSError) -> bool:
    """Whether it is an input that is missing or may not be read."""
    return isinstance(error, FileNotFoundError) and not os.path.lexists(str(error.filename))
