"""`thermocald predict`: the interior orientation at a temperature, or along a temperature log."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    ModelOption,
    TimezoneOption,
    device_clock,
)
from thermocald.errors import UsageError
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.analysis.camera.state import CameraState
    from thermocald.analysis.thermal.temperature_log import TemperatureLog
    from thermocald.analysis.thermal.thermal_camera import Along, ThermalCamera

__all__ = ["predict", "read_log", "say_what_is_missing", "warnings_said"]


@contextmanager
def warnings_said() -> Iterator[None]:
    """Warnings of the program as lines on standard error, each once."""
    from thermocald.cli.common import say

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for text in dict.fromkeys(str(w.message) for w in caught):
        say(f"warning: {text}")


def say_what_is_missing(thermal: ThermalCamera) -> None:
    """A warning on standard error where the model's own fit found that an effect is missing."""
    from thermocald.cli.common import say

    if thermal.model.misses_an_effect:
        left = thermal.model.evidence["fit"]["misfit_px"]
        say(
            f"warning: the model misses an effect: it left {left:.3f} px in its own series. "
            "Standard deviations hold what it left there, not what it leaves elsewhere; "
            "thermocald discover looks for the effect"
        )


def predict(
    model: ModelOption,
    temperature: Annotated[
        float | None, typer.Option(help="°C: a camera that has long been there.")
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="CSV of temperatures, epochs.csv, or a store.")
    ] = None,
    timezone: TimezoneOption = None,
    test: Annotated[
        Path | None, typer.Option(help="Recording or store: how well the model predicts it.")
    ] = None,
    programme: Annotated[
        Path | None, typer.Option(help="Warm-up advice for what is done to the camera.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file, for --programme.")] = None,
    channel: Annotated[
        list[str] | None, typer.Option(help="NAME=°C of another thermometer; repeatable.")
    ] = None,
    distance: Annotated[float, typer.Option(min=0.01, help="Of the object, m.")] = 10.0,
    wanted: Annotated[
        float, typer.Option("--wanted-mm", min=1e-3, help="Wanted error there, mm.")
    ] = 5.0,
    extrapolate: ExtrapolateOption = False,
    json: JsonOption = None,
) -> None:
    """Predict the interior orientation with standard deviations.

    Example: thermocald predict --model camera.thermal.yaml --temperature 35
    """
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.cli.common import write_result

    if sum(option is not None for option in (temperature, log, test, programme)) != 1:
        raise UsageError("give one of --temperature, --log, --test, --programme")
    thermal = ThermalCamera.load(model)
    say_what_is_missing(thermal)
    with warnings_said():
        if temperature is not None:
            others = _channels(channel or [])
            state = thermal.at(temperature, channels=others or None, extrapolate=extrapolate)
            document, lines = _state_document(thermal, state, distance)
        elif log is not None:
            table = read_log(thermal, log, timezone=timezone)
            along = thermal.along(table.times, dict(table.channels), extrapolate=extrapolate)
            document, lines = _along_document(thermal, along)
        elif test is not None:
            document, lines = _tested(thermal, test)
        else:
            assert programme is not None
            document, lines = _advice(thermal, programme, camera, distance, wanted)
    if write_result(document, json):
        typer.echo("\n".join(lines))


def _tested(thermal: ThermalCamera, path: Path) -> tuple[dict[str, Any], list[str]]:
    """Each series of a recording or a store against what the model predicts of it."""
    from dataclasses import asdict

    import numpy as np

    from thermocald.analysis.thermal.prediction_test import predicted_error
    from thermocald.cli.common import progress
    from thermocald.reduction.reduce import reduce_series
    from thermocald.reduction.source import load_series

    require_source(path)
    known = [float(f["thermometer_sd_K"]) for f in thermal.model.fitted_on
             if "thermometer_sd_K" in f]  # fmt: skip
    found, lines = [], []
    with progress(None, "reading and measuring") as advance:
        series = [
            reduce_series(s, affinity=False, strict=False) for s in load_series(path, advance)
        ]
    for s in series:
        sensor = s.source.sensor
        noise = s.thermometers[s.history.reference].noise
        sd = float(np.median(known)) if known else noise
        scaled = thermal.for_images(sensor.width, sensor.height, s.source.camera)
        error = predicted_error(scaled.model, s, sd)
        found.append(asdict(error))
        bands = f"{error.coverage:.1%} inside their 95 % bands"
        if thermal.model.misses_an_effect:
            bands = "no 95 % band is stated, as the model misses an effect"
        lines.append(
            f"{s.source.name}: predicted to {error.rms_px:.4f} px (noise alone "
            f"{error.floor_px:.4f}), {bands}, {error.object_mm:.2f} mm at 10 m"
        )
    document = {
        "format": "thermocald-prediction-test/1",
        "camera": thermal.model.camera,
        "series": found,
    }
    return document, lines


def read_log(
    thermal: ThermalCamera, path: Path, column: str | None = None, timezone: str | None = None
) -> TemperatureLog:
    """A temperature log; T is the named column, else the model's own reference, else the first.

    timezone: of times without one. ConfigurationError where the log is of a recording of another
    camera.
    """
    from thermocald.analysis.thermal.temperature_log import read_temperature_log
    from thermocald.store.recording.head import read_head
    from thermocald.store.sources import is_store

    if is_store(path):
        return _stored_log(thermal, path, column)

    if path.name == "epochs.csv" and (path.parent / "recording.yaml").is_file():
        camera = read_head(path.parent).camera
        thermal.for_images(camera.sensor.width, camera.sensor.height, camera.name)
    clock = device_clock(timezone)
    table = read_temperature_log(path, column, clock)
    reference = next(iter(thermal.model.validity), None)
    if column is None and reference in table.channels:
        return read_temperature_log(path, reference, clock)
    return table


def _stored_log(thermal: ThermalCamera, path: Path, column: str | None) -> TemperatureLog:
    from thermocald.analysis.thermal.stored_log import stored_temperature_log

    table, camera = stored_temperature_log(require_source(path), column)
    thermal.for_images(camera.sensor.width, camera.sensor.height, camera.name)
    reference = next(iter(thermal.model.validity), None)
    if column is None and reference in table.channels:
        table, _ = stored_temperature_log(path, reference)
    return table


def _channels(given: list[str]) -> dict[str, float]:
    found = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise UsageError(f"--channel {text}: write NAME=°C, such as board_temperature=48.5")
    return found


def _state_document(
    thermal: ThermalCamera, state: CameraState, distance: float
) -> tuple[dict[str, Any], list[str]]:
    import numpy as np

    from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
    from thermocald.simulation.effects.parameter import PARAMETER_UNITS

    error = state.object_error(distance * 1000.0)
    reference = thermal.at(thermal.model.T0, extrapolate=True)
    moved = state.object_distance(reference, distance * 1000.0)
    sd = state.sd
    values = dict(zip(IOP_NAMES, state.values.tolist(), strict=True))
    document: dict[str, Any] = {
        "format": "thermocald-prediction/1",
        "camera": thermal.model.camera,
        "temperature": state.temperature,
        "extrapolated_K": state.extrapolated,
        **values,
        **{f"sd_{n}": v for n, v in sd.items()},
        "covariance": state.covariance,
        "distance_m": distance,
        "object_error_mm": float(np.sqrt(np.mean(error**2))),
        "drift_from_reference_mm": float(moved.max()),
    }
    from thermocald.output.figures.numbers import plain, with_sd

    lines = [f"{thermal.model.camera} at {state.temperature:g} °C"]
    lines += [
        f"  {n:>3} = {with_sd(values[n], sd[n], PARAMETER_UNITS[n])}"
        for n in IOP_NAMES
        if values[n] or sd[n]
    ]
    lines.append(
        f"  on a plane at {distance:g} m: ± {plain(document['object_error_mm'], 'mm', 2)} "
        f"from this orientation's uncertainty; the drift since {thermal.model.T0:g} °C is up to "
        f"{plain(document['drift_from_reference_mm'], 'mm', 3)}"
    )
    return document, lines


def _along_document(thermal: ThermalCamera, along: Along) -> tuple[dict[str, Any], list[str]]:
    from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

    sds = along.sd
    header = ["time", "temperature", *IOP_NAMES, *(f"sd_{n}" for n in IOP_NAMES), "extrapolated_K"]
    rows = [
        [time, temperature, *values, *sd, outside]
        for time, temperature, values, sd, outside in zip(
            along.times, along.temperatures, along.values, sds, along.extrapolated, strict=True
        )
    ]
    document = {
        "format": "thermocald-prediction/1",
        "camera": thermal.model.camera,
        "columns": header,
        "rows": rows,
    }
    lines = [",".join(header)]
    lines += [",".join(f"{v:.10g}" for v in row) for row in rows]
    return document, lines


def _advice(
    thermal: ThermalCamera, programme: Path, camera: Path | None, distance: float, wanted: float
) -> tuple[dict[str, Any], list[str]]:
    from thermocald.analysis.thermal.warm_up import warm_up
    from thermocald.simulation.demonstration import demonstration_field
    from thermocald.simulation.device import CameraDevice, default_heat, read_camera_device
    from thermocald.simulation.observations import Simulation
    from thermocald.simulation.programme import read_programme

    if camera is not None:
        device = read_camera_device(camera)
    else:
        network, thermometers = default_heat()
        device = CameraDevice(thermal.model.camera, thermal.model.sensor, network, thermometers)
    history = Simulation(
        thermal.model, device, demonstration_field("plain"), read_programme(programme)
    ).true_history
    along = thermal.along(
        history.reading_times, dict(history.readings), history.times, extrapolate=True
    )
    advice = warm_up(along, distance * 1000.0, wanted)
    document = {
        "format": "thermocald-warm-up/1",
        "camera": thermal.model.camera,
        "distance_m": distance,
        "wanted_mm": wanted,
        "steady_from_s": advice.steady_from,
        "error_at_begin_mm": float(advice.error.max()),
        "temperature_at_end": float(along.temperatures[-1]),
    }
    if advice.steady_from is None:
        said = "does not come to rest within this programme: let it run longer"
    else:
        said = f"is steady to {wanted:g} mm at {distance:g} m after {advice.steady_from:.0f} s"
    worst = f"(up to {document['error_at_begin_mm']:.1f} mm before)"
    return document, [f"{thermal.model.camera} {said} {worst}"]
