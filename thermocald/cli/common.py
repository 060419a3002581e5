"""What all commands share: where output goes, progress, and errors in one line."""

from __future__ import annotations

import json
import logging
import sys
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald import files
from thermocald.addresses import CleanFormatter, without_secrets
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from thermocald import ThermalCamera

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
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True)) as bar:
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


def default_config() -> Path | None:
    """The configuration where none is named: ./config.yaml, else the system's, None without."""
    return next((path for path in CONFIG_PLACES if path.exists()), None)


def write_json(document: Any, destination: str) -> None:
    """Write one JSON document to a file, or to standard output for `-`."""
    write_text(json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n", destination)


def write_result(document: Any, json: str | None) -> bool:
    """Write a command's result where `--json` says; whether standard output is free for lines."""
    if json is not None:
        write_json(document, json)
    return json != "-"


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
