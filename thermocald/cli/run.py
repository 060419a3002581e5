"""`thermocald run`: the daemon in the foreground; what systemd starts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.common import default_config
from thermocald.cli.options import ConfigOption
from thermocald.errors import StoreError, UsageError

if TYPE_CHECKING:
    from thermocald.config import Config

__all__ = ["dashboard", "mock_config", "recording_config", "run"]


def run(
    config: ConfigOption = None,
    mock: Annotated[
        bool, typer.Option("--mock", help="A rendered camera that warms up, and a thermometer.")
    ] = False,
    recording: Annotated[
        Path | None, typer.Option(help="Play a recording instead of devices.")
    ] = None,
    store: Annotated[
        Path | None, typer.Option(help="The store; overrides the configuration.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=0, help="End after so many epochs per camera.")] = 0,
    fast: Annotated[
        bool, typer.Option("--fast", help="Play the recording as fast as it can be calibrated.")
    ] = False,
    hang_after: Annotated[
        float, typer.Option(min=0.5, help="A device that does not return for so many s hangs.")
    ] = 60.0,
    dashboard: Annotated[bool, typer.Option("--dashboard", help="Show the web page too.")] = False,
) -> None:
    """Acquire, calibrate and keep epochs until told to end (Ctrl-C, SIGTERM).

    Example: thermocald run --config config.yaml
    """
    import os

    from thermocald.config import load_config
    from thermocald.daemon.journal import set_up_logging
    from thermocald.daemon.service import Service
    from thermocald.hal import option_names

    if sum([config is not None, mock, recording is not None]) > 1:
        raise UsageError("give one of --config FILE, --mock, --recording FOLDER")
    if not mock and recording is None:
        config = config or default_config()
        if config is None:
            raise UsageError(
                "there is neither ./config.yaml nor /etc/thermocald/config.yaml; give one of "
                "--config FILE, --mock, --recording FOLDER"
            )
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
    if not service.run():
        os._exit(0)  # a driver that hangs in the kernel would keep the interpreter from ending


def mock_config() -> Config:
    """A camera and a thermometer without hardware."""
    return _config(
        {
            "store": {"path": "thermocald-mock.db"},
            "frames": {"keep": "none", "folder": "thermocald-mock-frames", "min_free_gb": 0.1},
            "cameras": [
                {
                    "name": "mock",
                    "driver": "mock",
                    "principal_distance_mm": 3.04,
                    "thermometers": ["housing"],
                    "options": {"seed": 1},
                }
            ],
            "thermometers": [{"name": "housing", "driver": "mock", "seed": 2}],
        }
    )


def recording_config(path: Path, *, loop: bool = False) -> Config:
    """A recording as camera and thermometer."""
    from thermocald.store.recording.head import read_head

    head = read_head(path)
    sensor = head.camera.sensor
    replay = {"driver": "replay", "recording": str(path.absolute()), "loop": loop}
    period = max(0.05, head.interval)
    return _config(
        {
            "store": {"path": f"{path.absolute().name}.db", "durable": False},
            "frames": {"keep": "none", "folder": f"{path.absolute().name}-frames"},
            "cameras": [
                {
                    "name": _name(head.camera.name),
                    "series": _name(head.series),
                    "period_s": period,
                    "sensor": {
                        "width_px": sensor.width,
                        "height_px": sensor.height,
                        "pixel_pitch_mm": sensor.pixel_pitch,
                    },
                    "principal_distance_mm": head.camera.principal_distance,
                    "testfield": str((path / "testfield.csv").absolute()),
                    "thermometers": ["recorded"] if head.channels else [],
                    **replay,
                }
            ],
            "thermometers": [{"name": "recorded", "period_s": period, **replay}],
        }
    )


def _config(document: dict[str, Any]) -> Config:
    from thermocald.config import parse_config

    return parse_config(document, Path("config.yaml"))


def _name(text: str) -> str:
    """Text as a configuration takes it for a name."""
    import re

    return re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip("_.-")[:64] or "camera"


def dashboard(
    store: Annotated[Path | None, typer.Option(help="The daemon's store.")] = None,
    live: Annotated[
        Path | None, typer.Option(help="The folder of the daemon's live state.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Elsewhere than here needs --token-file.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535)] = 8437,
    token_file: Annotated[Path | None, typer.Option(help="A file that holds the token.")] = None,
    name: Annotated[
        list[str] | None, typer.Option(help="A further name of the page; repeatable.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="All of these from a configuration.")
    ] = None,
) -> None:
    """The web page of a daemon, in a process of its own; it only reads.

    With --config it ends at once where the configuration has `dashboard: {enabled: false}`.

    Example: thermocald dashboard --store thermocald.db
    """
    from thermocald.cli.common import say
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
