"""`thermocald run`, `dashboard`, `status` and `top`: the daemon, its page, and how it is doing."""

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

from thermocald.cli.commands import expert
from thermocald.cli.common import ConfigOption, JsonOption, require_config, say, show
from thermocald.errors import DataError, StoreError, UsageError
from thermocald.output.status_text import status_lines


def run(
    config: ConfigOption = None,
    mock: bool = typer.Option(
        False, "--mock", help="A rendered camera that warms up, and a thermometer."
    ),
    recording: Path | None = typer.Option(None, help="Play a recording instead of devices."),
    store: Path | None = typer.Option(None, help="The store; overrides the configuration."),
    epochs: int = typer.Option(0, min=0, help="End after so many epochs per camera; 0: never."),
    fast: bool = expert(
        False, "--fast", help="Play the recording as fast as it can be calibrated."
    ),
    hang_after: float = expert(
        60.0, min=0.5, help="Seconds after which a device that does not return hangs."
    ),
    dashboard: bool = typer.Option(False, "--dashboard", help="Show the web page too."),
) -> None:
    """Acquire, calibrate and keep epochs until told to end (Ctrl-C, SIGTERM).

    Example: thermocald run --config config.yaml
    """
    from thermocald.config import load_config
    from thermocald.daemon.plan import mock_config, recording_config
    from thermocald.daemon.service import Service
    from thermocald.daemon.systemd import set_up_logging
    from thermocald.hal import option_names

    if sum([config is not None, mock, recording is not None]) > 1:
        raise UsageError("give one of --config FILE, --mock, --recording FOLDER")
    if not mock and recording is None:
        config = require_config(config, "one of --config FILE, --mock, --recording FOLDER")
    if fast and recording is None:
        raise UsageError("--fast is for --recording: devices have their own pace")
    if config is not None:
        read = load_config(config, option_names)
    elif recording is not None:
        read = recording_config(recording)
    else:
        read = mock_config()
    if store is not None:
        read = read.model_copy(
            update={"store": read.store.model_copy(update={"path": store.absolute()})}
        )
    if dashboard:
        read = read.model_copy(
            update={"dashboard": read.dashboard.model_copy(update={"enabled": True})}
        )
    set_up_logging(read.logging.level)
    service = Service(
        read,
        config,
        fast=fast,
        epochs=epochs,
        until_finished=bool(epochs) or recording is not None,
        hang_after_s=hang_after,
    )
    released = service.run()
    if service.lost:
        say(f"error: {service.lost}")
    if not released:
        # a driver that hangs in the kernel would keep the interpreter from ending
        os._exit(1 if service.lost else 0)
    if service.lost:
        raise typer.Exit(1)


def dashboard(
    store: Path | None = typer.Option(None, help="The daemon's store."),
    live: Path | None = expert(None, help="The folder of the daemon's live state."),
    host: str = expert("127.0.0.1", help="Elsewhere than here needs --token-file."),
    port: int = expert(8437, min=1, max=65535),
    token_file: Path | None = expert(None, help="A file that holds the token."),
    name: list[str] | None = expert(None, help="A further name of the page; repeatable."),
    config: Path | None = typer.Option(
        None, "--config", "-c", help="All of these from a configuration."
    ),
) -> None:
    """Serve a daemon's web page, in a process of its own that only reads.

    With --config it ends at once where the configuration has `dashboard: {enabled: false}`.

    Example: thermocald dashboard --store thermocald.db
    """
    from thermocald.config import load_config
    from thermocald.daemon.live_state import find_state
    from thermocald.output.dashboard import serve

    names = name or []
    if config is not None:
        read = load_config(config)
        if not read.dashboard.enabled:
            say(f"{config}: dashboard.enabled is false; there is no page")
            return
        page = read.dashboard
        store = store or read.store.path
        host, port, token_file = page.host, page.port, page.token_file
        names = [*names, *page.names]
    if store is None:
        raise UsageError("give --store FILE or --config FILE")
    # with --config the page may be started before the daemon has made its store
    if config is None and live is None and not store.exists():
        raise StoreError(f"{store}: does not exist; give the store that the daemon writes")
    serve(store, live or find_state(store), host, port, token_file, names)


_DaemonConfig = Annotated[
    Path | None, typer.Option("--config", "-c", help="The daemon's configuration.")
]
StoreOption = Annotated[Path | None, typer.Option("--store", help="The daemon's store.")]


def status(
    config: _DaemonConfig = None, store: StoreOption = None, json: JsonOption = None
) -> None:
    """Say how the daemon is doing: cameras, thermometers, store.

    Exit status 1 if it does not run, if its store cannot be written, or if an epoch that it took is
    lost.

    Example: thermocald status --config /etc/thermocald/config.yaml
    """
    document = read_status(config, store)
    show(document, json, *status_lines(document))
    store_ = document["store"]
    if store_["lost"]:
        raise DataError(f"{store_['lost']} epochs were lost, taken and not kept")
    if store_["state"] == "out":
        raise DataError(f"the store cannot be written, {store_['waiting']} epochs wait in memory")


def top(
    config: _DaemonConfig = None,
    store: StoreOption = None,
    interval: float = typer.Option(1.0, min=0.2, help="Seconds between two updates."),
) -> None:
    """Show how the daemon is doing, always up to date; q or Ctrl-C ends it.

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
    from thermocald.config import load_config
    from thermocald.daemon.live_state import running_status

    if store is None:
        store = load_config(require_config(config, "--config FILE or --store FILE")).store.path
    return running_status(store)
