"""`thermocald study`, `discover` and `fit`: what measured series say of a camera.

Statistics, significance and Monte-Carlo; where simulation and measurement disagree, why, and the
proof; one thermal model from all series of a camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_result
from thermocald.cli.options import (
    DEFAULT_FREE,
    ExteriorOption,
    FreeOption,
    JobsOption,
    JsonOption,
    SeedOption,
    TimezoneOption,
    takes_log_options,
)
from thermocald.errors import UsageError
from thermocald.files import write_text
from thermocald.store.server.connection import is_server
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from thermocald.results import Study


def study(
    inputs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[LABEL=]RECORDING_OR_STORE…",
            help="Recordings (folders) and stores (files). Series with one label are one camera; "
            "the label is the camera's name unless given.",
        ),
    ] = None,
    json: JsonOption = None,
    report: Annotated[Path | None, typer.Option(help="Write the report, one HTML file.")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Write all figures as SVG and PNG here.")
    ] = None,
    window: Annotated[int, expert(min=3, help="Epochs in the F-test's window, odd.")] = 31,
    alpha: Annotated[float, expert(min=1e-6, max=0.5, help="Level of the F-test.")] = 0.05,
    sets: Annotated[int, expert(min=2, help="Interior orientations drawn (Monte-Carlo).")] = 50_000,
    seed: SeedOption = 0,
    distance: Annotated[float, expert(min=0.01, help="Of the object plane, m.")] = 10.0,
    grid: Annotated[
        int, expert("--grid", min=2, max=9, help="Image points per row and column.")
    ] = 3,
    focus: Annotated[
        float, expert(min=0.01, help="Focus distance for the depth of field, m.")
    ] = 1.0,
    f_number: Annotated[float, expert(min=0.1, help="Of the lens.")] = 2.0,
    confusion: Annotated[
        float | None, expert(min=1e-6, help="Circle of confusion, mm [diagonal/2000].")
    ] = None,
    thermometer_sd: Annotated[
        float | None, expert(min=0.0, help="Noise of the thermometers, K [estimated].")
    ] = None,
    exterior: ExteriorOption = "auto",
    free: FreeOption = DEFAULT_FREE,
    jobs: JobsOption = 1,
    reference: Annotated[
        bool, expert("--reference", help="Study the presets instead, next to the reference study.")
    ] = False,
) -> None:
    """How the camera changes with its temperature, whether that is significant, what it does.

    Example: thermocald study M1 M2 --report study.html --json study.json
    """
    import thermocald as tc

    if reference == bool(inputs):
        raise UsageError(
            "give recordings or stores to study, or --reference"
            if not inputs
            else "--reference studies the presets; give no recordings with it"
        )
    if window % 2 == 0:
        raise UsageError(f"--window is {window}; it must be odd, so that it has a centre")
    settings: dict[str, Any] = {
        "window": window,
        "alpha": alpha,
        "sets": sets,
        "seed": seed,
        "distance_mm": 1000 * distance,
        "grid": grid,
        "focus_mm": 1000 * focus,
        "f_number": f_number,
        "confusion_mm": confusion,
        "thermometer_sd": thermometer_sd,
        "jobs": jobs,
    }
    if reference:
        with progress(None, "simulating, adjusting, studying") as advance:
            result = tc.reference_study(progress=advance, **settings)
    else:
        result = _study(inputs or [], settings, exterior, free)
    written = []
    if report is not None:
        written.append(str(result.report(report)))
    if figures is not None:
        written.append(f"{len(result.save_figures(figures))} figures in {figures}")
    if write_result(result.as_dict(), json):
        typer.echo("\n".join([str(result), *(f"written: {line}" for line in written)]))


def _study(inputs: list[str], settings: dict[str, Any], exterior: str, free: str) -> Study:
    import thermocald as tc

    labels: list[str | None] = []
    series: list[tc.Series] = []
    for label, path in map(_labelled, inputs):
        found = tc.open_all(path)
        labels += [label] * len(found)
        series += found
    cameras = len({label or one.camera for label, one in zip(labels, series, strict=True)})
    with progress(settings["sets"] * cameras, "calibrating and simulating") as advance:
        return tc.study(
            *series, labels=labels, **settings, exterior=exterior, free=free, progress=advance
        )


def _labelled(text: str) -> tuple[str | None, Path]:
    """`LABEL=PATH` or `PATH`; DataError where there is nothing at the path."""
    label, equals, rest = text.partition("=")
    # A path may hold "="; what exists as it stands is a path.
    if not equals or Path(text).exists() or is_server(text):
        label, rest = "", text
    return label or None, require_source(Path(rest))


def discover(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="M1", help="What to explain: a recording, a store, postgresql://…"),
    ] = None,
    verify: Annotated[
        list[Path] | None,
        typer.Option(help="M2: another recording of this camera, to prove it on; repeatable."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="The model so far (YAML) [base model].")
    ] = None,
    json: JsonOption = None,
    model_out: Annotated[
        Path | None, typer.Option(help="Write the model with what was found.")
    ] = None,
    effect_out: Annotated[
        Path | None, expert(help="Write what was found as an effect file (YAML).")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report, one HTML file.")] = None,
    jobs: JobsOption = 1,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Which effects a set-up would show, before heating anything."),
    ] = False,
    preset: Annotated[
        str | None, typer.Option(help="With --plan: a camera of the reference study.")
    ] = None,
    testfield: Annotated[str | None, typer.Option(help="With --plan: a testfield.csv.")] = None,
    programme: Annotated[
        Path | None, typer.Option(help="With --plan: what is done to the camera.")
    ] = None,
    strength: Annotated[float, expert(min=0.001, help="With --plan: size of an effect, px.")] = 0.1,
    seeds: Annotated[int, expert(min=1, max=50, help="With --plan: repetitions.")] = 2,
) -> None:
    """Find where simulation and measurement disagree, name the missing effect, prove it.

    Example: thermocald discover M1 --verify M2 --model-out camera.yaml --report discovery.html
    """
    import thermocald as tc

    if plan:
        with progress(None, "planning") as advance:
            planned = tc.plan(
                None if recording is None else tc.open(recording), preset=preset, model=model,
                testfield=testfield, programme=programme, strength_px=strength, seeds=seeds,
                progress=advance,
            )  # fmt: skip
        if write_result(planned.as_dict(), json):
            typer.echo(str(planned))
        return
    if recording is None:
        raise UsageError("M1 is missing: the folder of the recording to explain")
    others = [tc.open(path) for path in verify or ()]
    found = tc.discover(tc.open(recording), verify=others, model=model, jobs=jobs, say=say)
    document = found.as_dict()
    if model_out is not None:
        document["model"] = str(found.save(model_out))
    if effect_out is not None and found.save_effects(effect_out) is None:
        say(f"{effect_out} is not written: nothing was found that another recording would show too")
    if report is not None:
        found.report(report)
    if write_result(document, json):
        typer.echo(str(found))


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
        from thermocald.output.certificate import render_certificate

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
