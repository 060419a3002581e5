"""`thermocald session start`: from a plugged-in camera to epochs, a recording and the report."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.cli.common import say
from thermocald.errors import ConfigurationError, DataError, DeviceError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from thermocald.config import CameraConfig, Config
    from thermocald.daemon.station import Station

__all__ = ["register"]

_BLURRED_PX = 3.0
_SATURATED = 0.02
_LOW_CONTRAST = 30.0
_LINE_EVERY_S = 10.0


def register(app: typer.Typer) -> None:
    """Add the commands."""
    sessions = typer.Typer(help="One measurement series, from the check to the report.")
    sessions.command("start")(start)
    sessions.callback()(lambda: None)
    app.add_typer(sessions, name="session")


def start(
    camera: Annotated[
        str | None, typer.Option("--camera", help="Which of the configuration's cameras.")
    ] = None,
    series: Annotated[str, typer.Option("--series", help="Name of the series; resumes it.")] = "M1",
    condition: Annotated[
        str, typer.Option("--start", help="Start condition, such as cold or warm.")
    ] = "",
    epochs: Annotated[int, typer.Option("--epochs", min=1, help="How many epochs.")] = 150,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="The configuration [config.yaml].")
    ] = None,
    mock: Annotated[bool, typer.Option("--mock", help="Without hardware.")] = False,
    programme: Annotated[
        Path | None, typer.Option("--programme", help="Steps of a heating output: YAML list.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for recording and report.")
    ] = Path(),
    check: Annotated[
        bool, typer.Option("--check/--no-check", help="Look at light, focus, geometry first.")
    ] = True,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="End with the study's report.")
    ] = True,
) -> None:
    """Take a series of epochs with progress, then write its recording and its report.

    Interrupted, the same command goes on where it stopped.

    Example: thermocald session start --camera phone-1 --series M1 --start cold --epochs 150
    """
    from thermocald.daemon.journal import set_up_logging
    from thermocald.daemon.service import Service

    read = _prepare(_configuration(config, mock), camera, series, programme)
    one = read.cameras[0]
    path = output / f"{one.name}-{series}"
    if path.exists():
        raise DataError(f"{path}: the recording exists already; choose another --series")
    output.mkdir(parents=True, exist_ok=True)
    done = _stored(read, one)
    set_up_logging("warning")
    if done < epochs:
        if check:
            _check(read)
        if done:
            say(f"series {series} has {done} epochs; {epochs - done} are still to be taken")
        progress = _Progress(epochs, done)
        service = Service(
            read,
            epochs=epochs - done,
            until_finished=True,
            start_condition=condition,
            on_turn=progress.turn,
        )
        service.run()
        done = _stored(read, one)
    if done < epochs:
        raise DataError(
            f"series {series} has {done} of {epochs} epochs; the same command goes on from there"
        )
    _finish(read, one, path, report)


def _configuration(config: Path | None, mock: bool) -> Config:
    from thermocald.config import load_config
    from thermocald.hal import option_names

    if mock:
        from thermocald.cli.run import mock_config

        if config is not None:
            raise UsageError("give --config or --mock, not both")
        return mock_config()
    path = config or Path("config.yaml")
    if not path.exists():
        raise UsageError(f"{path}: there is no configuration; give --config FILE, or --mock")
    return load_config(path, option_names)


def _prepare(config: Config, camera: str | None, series: str, programme: Path | None) -> Config:
    """The configuration with one camera, its thermometers, and the series' name."""
    names = [c.name for c in config.cameras]
    if camera is None and len(names) != 1:
        raise UsageError(f"which camera? give --camera, one of: {', '.join(names) or 'none'}")
    if camera is not None and camera not in names:
        raise UsageError(f"there is no camera {camera!r}; there are: {', '.join(names) or 'none'}")
    one = config.cameras[names.index(camera) if camera else 0]
    document = config.model_dump(mode="python", by_alias=True)
    chosen = next(c for c in document["cameras"] if c["name"] == one.name)
    chosen["series"] = series
    document["cameras"] = [chosen]
    document["thermometers"] = [
        t for t in document["thermometers"] if t["name"] in one.thermometers
    ]
    if programme is not None:
        _use_programme(document["outputs"], programme)
    from thermocald.config import parse_config

    return parse_config(document, Path("config.yaml"))


def _use_programme(outputs: list[dict[str, Any]], path: Path) -> None:
    from thermocald.hal import option_names
    from thermocald.yaml_file import read_yaml

    document = read_yaml(path, ConfigurationError)
    if not isinstance(document.get("programme"), list):
        raise ConfigurationError(f"{path}: must hold `programme:`, a list of steps")
    takers = [o for o in outputs if "programme" in option_names("output", o["driver"])]
    if not takers:
        raise ConfigurationError("--programme: no output of the configuration heats")
    for taker in takers:
        taker["programme"] = document["programme"]


def _stored(config: Config, one: CameraConfig) -> int:
    from thermocald.store.database import Store

    if not config.store.path.exists():
        return 0
    with Store.open(config.store.path) as store:
        for found in store.all_series():
            if (found.camera, found.name) == (one.name, one.series):
                return store.last_epoch(found) or 0
    return 0


def _check(config: Config) -> None:
    """One frame and one reading; DataError says what is to be mended first."""
    from thermocald.daemon.plan import plan_cameras
    from thermocald.hal import SystemClock, open_device

    clock = SystemClock()
    for one in config.thermometers:
        with open_device("thermometer", one.driver, one.options, clock) as thermometer:
            values = thermometer.read().values
        say(f"{one.name}: " + ", ".join(f"{k} {v:.2f} °C" for k, v in values.items()))
    plan = plan_cameras(config, clock)[0]
    if plan.calibrator is None or plan.testfield is None:
        raise ConfigurationError(f"camera {plan.name!r}: a session needs its `testfield`")
    from thermocald.acquisition.pairing import PairedReadings
    from thermocald.acquisition.pipeline import calibrate_frame, make_epoch

    with plan.camera as camera:
        frame = camera.capture()
    nothing = PairedReadings(float("nan"), {}, float("nan"))
    calibrated = calibrate_frame(plan.calibrator, make_epoch(1, frame, nothing), frame)
    result = calibrated.adjustment
    seen = calibrated.epoch.observations
    if seen is not None and len(seen):
        blur = calibrated.extra.get("blur_px")
        say(
            f"{plan.name}: {len(seen)} of {len(plan.testfield)} targets"
            + ("" if blur is None else f", blur {blur:.2f} px")
        )
        for sentence in _remarks(plan.testfield.names, seen.targets, seen.quality):
            say(f"  {sentence}")
    if not result.ok:
        raise DataError(f"the check failed: {result.status}: {result.reason}")
    say(
        f"{plan.name}: sigma0 {result.sigma0:.2f}, c {result.values[0]:.4f} ± {result.sd[0]:.4f} mm"
    )


def _remarks(names: tuple[str, ...], targets: Any, quality: dict[str, Any]) -> Iterator[str]:
    """What a person can mend: light and focus, target by target."""
    rules: tuple[tuple[str, Callable[[float], bool], str], ...] = (
        ("saturation", lambda v: v > _SATURATED, "saturated: less light, or a shorter exposure"),
        ("blur", lambda v: v > _BLURRED_PX, "blurred: focus, or hold the camera still"),
        ("contrast", lambda v: abs(v) < _LOW_CONTRAST, "of low contrast: more light"),
    )
    for key, bad, words in rules:
        if key not in quality:
            continue
        rows = [int(t) for t, v in zip(targets, quality[key], strict=True) if bad(v)]
        if rows:
            shown = ", ".join(names[row] for row in rows[:5])
            more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
            yield f"target {shown}{more}: {words}"


class _Progress:
    """Live numbers: a line that is rewritten on a terminal, some lines otherwise."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._shown = done
        self._told = float("-inf")
        self._out = False

    def turn(self, station: Station) -> None:
        """Called by the service a few times a second."""
        camera = station.cameras[0]
        out = camera.link.state == "out"
        if out and not self._out:
            say(f"paused: {camera.link.why}")
        if self._out and not out:
            say("the camera is back")
        self._out = out
        if camera.link.error is not None and camera.link.state == "failed":
            raise DeviceError(f"camera {camera.plan.name}: {camera.link.why}")
        last = camera.last
        if not last or last["epoch"] <= self._shown:
            return
        self._shown = last["epoch"]
        line = f"epoch {last['epoch']} of {self._total}: {last['temperature']:.2f} °C"
        if last["status"] == "ok":
            line += f", c {last['c']:.4f} ± {last['sd_c']:.4f} mm, sigma0 {last['sigma0']:.2f}"
            line += f", {last['online'].get('sentence', '')}"
        else:
            line += f", {last['status']}: {last['reason']}"
        now = time.monotonic()
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\x1b[K{line}")
            sys.stderr.flush()
        elif now - self._told >= _LINE_EVERY_S or self._shown == self._total:
            self._told = now
            say(line)


def _finish(config: Config, one: CameraConfig, path: Path, report: bool) -> None:
    from thermocald.store.archive import archive_series
    from thermocald.store.database import Store

    with Store.open(config.store.path) as store:
        found = store.find_series(one.name, one.series)
        archive_series(store, found, path, config.frames.folder)
        status = store.series_columns(found, ["status"])["status"]
    say(f"\nrecording: {path} ({int(np.sum(status == 'ok'))} of {len(status)} epochs calibrated)")
    if not report:
        return
    from thermocald.analysis.study import study
    from thermocald.analysis.study_input import load_series
    from thermocald.output.study_report import render_report, write_report

    target = path.with_suffix(".html")
    title = f"{one.name}, series {one.series}"
    write_report(target, render_report(study(load_series(path)), title))
    say(f"report: {target}")
