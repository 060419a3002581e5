"""The command line: one application with all commands of `commands`.

Exit status: 0 done, 1 the data do not allow it, 2 wrong usage or configuration, 3 a device failed.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from typing import Any

# The matrices are small: threads of the linear algebra would only wait for one another (30 × slower
# on two busy cores). This has to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if "run" in sys.argv[1:3]:  # a reload must not end a daemon that is still being imported
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _interruptible:  # Ctrl-C during the imports ends the process, without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import typer

from thermocald import __version__
from thermocald.cli.commands import COMMANDS, Group, add_commands
from thermocald.cli.common import log_to_stderr, say
from thermocald.errors import ThermocaldError
from thermocald.files import cannot_write

if _interruptible:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_INTERRUPTED = 130
_USAGE_ERROR: Any = typer.BadParameter.__base__  # click's, which Typer depends on
_VERBOSE = ("--verbose", "-v")


def application(loaded: str | None = None) -> typer.Typer:
    """Return the application with all commands.

    loaded: the only command to import, "" for none; the others are only listed. None: all.
    """
    app = typer.Typer(
        cls=Group,
        help="Thermal calibration of low-cost cameras: live, with realistic standard deviations.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    add_commands(app, lambda name: loaded in (None, name))
    return app


def _command_name() -> str:
    """Return the name of the command to run, "" for a help or a word that is not a command."""
    words = sys.argv
    if "_THERMOCALD_COMPLETE" in os.environ:  # a shell asks for completions
        typed = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
        words = typed.split()
    word = next((word for word in words[1:] if word not in _VERBOSE), "")
    return word if word in COMMANDS else ""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


def _options(
    version: bool = typer.Option(
        False,
        "--version",
        help="Print the version and exit.",
        is_eager=True,
        callback=_print_version,
    ),
    verbose: bool = typer.Option(False, *_VERBOSE, help="Log information too, not only warnings."),
) -> None:
    del version  # its callback has printed it
    log_to_stderr("INFO" if verbose else "WARNING")


def main() -> None:
    """Run the command line; print every foreseen error in one line, without a traceback."""
    with contextlib.suppress(ValueError):  # raised outside the main thread
        # an exception, so that half-written files are removed; an alarm raises it again
        for number in (signal.SIGTERM, signal.SIGALRM):
            signal.signal(number, lambda *_: sys.exit(128 + signal.SIGTERM))
    sys.unraisablehook = _keep_exit
    _prepare_process()
    try:
        status = application(_command_name())(prog_name="thermocald", standalone_mode=False)
        sys.stdout.flush()
        sys.exit(status or 0)
    except _USAGE_ERROR as error:
        sys.exit(_print_usage_error(error))
    except ThermocaldError as error:
        say(f"error: {error}")
        sys.exit(error.exit_status)
    except (KeyboardInterrupt, typer.Abort):
        say("interrupted")
        sys.exit(_INTERRUPTED)
    except UnicodeEncodeError as error:
        if error.encoding != "utf-8":
            raise
        # a file name that is not UTF-8 can be passed neither to a server nor to a C++ library
        say(f"error: {error.object[:200]}: is not UTF-8 text; choose another name")
        sys.exit(2)
    except BrokenPipeError:
        # The reader of our output has closed the pipe, as `head` does; what is left goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(0)
    except OSError as error:
        # a folder without write permission or a full disk, wherever it is noticed first
        if error.filename is None and error.errno is None:
            raise
        where = "its folder" if isinstance(error, FileNotFoundError) else "standard output"
        failed = cannot_write(str(error.filename or where), error)
        text = str(failed)
        # outputs are tried before anything is computed: a file that is not there is an input
        if isinstance(error.filename, str) and not os.path.lexists(error.filename):
            closed = not os.access(os.path.dirname(error.filename) or ".", os.X_OK)
            if error.strerror and (closed or isinstance(error, FileNotFoundError)):
                text = f"{error.filename}: cannot be read: {error.strerror}"
        say(f"error: {text}")
        with contextlib.suppress(OSError):
            sys.stdout.close()  # otherwise Python flushes it at exit, and fails again
        sys.exit(failed.exit_status)


def _keep_exit(lost: Any) -> None:
    """Exit soon, if Python ignored that: in a destructor, or where pydantic builds a model."""
    if isinstance(lost.exc_value, SystemExit):
        signal.setitimer(signal.ITIMER_REAL, 0.05)
    else:
        sys.__unraisablehook__(lost)


def _print_usage_error(error: Any) -> int:
    """Print a usage error in one line, or the help for a group without a command."""
    # an option without its value has no context
    command = error.ctx.command_path if error.ctx else f"thermocald {_command_name()}".strip()
    message = error.format_message()
    if error.ctx and not error.ctx.parent and hasattr(error, "option_name"):
        message = f"{error.option_name}: write a command's options after its name"
    if not message or "Usage:" in message:  # a group without a command: the whole help
        error.show()
        return int(error.exit_code)
    if getattr(error, "param", None) and error.message:  # not of a value that is missing
        option, cause = max(error.param.opts, key=len), error.__cause__
        message = f"{option}: {error.message}"
        if hasattr(cause, "errors"):  # pydantic's, of a value that is no number
            from thermocald.config import in_words

            message = in_words(option, cause)
    message = message[0].lower() + message[1:]
    text = f"{' '.join(message.split()).rstrip('.')}; see '{command} --help'"
    say(f"error: {text.replace('?; see', '? See')}")  # Did you mean …?
    return int(error.exit_code)


def _prepare_process() -> None:
    """Set up the umask and the standard streams.

    New files are never writable by everybody and always accessible to their owner. A character that
    the output's encoding lacks is escaped.
    """
    given = os.umask(0o077)
    os.umask((given | 0o002) & ~0o700)
    # a stream closed by the shell (`>&-`): its number must not go to a store, and writing a result
    # to it must fail
    while (number := os.open(os.devnull, os.O_RDWR if sys.stderr is None else os.O_RDONLY)) < 3:
        pass
    os.close(number)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
