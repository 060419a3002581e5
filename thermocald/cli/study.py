"""`thermocald replay`, `export`, `study`, `discover`, `fit`: calibrate and analyse series."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, show, warnings_said, write_parts
from thermocald.errors import DataError, UsageError
from thermocald.numbers import counted
from thermocald.store.server.connection import is_server

if TYPE_CHECKING:
    from thermocald.results import Study


def replay(
    recording: Path = typer.Argument(..., help="The recording's folder."),
    store: Path | None = typer.Option(
        None, help="Store the epochs in this file; an interrupted replay is continued."
    ),
    exterior: opt.Exterior = "auto",
    free: opt.Free = opt.DEFAULT_FREE,
    jobs: opt.Jobs = 1,
    model: Path | None = typer.Option(
        None, help="Thermal model (YAML) of the camera, for photographs of a scene."
    ),
    log: Path | None = typer.Option(
        None, help="With --model: log of temperatures, a logger's file, a recording or a store."
    ),
    times: str = expert("exif", "--times", help="With --model: as for `import --times`."),
    recording_out: Path | None = typer.Option(
        None,
        "--recording-out",
        help="With --model: folder for a recording of the static points, for `discover`.",
    ),
    timezone: opt.Timezone = None,
    json: opt.Json = None,
) -> None:
    """Calibrate every epoch of a recording and report the drift of the series.

    With --model, RECORDING is a folder of photographs of a scene without a test field: the motion
    of its static points in the image is compared with the prediction of the thermal model.

    Example: thermocald replay rpi-heating-M1 --store thermocald.db

    Example: thermocald replay photos --model camera.thermal.yaml --log weather.csv --timezone UTC
    """
    from thermocald.store.recording.sense import doubt_lines

    if model is not None:
        if log is None:
            raise UsageError("--model and --log go together")
        from thermocald.store.logger.photographs import find_photographs

        camera, pictures = tc.load_camera(model), find_photographs([recording])
        with warnings_said(), progress(len(pictures), "following") as advance:
            found = tc.follow_scene(
                recording, camera, log=log, times=times, timezone=timezone, progress=advance,
                recording=recording_out,
            )  # fmt: skip
        show(found, json)
        return
    series = tc.open(recording)
    with progress(len(series), "calibrating") as advance:
        table = series.calibrate(
            exterior=exterior, free=free, store=store, jobs=jobs, progress=advance
        )
    doubts = series.doubts(table)
    document = {**table.as_dict(), "recording": recording, "store": store, "doubts": doubts}
    show(document, json, table)
    for line in doubt_lines(doubts):
        say(line)
    if not table.ok.any():
        why = next(iter(table.without_result), "there is no epoch")
        raise DataError(f"{recording}: no epoch has a result: {why}")


def export(
    source: Path = typer.Argument(..., help="A recording (folder) or a store (file)."),
    format_: str = typer.Option(
        "", "--format", help="csv, json, or parquet. Default: the file's, .json or .parquet; csv."
    ),
    output: str = typer.Option("-", "--output", "-o", help="File; - is standard output."),
    exterior: str = typer.Option(
        "",
        help="stored: a store's epochs as they were stored; auto, per_epoch, series, mount: adjust "
        "the series again. Default: stored for a store, auto for a recording.",
    ),
    free: opt.Free = opt.DEFAULT_FREE,
    series: str | None = typer.Option(None, help="Series of a store: CAMERA/SERIES or SERIES."),
    units: str = typer.Option("", help="px, um, deg instead of mm and rad; columns name them."),
    time_: str = typer.Option("seconds", "--time", help="Times: seconds (since 1970, UTC) or iso."),
    separator: str = typer.Option(",", help="Column separator: , ; | tab"),
    decimal: str = typer.Option(".", help="Decimal mark: . or ,"),
    extra: bool = expert(
        False,
        "--extra",
        help="Add all thermometers and everything else stored for an epoch: the settings that the "
        "camera reported (camera_…), light, blur, the online filter.",
    ),
    jobs: opt.Jobs = 1,
) -> None:
    """Write one row per epoch: parameters, standard deviations, sigma0, status.

    The temperatures of all thermometers are added with any of --units, --time, --separator,
    --decimal, --extra, and always in Parquet.

    Example: thermocald export rpi-heating-M1 --format csv > M1.csv

    Example: thermocald export M1 --units px,deg --time iso --separator ';' --decimal ',' -o M1.csv
    """
    from thermocald.output import series_export
    from thermocald.result import csv_text
    from thermocald.store.recording.observation_file import write_parquet

    folder = source.is_dir()
    exterior = exterior or ("auto" if folder else "stored")
    suffix = Path(output).suffix.lower()
    format_ = format_ or (suffix[1:] if suffix in (".json", ".parquet") else "csv")
    if format_ not in ("csv", "json", "parquet"):
        raise UsageError(f"--format {format_}: must be one of csv, json, parquet")
    wanted, mark = series_export.check_style(units, time_, separator, decimal)
    plain = not wanted and (time_, mark, decimal) == ("seconds", ",", ".")
    if format_ == "parquet" and output == "-":
        raise UsageError("--format parquet needs a file: -o FILE")
    if format_ == "json" and not plain:
        raise UsageError("--units, --time, --separator and --decimal are for csv and parquet")
    opened = tc.open(source, series)
    with progress(len(opened) if folder else None, "calibrating") as advance:
        table = opened.calibrate(exterior=exterior, free=free, jobs=jobs, progress=advance)
    known = None
    if extra or format_ == "parquet" or not plain:
        known = opened.besides(table.number, extra=extra)
    pitch = opened.head.camera.sensor.pixel_pitch
    parts = series_export.column_parts(table, wanted, time_ == "iso", pitch, known)
    if format_ == "parquet":
        write_parquet(Path(output), parts)
    elif format_ == "json":
        write_parts(series_export.as_json(parts), output)
    else:
        write_parts(csv_text(parts, mark, decimal), output)
    for sentence, count in sorted(table.without_result.items()):
        say(f"{counted(count, 'epoch')} without a result: {sentence}")


def study(
    inputs: list[str] | None = typer.Argument(
        None,
        metavar="RECORDING_OR_STORE",
        help="Recordings (folders) and stores (files), also as LABEL=RECORDING_OR_STORE: series "
        "with the same label belong to one camera; default label: the camera's name.",
    ),
    json: opt.Json = None,
    report: Path | None = typer.Option(None, help="Write the report to an HTML file."),
    figures: Path | None = typer.Option(None, help="Write all figures here, as SVG and PNG."),
    window: int = expert(31, min=3, help="Number of epochs in the window of the F-test; odd."),
    alpha: float = expert(0.05, min=1e-6, max=0.5, help="Significance level of the F-test."),
    sets: int = expert(50_000, min=2, help="Number of draws of the Monte-Carlo simulation."),
    seed: opt.Seed = 0,
    distance: float = expert(10.0, min=0.01, help="Distance of the object plane, m."),
    grid: int = expert(3, "--grid", min=2, max=9, help="Image points per row and column."),
    focus: float = expert(1.0, min=0.01, help="Focus distance for the depth of field, m."),
    f_number: float = expert(2.0, min=0.1, help="f-number of the lens."),
    confusion: float | None = expert(
        None, min=1e-6, help="Circle of confusion, mm; default: image diagonal/2000."
    ),
    thermometer_sd: float | None = expert(
        None, min=0.0, help="Standard deviation of a reading, K; default: estimated."
    ),
    exterior: opt.Exterior = "auto",
    free: opt.Free = opt.DEFAULT_FREE,
    jobs: opt.Jobs = 1,
    reference: bool = expert(
        False, "--reference", help="Study the presets, and compare them with the reference study."
    ),
) -> None:
    """Analyse how a camera changes with its temperature: drift, significance, effect on the object.

    Example: thermocald study M1 M2 --report study.html --json study.json
    """
    if reference == bool(inputs):
        raise UsageError(
            "give recordings or stores to study, or --reference"
            if not inputs
            else "--reference studies the presets; give no recordings with it"
        )
    settings: dict[str, Any] = {
        "window": window, "alpha": alpha, "sets": sets, "seed": seed,
        "distance_mm": 1000 * distance, "grid": grid, "focus_mm": 1000 * focus,
        "f_number": f_number, "confusion_mm": confusion, "thermometer_sd": thermometer_sd,
        "jobs": jobs,
    }  # fmt: skip
    if reference:
        with progress(None, "simulating, adjusting, studying") as advance:
            result = tc.reference_study(progress=advance, **settings)
    else:
        result = _study(inputs or [], settings, exterior, free)
    written = [f"written: {result.report(report)}"] if report is not None else []
    if figures is not None:
        written.append(f"written: {len(result.save_figures(figures))} files in {figures}")
    show(result, json, result, *written)


def _study(inputs: list[str], settings: dict[str, Any], exterior: str, free: str) -> Study:
    labels: list[str | None] = []
    series: list[tc.Series] = []
    for text in inputs:
        label, equals, rest = text.partition("=")
        # A path may contain "=": a text that exists as a path is one.
        if not equals or Path(text).exists() or is_server(text):
            label, rest = "", text
        elif not label or not rest:
            what = "recording or store after" if label else "label before"
            raise UsageError(f"{text}: the {what} = is empty")
        found = tc.open_all(rest)
        labels += [label or None] * len(found)
        series += found
    cameras = len({label or one.camera for label, one in zip(labels, series, strict=True)})
    with progress(settings["sets"] * cameras, "calibrating and simulating") as advance:
        return tc.study(
            *series, labels=labels, **settings, exterior=exterior, free=free, progress=advance
        )


def discover(
    recording: Path | None = typer.Argument(
        None, metavar="M1", help="The series to explain: a recording, a store, postgresql://…"
    ),
    verify: list[Path] | None = typer.Option(
        None, help="M2: another series of this camera, to verify the effect; repeatable."
    ),
    model: Path | None = typer.Option(None, help="Model so far (YAML); default: the base model."),
    json: opt.Json = None,
    model_out: Path | None = typer.Option(None, help="Write the model with the effects found."),
    effect_out: Path | None = expert(None, help="Write the effects found to a file (YAML)."),
    report: Path | None = typer.Option(None, help="Write a report to an HTML file."),
    jobs: opt.Jobs = 1,
    plan: bool = typer.Option(
        False, "--plan", help="Predict which effects a set-up would reveal, before any heating."
    ),
    preset: str | None = typer.Option(None, help="With --plan: a camera of the reference study."),
    testfield: str | None = typer.Option(None, help="With --plan: a testfield.csv."),
    programme: Path | None = typer.Option(None, help="With --plan: the programme (YAML)."),
    strength: float = expert(0.1, min=0.001, help="With --plan: size of an effect, px."),
    seeds: int = expert(2, min=1, max=50, help="With --plan: number of repetitions."),
) -> None:
    """Find where simulation and measurement disagree, name the missing effect and verify it.

    Example: thermocald discover M1 --verify M2 --model-out camera.yaml --report discovery.html
    """
    if plan:
        with progress(None, "planning") as advance:
            planned = tc.plan(
                None if recording is None else tc.open(recording), preset=preset, model=model,
                testfield=testfield, programme=programme, strength_px=strength, seeds=seeds,
                progress=advance,
            )  # fmt: skip
        show(planned, json)
        return
    if recording is None:
        raise UsageError("M1 is missing: the recording or store to explain")
    others = [tc.open(path) for path in verify or ()]
    found = tc.discover(tc.open(recording), verify=others, model=model, jobs=jobs, say=say)
    document = found.as_dict()
    if model_out is not None:
        document["model"] = str(found.save(model_out))
    if effect_out is not None and found.save_effects(effect_out) is None:
        say(f"{effect_out}: not written: no effect was found that another recording would show")
    if report is not None:
        found.report(report)
    show(document, json, found)


@opt.takes_log_options
def fit(
    inputs: list[str] = typer.Argument(
        ...,
        metavar="RECORDING_OR_STORE",
        help="Recordings and stores; or JSON files of `calibrate`, each with its temperature, °C: "
        "21.5=cold.json.",
    ),
    output: Path = typer.Option(..., "-o", "--output", help="The model file to write."),
    effect: list[str] | None = typer.Option(
        None, help="NAME[:PARAMETER=VALUE,…]: an effect to add to the base model; repeatable."
    ),
    model: Path | None = typer.Option(
        None, help="Fit the effects of this thermal model (YAML), such as one from `discover`."
    ),
    reference_temperature: float | None = expert(
        None, "--t0", help="Reference temperature, °C; default: the mean."
    ),
    type_name: str | None = typer.Option(
        None,
        "--type",
        metavar="NAME|MODEL",
        help="NAME: fit several cameras and write the model of their type. MODEL: the model file "
        "of a camera's type, which supports its fit if it was measured at few temperatures.",
    ),
    code: Path | None = expert(None, help="Also write the model as FILE.h (C, C++) and FILE.py."),
    report: Path | None = typer.Option(None, help="Write the model's certificate to an HTML file."),
    log: Path | None = typer.Option(
        None, help="For calibrations: log of temperatures at the times of their photographs."
    ),
    temperature_sd: float = expert(
        0.1, min=0.0, help="Standard deviation of a calibration's temperature, K."
    ),
    jobs: opt.Jobs = 1,
    timezone: opt.Timezone = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: opt.Json = None,
) -> None:
    """Fit a thermal model to all series of a camera, in one adjustment over all image points.

    Instead of series, calibrations at two or more temperatures can be given.

    Example: thermocald fit M1 M2 -o camera.thermal.yaml --effect thermal_lag

    Example: thermocald fit 21.5=cold.json 48=warm.json -o camera.thermal.yaml
    """
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
        if type_name is not None and ("/" in type_name or Path(type_name).is_file()):
            kind = Path(type_name)
        series = [one for source in inputs for one in tc.open_all(source)]
        with progress(None, "reading and measuring") as advance:
            camera = tc.fit(
                *series, effects=effect or (), model=model, T0=reference_temperature, kind=kind,
                jobs=jobs, progress=advance,
            )  # fmt: skip
    document = {**camera.as_dict(), "model": str(camera.save(output))}
    if code is not None:
        from thermocald.output.thermal_model import write_code

        document["code"] = [str(file) for file in write_code(camera, code)]
    if report is not None:
        camera.report(report)
    show(document, json, f"{output}: {camera}")


def _temperatures(inputs: list[str]) -> dict[str, float | None]:
    """Return {file: °C or None} of calibrations, {} if the inputs are series.

    Raises UsageError for a mixture of both, or for a label that is not a temperature.
    """
    found: dict[str, float | None] = {}
    for text in inputs:
        label, equals, rest = text.partition("=")
        name = rest if equals and not Path(text).exists() else text
        if Path(name).suffix != ".json":
            if found or (name == rest and Path(name).exists()):
                raise UsageError(
                    f"{text}: is not a calibration; fit series and calibrations separately"
                )
            return {}
        try:
            found[name] = float(label) if name == rest else None
        except ValueError:
            raise UsageError(f"{text}: {label!r} is not a temperature in °C") from None
    return found
