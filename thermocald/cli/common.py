"""What all commands share: options, where output goes, progress, and errors in one line."""

from __future__ import annotations

import functools
import inspect
import json
import logging
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald import files
from thermocald.addresses import CleanFormatter, without_secrets
from thermocald.cli.commands import expert
from thermocald.errors import UsageError
from thermocald.result import jsonable

if TYPE_CHECKING:
    from thermocald import ThermalCamera

JsonOption = Annotated[
    str | None, typer.Option("--json", help="Write the result as JSON; - for standard output.")
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="The configuration [./config.yaml, /etc/thermocald/config.yaml]."
    ),
]
StoreArgument = Annotated[Path | None, typer.Argument(help="The store; may be in use by a daemon.")]
PhotosArgument = Annotated[
    list[Path], typer.Argument(metavar="PHOTO…", help="Photographs, or folders of them.")
]
PixelPitchOption = Annotated[
    float | None, typer.Option("--pixel-pitch", help="Size of a pixel in mm.", min=1e-5, max=1.0)
]
LogOption = Annotated[Path, typer.Option("--log", help="A logger's file, a recording, or a store.")]
ModelOption = Annotated[Path, typer.Option("--model", help="The thermal model.")]
ExtrapolateOption = Annotated[
    bool, expert(..., "--extrapolate", help="Allow temperatures far outside the fit.")
]
SeedOption = Annotated[int, expert(..., "--seed", min=0, help="Seed of all random numbers.")]
TimezoneOption = Annotated[
    str | None,
    typer.Option("--timezone", help="Time zone of times without one: Europe/Berlin, UTC, +02:00."),
]
FreeOption = Annotated[
    str,
    expert(
        ...,
        "--free",
        help="Interior orientation to estimate, separated by commas; the rest is held.",
    ),
]
DEFAULT_FREE = "c,x0,y0,A1,A2,A3,B1,B2"
JobsOption = Annotated[
    int,
    expert(..., min=1, max=256, help="Number of processes; the results are the same to the bit."),
]
ExteriorOption = Annotated[
    str,
    typer.Option(
        "--exterior",
        help="per_epoch: every epoch has its own orientation; series: one for all epochs; mount: "
        "one and movements of the mount, whose size is estimated; auto: what the data show.",
    ),
]


def _log_options(
    timezone: TimezoneOption = None,
    temperature_column: list[str] | None = typer.Option(
        None, help="Column of a temperature; the first is the reference; repeatable."
    ),
    name: list[str] | None = typer.Option(
        None, metavar="COLUMN=LABEL", help="A label for a column of the log."
    ),
    unit: str | None = typer.Option(
        None, help="The log's unit where it does not say: degC, K, degF."
    ),
    date_order: str | None = expert(None, help="Which of 06/07/2026 is the day: dmy or mdy."),
    time_column: list[str] | None = expert(
        None, help="The log's column of times; twice for a date and a time."
    ),
    log_timezone: str | None = expert(None, help="The logger's time zone."),
    log_clock: str = expert("0", help="How far the logger's clock was ahead: +00:03:12."),
    ambiguous: str = expert(
        "order",
        help="The hour that comes twice in autumn: order (of rows), earlier, later, refuse.",
    ),
    separator: str | None = expert(None, help="Between the log's columns: ';' ',' tab."),
    decimal: str | None = expert(None, help="The log's decimal mark: , or ."),
) -> Any:
    """How a logger's file is to be read, wherever a command reads one."""
    said = locals()
    from thermocald.store.logger.temperatures import log_options

    return log_options(**said)


def takes(name: str, asked: Callable[..., Any]) -> Callable[[Callable[..., None]], Any]:
    """Give a command the options that a function asks for; it receives its result as `name`.

    Those that its own signature names it receives by themselves too.
    """
    more = inspect.signature(asked, eval_str=True).parameters

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters
        kept = [p for key, p in own.items() if key not in more and key != name]
        added = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in more.values()]

        @functools.wraps(command)
        def called(**given: Any) -> None:
            said = {key: given[key] if key in own else given.pop(key) for key in more}
            command(**given, **{name: asked(**said)})

        last = kept[-1].replace(kind=inspect.Parameter.KEYWORD_ONLY)
        called.__signature__ = inspect.Signature([*kept[:-1], *added, last])  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in [*kept, *added]}
        return called

    return decorate


takes_log_options = takes("log_options", _log_options)
CONFIG_PLACES = (Path("config.yaml"), Path("/etc/thermocald/config.yaml"))
_NOTICES = ("thermocald.output.dashboard", "thermocald.store.database.file")
_LINES = 10  # progress lines where there is no terminal


def say(text: str) -> None:
    """A line for a person, on standard error: standard output belongs to results.

    Control characters, which a file's name may hold and a terminal would obey, are shown as codes.
    """
    sys.stderr.write(printable(without_secrets(text)) + "\n")
    sys.stderr.flush()


def printable(text: str) -> str:
    """The text with control characters but line ends and tabs written as codes."""
    return "".join(
        c if (c >= " " and not "\x7f" <= c <= "\x9f") or c in "\n\t" else f"\\x{ord(c):02x}"
        for c in text
    )


def log_to_stderr(level: str = "WARNING") -> None:
    """Let the program's log be seen."""
    logging.basicConfig(level=level, stream=sys.stderr, force=True)
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_LogLine("%(levelname)s %(name)s: %(message)s"))
    for name in _NOTICES:  # said to whoever calls the command, and no fault
        logging.getLogger(name).setLevel("INFO")


class _LogLine(CleanFormatter):
    """A notice is its sentence; what is wrong has its level and where it comes from."""

    def format(self, record: logging.LogRecord) -> str:
        notice = record.levelno == logging.INFO and record.name in _NOTICES
        return record.getMessage() if notice else super().format(record)


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that counts steps: a bar on a terminal, some lines otherwise."""
    if sys.stderr.isatty():
        from rich import progress as rich
        from rich.console import Console

        columns = (rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeRemainingColumn())
        with rich.Progress("{task.description}", *columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(label, total=total)
            yield lambda steps: bar.advance(task, steps)
        return
    done, shown = 0, 0

    def advance(steps: int) -> None:
        nonlocal done, shown
        done += steps
        part = done * _LINES // total if total else done // 1000
        if part > shown:
            shown = part
            say(f"{label}: {done} of {total}" if total else f"{label}: {done}")

    yield advance


@contextmanager
def warnings_said() -> Iterator[None]:
    """Say warnings of the program as lines on standard error, each once."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(w.message) for w in caught):
        say(f"warning: {text}")


def require_config(given: Path | None, instead: str) -> Path:
    """The configuration that is named, else ./config.yaml, else the system's; UsageError for none.

    instead: what else may be given, for the message.
    """
    found = given or next((path for path in CONFIG_PLACES if path.exists()), None)
    if found is None:
        there = "there is neither ./config.yaml nor /etc/thermocald/config.yaml"
        raise UsageError(f"{there}; give {instead}")
    return found


def write_json(document: Any, destination: str | None) -> None:
    """Write one JSON document to a file, to standard output for `-`, for None nowhere."""
    if destination is not None:
        write_text(json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n", destination)


def show(result: Any, json: str | None, *lines: object) -> None:
    """Write a command's result where `--json` says, and print lines, by default the result itself.

    Nothing is printed where standard output is the document's.
    """
    write_json(result, json)
    if json != "-":
        typer.echo("\n".join(map(str, lines or [result])))


def warned(camera: ThermalCamera) -> ThermalCamera:
    """Return a thermal camera; what its user must know was said."""
    if camera.warning:
        say(f"warning: {camera.warning}")
    return camera


def write_text(text: str, destination: str | Path) -> None:
    """Write text to a file, whole or not at all, or to standard output for `-`.

    Folders that do not exist are made.
    """
    write_parts((text,), destination)


def write_parts(parts: Iterable[str], destination: str | Path) -> None:
    """Write a text that comes in parts, as `write_text` does."""
    if str(destination) == "-":
        for part in parts:
            sys.stdout.write(part)
            sys.stdout.flush()  # whoever reads it waits for it
        return
    files.write_parts(Path(destination), parts)
