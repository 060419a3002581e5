"""`thermocald status` and `thermocald top`: how the daemon is doing, in a terminal."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Annotated, Any

import typer

from thermocald.cli.common import default_config, write_result
from thermocald.cli.options import JsonOption
from thermocald.errors import DataError
from thermocald.output.status_text import status_lines

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="The daemon's configuration.")
]
StoreOption = Annotated[Path | None, typer.Option("--store", help="The daemon's store.")]


def status(config: ConfigOption = None, store: StoreOption = None, json: JsonOption = None) -> None:
    """How the daemon is doing: cameras, thermometers, store.

    Exit status 1 if it does not run, if its store cannot be written, or if an epoch that it took is
    lost.

    Example: thermocald status --config /etc/thermocald/config.yaml
    """
    document = read_status(config, store)
    if write_result(document, json):
        for line in status_lines(document):
            typer.echo(line)
    store_ = document["store"]
    if store_["lost"]:
        raise DataError(f"{store_['lost']} epochs were lost, taken and not kept")
    if store_["state"] == "out":
        raise DataError(f"the store cannot be written, {store_['waiting']} epochs wait in memory")


def top(
    config: ConfigOption = None,
    store: StoreOption = None,
    interval: Annotated[float, typer.Option(min=0.2, help="s.")] = 1.0,
) -> None:
    """The same, always up to date; q or Ctrl-C ends it.

    Example: thermocald top --store thermocald.db
    """
    from rich.console import Console, Group
    from rich.live import Live
    from rich.text import Text

    def picture() -> Group:
        head, *rest = status_lines(read_status(config, store))
        return Group(Text(head, style="bold"), *(Text(line) for line in rest))

    # A KeyboardInterrupt could be raised in a destructor, where Python only prints it.
    ended = Event()
    before = signal.signal(signal.SIGINT, lambda *_: ended.set())
    console = Console()
    try:
        if not console.is_terminal:
            while not ended.is_set():
                typer.echo("\n".join(status_lines(read_status(config, store))) + "\n")
                ended.wait(interval)
            return
        with keys() as pressed, Live(picture(), console=console, screen=False) as live:
            while not ended.is_set() and pressed(interval) not in ("q", "Q"):
                live.update(picture())
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def keys() -> Iterator[Callable[[float], str]]:
    """A function that waits for a key, s, and returns it or an empty string.

    Without a terminal to read from it only waits. The terminal is as it was before at the end.
    """
    if not sys.stdin.isatty():

        def waited(seconds: float) -> str:
            time.sleep(seconds)
            return ""

        yield waited
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def pressed(seconds: float) -> str:
        ready, _, _ = select.select([terminal], [], [], seconds)
        return os.read(terminal, 1).decode(errors="replace") if ready else ""

    try:
        tty.setcbreak(terminal)
        yield pressed
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def read_status(config: Path | None, store: Path | None) -> dict[str, Any]:
    from thermocald.daemon.live_state import running_status

    return running_status(_store(config, store))


def _store(config: Path | None, store: Path | None) -> Path:
    if store is not None:
        return store
    config = config or default_config()
    if config is None:
        raise DataError(
            "which daemon? there is neither ./config.yaml nor /etc/thermocald/config.yaml; give "
            "--config FILE or --store FILE"
        )
    from thermocald.config import load_config

    return load_config(config).store.path
