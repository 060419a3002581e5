"""`thermocald status` and `thermocald top`: how the daemon is doing, in a terminal."""

from __future__ import annotations

import math
import signal
import time
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.common import default_config, write_json
from thermocald.cli.options import JsonOption
from thermocald.errors import DataError

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["read_status", "register", "render"]

_OLD_S = 10.0

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="The daemon's configuration.")
]
StoreOption = Annotated[Path | None, typer.Option("--store", help="The daemon's store.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("status")(status)
    app.command("top")(top)


def status(config: ConfigOption = None, store: StoreOption = None, json: JsonOption = None) -> None:
    """How the daemon is doing: cameras, thermometers, store; exit status 1 if it does not run.

    Example: thermocald status --config /etc/thermocald/config.yaml
    """
    from rich.console import Console

    document = read_status(config, store)
    if json is not None:
        write_json(document, json)
    if json != "-":
        Console().print(render(document), highlight=False)


def top(
    config: ConfigOption = None,
    store: StoreOption = None,
    interval: Annotated[float, typer.Option("--interval", min=0.2, help="s.")] = 1.0,
) -> None:
    """The same, always up to date; Ctrl-C ends it.

    Example: thermocald top --store thermocald.db
    """
    from rich.console import Console
    from rich.live import Live

    # A KeyboardInterrupt could be raised in a destructor, where Python only prints it.
    ended = Event()
    before = signal.signal(signal.SIGINT, lambda *_: ended.set())
    try:
        with Live(render(read_status(config, store)), console=Console(), screen=False) as live:
            while not ended.wait(interval):
                live.update(render(read_status(config, store)))
    finally:
        signal.signal(signal.SIGINT, before)


def read_status(config: Path | None, store: Path | None) -> dict[str, Any]:
    """The running daemon's status; DataError if none runs for that store."""
    from thermocald.daemon.live_state import find_state, read_state

    path = _store(config, store)
    folder = find_state(path)
    document = read_state(folder)
    if not document:
        raise DataError(f"no daemon runs for {path} (there is no {folder}/status.json)")
    # the daemon's own clock may be stepped; how old the file is tells the machine's alone
    age_s = time.time() - (folder / "status.json").stat().st_mtime
    document["age_s"] = max(0.0, age_s)
    if not _alive(int(document.get("pid", 0))):
        raise DataError(
            f"the daemon that wrote {path} was killed {age_s:.0f} s ago; start it again"
        )
    return document


def _store(config: Path | None, store: Path | None) -> Path:
    if store is not None:
        return store
    config = config or default_config()
    if config is None:
        raise DataError("which daemon? give --config FILE or --store FILE")
    from thermocald.config import load_config

    return load_config(config).store.path


def _alive(pid: int) -> bool:
    return pid > 0 and Path(f"/proc/{pid}").exists()


def render(document: dict[str, Any]) -> RenderableType:
    """The status as tables."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    parts: list[Any] = [Text(_headline(document), style="bold")]
    cameras = Table(box=None, pad_edge=False)
    for title in ("camera", "device", "epoch", "°C", "c mm", "x0 mm", "y0 mm", "sigma0", "state",
                  "lost", "skipped", "late p99"):  # fmt: skip
        cameras.add_column(title, justify="left" if title in _LEFT else "right")
    for name, camera in document["cameras"].items():
        cameras.add_row(*_camera(name, camera))
    parts.append(cameras)
    parts += [Text(_session(one)) for one in document["sessions"].values()]
    others = Table(box=None, pad_edge=False)
    for title in ("device", "state", "°C", "faults", "why"):
        others.add_column(title)
    for kind in ("thermometers", "outputs"):
        for name, device in document[kind].items():
            last = " ".join(f"{v:.2f}" for v in device.get("last", {}).values())
            others.add_row(name, device["device"], last, str(device["faults"]), device["why"])
    parts.append(others)
    parts += [Text(line, style="yellow") for line in _warnings(document)]
    return Group(*parts)


_LEFT = ("camera", "device", "state")


def _headline(document: dict[str, Any]) -> str:
    from thermocald.output.figures.numbers import duration

    running = duration(max(0.0, document["utc"] - document["started"]))
    text = f"thermocald {document['version']}, pid {document['pid']}, for {running}"
    if document["age_s"] > _OLD_S:
        text += f"; this is {document['age_s']:.0f} s old: it does not answer"
    return text


def _camera(name: str, camera: dict[str, Any]) -> list[str]:
    last = camera.get("last") or {}
    online = last.get("online") or {}
    state = str(online.get("sentence") or last.get("state", "" if camera["series"] else "idle"))
    if last and last.get("status") != "ok":
        state = f"{last['status']}: {last.get('reason', '')}"
    return [
        f"{name}/{camera['series']}" if camera["series"] else name,
        camera["device"],
        str(last.get("epoch", "")),
        _number(last.get("temperature"), ".2f"),
        *(_with_sd(last, key) for key in ("c", "x0", "y0")),
        _number(last.get("sigma0"), ".2f"),
        state,
        str(camera["lost"]),
        str(camera["skipped"]),
        f"{1000 * camera['late_p99_s']:.1f} ms",
    ]


def _session(one: dict[str, Any]) -> str:
    why = f": {one['why']}" if one["why"] else ""
    start = f", {one['start']}" if one["start"] else ""
    taken = f"{one['taken']} of {one['epochs']} epochs"
    return f"session {one['camera']}/{one['series']}{start}: {taken}, {one['state']}{why}"


def _with_sd(last: dict[str, Any], name: str) -> str:
    value, sd = last.get(name), last.get(f"sd_{name}")
    if value is None:
        return ""
    return f"{value:.5f}" + (f" ± {sd:.5f}" if sd is not None else "")


def _number(value: float | None, form: str) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:{form}}"


def _warnings(document: dict[str, Any]) -> list[str]:
    found = list(document["stalled"])
    store = document["store"]
    if store["state"] != "ok":
        found.append(f"store: {store['state']}: {store['why']} ({store['waiting']} epochs wait)")
    if store.get("notice"):
        found.append(f"store: {store['notice']}")
    if document.get("dashboard", {}).get("why"):
        found.append(document["dashboard"]["why"])
    if document["frames"]["paused"]:
        found.append(document["frames"]["paused"])
    if not document["clock"]["trusted"]:
        found.append("the clock is not synchronised: times may be wrong")
    if not document["frames"].get("ages_known", True):
        found.append("no frame is deleted for its age until the clock can be trusted")
    for kind in ("camera", "thermometer", "output"):
        for name, device in document[f"{kind}s"].items():
            found += [f"{kind} {name}: {text}" for text in device.get("warnings", ())]
    for name, camera in document["cameras"].items():
        if camera["why"]:
            found.append(f"camera {name}: {camera['why']}")
        if camera["put_off"] > camera["caught_up"]:
            found.append(
                f"camera {name}: {camera['put_off'] - camera['caught_up']} epochs are still to be "
                "calibrated"
            )
    return found
