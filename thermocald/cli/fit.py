"""`thermocald fit`: one thermal model from all series of a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_result
from thermocald.cli.options import JobsOption, JsonOption, TimezoneOption, takes_log_options
from thermocald.errors import UsageError
from thermocald.files import write_text


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

    calibrations = _temperatures(inputs)
    if calibrations:
        if effect or model or type_name:
            raise UsageError("--effect, --model and --type are for series, not for calibrations")
        camera = tc.fit_calibrations(
            calibrations, log=log, log_options=log_options, timezone=timezone,
            ambiguous=ambiguous, T0=reference_temperature, temperature_sd=temperature_sd, say=say,
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
        from thermocald.output.model_code import render_certificate

        write_text(report, render_certificate(camera))
    if write_result(document, json):
        typer.echo(f"{output}: {camera}")


def _temperatures(inputs: list[str]) -> dict[str, float | None]:
    """{file: °C} of calibrations, where the inputs are some; UsageError for no temperature."""
    found: dict[str, float | None] = {}
    for text in inputs:
        label, equals, rest = text.partition("=")
        name = rest if equals and not Path(text).exists() else text
        if Path(name).suffix != ".json":
            if found:
                raise UsageError(f"{text}: is no calibration; fit series and calibrations apart")
            return {}
        try:
            found[name] = float(label) if name == rest else None
        except ValueError:
            raise UsageError(f"{text}: {label!r} is not a temperature in °C") from None
    return found
