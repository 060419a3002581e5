"""Parts that the commands share: options, output, progress and log lines."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from thermocald import files
from thermocald.addresses import CleanFormatter, without_secrets
from thermocald.errors import UsageError
from thermocald.result import jsonable

if TYPE_CHECKING:
    from thermocald import ThermalCamera

CONFIG_PLACES = (Path("config.yaml"), Path("/etc/thermocald/config.yaml"))
_NOTICES = ("thermocald.output.dashboard", "thermocald.store.database.file")
_LINES = 10  # progress lines without a terminal


def say(text: str) -> None:
    """Print a line on standard error; standard output is for results.

    Secrets are removed, an absurdly long path is shortened. Control characters, which a file name
    may contain and a terminal would obey, are shown as codes.
    """
    text = re.sub(r"\S+", lambda word: files.shown(word[0]), printable(without_secrets(text)))
    try:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
    except BrokenPipeError:  # nobody reads it, which harms no result; nor what is left at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def printable(text: str) -> str:
    """Return the text with control characters, except line ends and tabs, written as codes."""
    return "".join(
        c if (c >= " " and not "\x7f" <= c <= "\x9f") or c in "\n\t" else f"\\x{ord(c):02x}"
        for c in text
    )


def log_to_stderr(level: str = "WARNING") -> None:
    """Send the program's log to standard error."""
    logging.basicConfig(level=level, stream=sys.stderr, force=True)
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_LogLine("%(levelname)s %(name)s: %(message)s"))
    for name in _NOTICES:  # for the user of the command; not a fault
        logging.getLogger(name).setLevel("INFO")


class _LogLine(CleanFormatter):
    """A log line: a notice is its message only; a warning or error has level and origin too."""

    def format(self, record: logging.LogRecord) -> str:
        notice = record.levelno == logging.INFO and record.name in _NOTICES
        return record.getMessage() if notice else super().format(record)


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that counts steps, shown as a bar on a terminal, else as some lines."""
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
    """Print the program's warnings as lines on standard error, each once."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(w.message) for w in caught):
        say(f"warning: {text}")


def require_config(given: Path | None, instead: str) -> Path:
    """Return the given configuration file, else ./config.yaml, else the system's.

    instead: what the message tells the user to give. Raises UsageError if there is none.
    """
    found = given or next((path for path in CONFIG_PLACES if path.exists()), None)
    if found is None:
        there = "there is neither ./config.yaml nor /etc/thermocald/config.yaml"
        raise UsageError(f"{there}; give {instead}")
    return found


def two_numbers(option: str, text: str, form: str, most: int = 999_999) -> tuple[int, int]:
    """Return the numbers of text such as 9x6, from 1 to `most`; UsageError that states the form."""
    found = re.fullmatch(r"([0-9]{1,6})[x×]([0-9]{1,6})", text.lower())
    first, second = map(int, found.groups()) if found else (0, 0)
    if not (0 < first <= most and 0 < second <= most):
        raise UsageError(f"{option} {text}: write {form}")
    return first, second


def write_json(document: Any, destination: str | None) -> None:
    """Write a JSON document to a file, to standard output for `-`, or not at all for None."""
    if destination is not None:
        text = json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n"
        write_parts((text,), destination)


def show(result: Any, json: str | None, *lines: object) -> None:
    """Write a command's result as `--json` says, and print lines, by default the result itself.

    Nothing is printed if the JSON document goes to standard output.
    """
    write_json(result, json)
    if json != "-":
        typer.echo("\n".join(map(str, lines or [result])))


def session_line(one: Mapping[str, Any]) -> str:
    """Return the line of a session's status."""
    why = f": {one['why']}" if one["why"] else ""
    start = f", {one['start']}" if one["start"] else ""
    taken = f"{one['taken']} of {one['epochs']} epochs"
    return f"{one['camera']}/{one['series']}{start}: {taken}, {one['state']}{why}"


def say_warning(camera: ThermalCamera) -> None:
    """Print a thermal camera's warning, after errors of options, which would hide in it."""
    if camera.warning:
        say(f"warning: {camera.warning}")


def write_parts(parts: Iterable[str], destination: str | Path) -> None:
    """Write a text in parts to a file, whole or not at all, or to standard output for `-`.

    Missing folders are created.
    """
    if str(destination) == "-":
        for part in parts:
            sys.stdout.write(part)
            sys.stdout.flush()  # its reader waits for each part
        return
    files.write_parts(Path(destination), parts)
