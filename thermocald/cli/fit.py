"""`thermocald fit`: one thermal model from all series of a camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_result
from thermocald.cli.options import JobsOption, JsonOption, TimezoneOption, takes_log_options
from thermocald.errors import UsageError
from thermocald.files import write_text

if TYPE_CHECKING:
    from thermocald.analysis.thermal.calibrations import Calibration
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.temperatures import LogOptions


@takes_log_options
def fit(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="RECORDING_OR_STORE…",
            help="Recordings and stores; or JSON files of `calibrate`, each with its °C: "
            "21.5=cold.json.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The model file to write.")],
    effect: Annotated[
        list[str] | None,
        typer.Option(help="NAME[:PARAMETER=VALUE,…] to fit alongside the base model; repeatable."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Fit the effects of this model, such as discovery wrote it.")
    ] = None,
    reference_temperature: Annotated[
        float | None, expert("--t0", help="Reference temperature °C; default: the mean.")
    ] = None,
    type_name: Annotated[
        str | None,
        typer.Option(
            "--type",
            metavar="NAME|MODEL",
            help="Several cameras: fit each, write the type NAME. One: its type's MODEL file helps "
            "where it was measured at few temperatures.",
        ),
    ] = None,
    code: Annotated[
        Path | None, expert(help="Write the model as FILE.h (C, C++) and FILE.py too.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write the model's certificate, one HTML file.")
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Temperatures of calibrations, at their photographs' times."),
    ] = None,
    temperature_sd: Annotated[
        float, expert(min=0.0, help="Of the temperature of a calibration, K.")
    ] = 0.1,
    jobs: JobsOption = 1,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Fit a thermal model to all series of a camera, in one adjustment over all image points.

    Of photographs that were calibrated at two temperatures or more it is fitted to the results.

    Example: thermocald fit M1 M2 -o camera.thermal.yaml --effect thermal_lag
    Example: thermocald fit 21.5=cold.json 48=warm.json -o camera.thermal.yaml
    """
    import thermocald as tc
    from thermocald.store.logger.clock import device_clock

    calibrations = _calibrations(inputs)
    if calibrations:
        if effect or model or type_name:
            raise UsageError("--effect, --model and --type are for series, not for calibrations")
        camera = _of_calibrations(
            calibrations, log, log_options, device_clock(timezone, ambiguous=ambiguous),
            reference_temperature, temperature_sd,
        )  # fmt: skip
    elif log is not None:
        raise UsageError("--log is for calibrations; a recording has its own temperatures")
    else:
        kind: str | Path | None = type_name
        if type_name is not None and Path(type_name).is_file():
            kind = Path(type_name)
        elif type_name is not None and (Path(type_name).suffix == ".yaml" or "/" in type_name):
            raise UsageError(f"--type {type_name}: there is no such file")
        series = [one for source in inputs for one in tc.open_all(source)]
        with progress(None, "reading and measuring") as advance:
            camera = tc.fit(
                *series, effects=effect or (), model=model, T0=reference_temperature, kind=kind,
                jobs=jobs, progress=advance,
            )  # fmt: skip
    document = {**camera.as_dict(), "model": str(camera.save(output))}
    if code is not None:
        from thermocald.output.model_code import write_code

        document["code"] = [str(file) for file in write_code(camera, code)]
    if report is not None:
        from thermocald.output.certificate import render_certificate

        write_text(report, render_certificate(camera))
    if write_result(document, json):
        typer.echo(f"{output}: {camera}")


def _calibrations(inputs: list[str]) -> list[Calibration]:
    """The inputs as calibrations, where they are; UsageError where only some are."""
    from thermocald.analysis.thermal.calibrations import is_calibration, read_calibration

    found: list[Calibration] = []
    for text in inputs:
        label, equals, rest = text.partition("=")
        path = Path(rest if equals and not Path(text).exists() else text)
        if not is_calibration(path):
            if found:
                raise UsageError(f"{text}: is no calibration; fit series and calibrations apart")
            return []
        try:
            degrees = float(label) if str(path) == rest else None
        except ValueError:
            raise UsageError(f"{text}: {label!r} is not a temperature in °C") from None
        found.append(read_calibration(path, degrees))
    return found


def _of_calibrations(
    given: list[Calibration], log: Path | None, options: LogOptions, clock: DeviceClock,
    T0: float | None, temperature_sd: float,
) -> ThermalCamera:  # fmt: skip
    from thermocald.analysis.thermal.calibrations import with_log
    from thermocald.analysis.thermal.camera_fit import fit_to_calibrations
    from thermocald.store.logger.temperatures import read_log

    channel = "temperature"
    if log is not None:
        spans = [c.span(clock) for c in given]
        near = float(min(s.min() for s in spans)), float(max(s.max() for s in spans))
        table = read_log(log, options, near)
        channel = next(iter(table.channels))
        for note in table.notes:
            say(note)
        given = [with_log(c, table, clock) for c in given]
    return fit_to_calibrations(given, T0, temperature_sd, channel)
