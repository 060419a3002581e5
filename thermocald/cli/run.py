"""`thermocald run`, `dashboard`, `status`, `top`, `check`, `devices` and `doctor`.

The status is written for 80 columns: one block per camera, because a table of its values would be
wider, and one line per other device. Long lines are wrapped, never cut off.
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli import options as opt
from thermocald.cli.commands import expert
from thermocald.cli.common import require_config, say, session_line, show
from thermocald.errors import DataError, DeviceError, StoreError, UsageError
from thermocald.names import WITH_VALUES
from thermocald.numbers import celsius, counted, duration, with_sd

if TYPE_CHECKING:
    from thermocald.config import Config

StoreOption = Annotated[Path | None, typer.Option("--store", help="The daemon's store.")]


def run(
    config: opt.Config = None,
    mock: bool = typer.Option(
        False, "--mock", help="Use a rendered camera that warms up, and a mock thermometer."
    ),
    recording: Path | None = typer.Option(None, help="Play back a recording instead of devices."),
    store: Path | None = typer.Option(None, help="The store; overrides the configuration."),
    epochs: int = typer.Option(0, min=0, help="Stop after this many epochs per camera; 0: never."),
    fast: bool = expert(False, "--fast", help="Play back as fast as epochs can be calibrated."),
    hang_after: float = expert(
        60.0, min=0.5, help="Seconds without an answer after which a device counts as hung."
    ),
    dashboard: bool = typer.Option(False, "--dashboard", help="Serve the web page too."),
) -> None:
    """Acquire, calibrate and store epochs until stopped (Ctrl-C, SIGTERM).

    Example: thermocald run --config config.yaml
    """
    from thermocald.config import load_config
    from thermocald.daemon.plan import mock_config, recording_config
    from thermocald.daemon.service import Service
    from thermocald.daemon.systemd import set_up_logging
    from thermocald.hal import load_driver
    from thermocald.store.server.connection import require_file

    if sum([config is not None, mock, recording is not None]) > 1:
        raise UsageError("give one of --config FILE, --mock, --recording FOLDER")
    if not mock and recording is None:
        config = require_config(config, "one of --config FILE, --mock, --recording FOLDER")

    def with_options(read: Config) -> Config:
        page = {"enabled": True} if dashboard else {}
        place = {} if store is None else {"path": require_file(store).absolute()}
        return read.model_copy(
            update={
                "store": read.store.model_copy(update=place),
                "dashboard": read.dashboard.model_copy(update=page),
            }
        )

    if config is not None:
        read = load_config(config, load_driver)
    elif recording is not None:
        read = recording_config(recording, store)
    else:
        read = mock_config()
    if epochs and not any(camera.series for camera in read.cameras):
        raise UsageError("--epochs: no camera of the configuration takes a series, so none counts")
    set_up_logging(read.logging.level)
    service = Service(
        with_options(read),
        config,
        with_options=with_options,
        fast=fast,
        epochs=epochs,
        until_finished=bool(epochs) or recording is not None,
        hang_after_s=hang_after,
    )
    released = service.run()
    for one in (faults := service.faults):
        say(f"error: {one}")
    if not released:
        # a driver that hangs in the kernel would keep the interpreter from exiting
        os._exit(1 if faults else 0)
    if faults:
        raise typer.Exit(1)


def dashboard(
    store: StoreOption = None,
    live: Path | None = expert(None, help="Folder of the daemon's live state."),
    host: str = expert("127.0.0.1", help="Address; other than loopback needs --token-file."),
    port: int = expert(8437, min=1, max=65535, help="Port to listen on."),
    token_file: Path | None = expert(None, help="File with the access token."),
    name: list[str] | None = expert(None, help="Further host name of the page; repeatable."),
    config: opt.StoreConfig = None,
) -> None:
    """Serve a daemon's web page from a separate process that only reads.

    With --config, the command exits at once if the configuration has `dashboard: {enabled: false}`.

    Example: thermocald dashboard --store thermocald.db
    """
    from thermocald.config import load_config
    from thermocald.daemon.live_state import find_state
    from thermocald.output.dashboard import serve
    from thermocald.store.server.connection import require_file
    from thermocald.store.sources import is_store

    names = name or []
    if config is not None:
        read = load_config(config)
        if not read.dashboard.enabled:
            say(f"{config}: dashboard.enabled is false; the page is not served")
            return
        page = read.dashboard
        store = store or read.store.path
        host, port, token_file = page.host, page.port, page.token_file
        names = [*names, *page.names]
    if store is None:
        raise UsageError("give --store FILE or --config FILE")
    # with --config the page may be started before the daemon has created its store
    if config is None and live is None and not is_store(require_file(store)):
        what = "is not a store" if store.exists() else "does not exist"
        raise StoreError(f"{store}: {what}; give the store that the daemon writes")
    serve(store, lambda: live or find_state(store), host, port, token_file, names)


def status(config: opt.Config = None, store: StoreOption = None, json: opt.Json = None) -> None:
    """Report the state of the daemon: cameras, thermometers, store.

    The exit status is 1 if the daemon does not run or has not answered for 30 s, if its store
    cannot be written, or if an epoch was taken but not stored.

    Example: thermocald status --config /etc/thermocald/config.yaml
    """
    document = read_status(config, store)
    show(document, json, *status_lines(document))
    store_ = document["store"]
    if store_["lost"]:
        raise DataError(f"{counted(store_['lost'], 'epoch')} lost: taken but not stored")
    if store_["state"] == "out":
        waiting = counted(store_["waiting"], "epoch")
        raise DataError(f"the store cannot be written; {waiting} waiting in memory")
    if (age := document["age_s"]) > _SILENT_S:
        why = "the daemon hangs, or its store's disk is read-only; look at its log"
        raise DataError(f"the status is {duration(age)} old: {why}")


def top(
    config: opt.Config = None,
    store: StoreOption = None,
    interval: float = typer.Option(1.0, min=0.2, help="Seconds between two updates."),
) -> None:
    """Show the state of the daemon, continuously updated; q or Ctrl-C ends it.

    Example: thermocald top --store thermocald.db
    """
    from rich.console import Console, Group
    from rich.live import Live
    from rich.text import Text

    def picture() -> Group:
        head, *rest = status_lines(read_status(config, store))
        return Group(Text(head, style="bold"), *(Text(line) for line in rest))

    # A KeyboardInterrupt could arrive in a destructor, where Python only prints it.
    ended = Event()
    before = signal.signal(signal.SIGINT, lambda *_: ended.set())
    console = Console()
    try:
        if not (console.is_terminal and sys.stdin.isatty()):
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
    """Yield a function that waits for a key, at most the given s, and returns it or "".

    Standard input is a terminal, whose mode is restored.
    """
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
    from thermocald.store.server.connection import require_file

    if store is None:
        store = load_config(require_config(config, "--config FILE or --store FILE")).store.path
    return running_status(require_file(store))


def devices(json: opt.Json = None) -> None:
    """List the attached cameras, thermometers and outputs as stanzas of config.yaml.

    A device that cannot be identified for certain (on a serial port or I2C bus) is a comment.

    Example: thermocald devices >> config.yaml
    """
    from thermocald.daemon.soundness import attached, stanzas

    found, notes = attached()
    document = {"format": "thermocald-devices/1", "devices": found, "notes": notes}
    show(document, json, "\n".join(stanzas(found)))
    for note in notes:
        say(note)


def doctor(
    root: Path = expert(Path("/"), help="Root folder of the machine, such as a mounted card."),
    json: opt.Json = None,
) -> None:
    """Report what this machine lacks: camera stack, groups, I2C, clock, power, disk.

    Each finding is followed by the command that fixes it. Nothing is changed. The exit status is 1
    if something is missing.

    Example: thermocald doctor
    """
    from thermocald.machine import Machine, finding_lines

    if not root.is_dir():
        raise UsageError(f"--root {root}: there is no such folder")
    findings = Machine.here(root).findings()
    document = {"format": "thermocald-doctor/1", "findings": findings}
    show(document, json, *finding_lines(findings))
    if any(finding.state == "missing" for finding in findings):
        raise typer.Exit(1)


def check(
    source: Path = typer.Argument(..., help="A recording, a config.yaml, or a store."),
    probe: bool = typer.Option(
        False, "--probe", help="Take a frame or a reading from every device of a configuration."
    ),
    json: opt.Json = None,
) -> None:
    """Read a recording, a configuration or a store completely; stop at the first error.

    With --probe, every device is tried even if others fail; the exit status is 3 if one failed.

    Example: thermocald check config.yaml
    """
    from thermocald.daemon.soundness import examine

    document = examine(source, probe, say)
    show(document, json, *document["lines"])
    if damaged := document.get("damaged"):
        raise DataError(
            f"{source}: {counted(len(damaged), 'place')} damaged, the first: {damaged[0]}; restore "
            "a backup, or use what can still be read"
        )
    probes = document.get("probes", [])
    failed = [probe["name"] for probe in probes if probe["error"]]
    if failed:
        raise DeviceError(
            f"{len(failed)} of {len(probes)} devices failed: {', '.join(failed)}; see their lines"
        )


WIDTH = 79
_OLD_S = 10.0
_SILENT_S = 30.0  # as for the page's /healthz


def status_lines(document: dict[str, Any]) -> list[str]:
    """Return a `thermocald-status/1` document as lines; the first is the headline."""
    running = duration(max(0.0, document["utc"] - document["started"]))
    headline = f"thermocald {document['version']}, pid {document['pid']}, for {running}"
    if (age := document["age_s"]) > _OLD_S:
        headline += f"; this status is {duration(age)} old: the daemon does not answer"
    lines = [headline, ""]
    for name, camera in document["cameras"].items():
        lines += _camera(name, camera)
    for one in document["sessions"].values():
        lines += _wrapped(f"session {session_line(one)}")
    others = [
        (name, device)
        for kind in ("thermometers", "outputs")
        for name, device in document[kind].items()
    ]
    wide = max((len(name) for name, _ in others), default=0)
    for name, device in others:
        lines += _wrapped(f"{name:<{wide}}  {_device(device)}", wide + 2)
    lines += [part for text in document["warnings"] for part in _wrapped(f"! {text}")]
    return lines


def _wrapped(text: str, indent: int = 2) -> list[str]:
    """Wrap a line between words to lines of 79 characters; a path is never broken."""
    return textwrap.wrap(
        text, WIDTH, subsequent_indent=" " * indent, break_long_words=False,
        break_on_hyphens=False,
    ) or [""]  # fmt: skip


def _camera(name: str, camera: dict[str, Any]) -> list[str]:
    last = camera.get("last") or {}
    title = f"{name}/{camera['series']}" if camera["series"] else f"{name}, idle"
    lines = [f"{title}: {camera['device']}"]
    if last:
        temperature = last.get("temperature")
        at = "" if temperature is None else f" at {celsius(temperature, 2)} °C"
        lines[0] += f", epoch {last.get('epoch', '?')}{at}"
        if last.get("status") in WITH_VALUES:
            lines += _orientation(last)
            online, sigma0 = last.get("online") or {}, last.get("sigma0")
            fit = "" if sigma0 is None or not math.isfinite(sigma0) else f"σ₀ {sigma0:.2f}"
            state = str(online.get("sentence") or last.get("state", ""))
            lines += _wrapped(f"  {', '.join(part for part in (fit, state) if part)}")
            if change := online.get("orientation"):
                lines += _wrapped(f"  {change}")
        else:
            lines += _wrapped(f"  {last.get('status', '')}: {last.get('reason', '')}".rstrip(": "))
    late = 1000 * camera["late_p99_s"]
    count = f"  {camera['lost']} lost, {camera['skipped']} skipped"
    return [*lines, f"{count}; 99 % at most {late:.0f} ms late", ""]


def _orientation(last: dict[str, Any]) -> list[str]:
    """Return a line for each of c, x0, y0 with its standard deviation and drift."""
    lines = []
    for name in ("c", "x0", "y0"):
        value, sd = last.get(name), last.get(f"sd_{name}")
        if value is None or not math.isfinite(value):
            continue
        line = f"  {name:<2} {with_sd(value, math.nan if sd is None else sd, 'mm')}"
        drift, sd_drift = last.get(f"drift_{name}_px"), last.get(f"sd_drift_{name}_px")
        if drift is not None and sd_drift is not None:
            line = f"{line:<34}moved {with_sd(drift, sd_drift, 'px')} since the start"
        lines.append(line)
    return lines


def _device(device: dict[str, Any]) -> str:
    shown = [
        ("" if name == "temperature" else f"{name} ") + f"{celsius(value, 2)} °C"
        for name, value in device.get("last", {}).items()
        if value is not None
    ]
    text = ", ".join([device["device"], *shown])
    if device["faults"]:
        text += f", {counted(device['faults'], 'fault')}"
    return text
