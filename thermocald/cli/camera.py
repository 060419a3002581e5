"""`thermocald calibrate`, `camera`, `predict`, `correct`, `measure`: calibrate and use a camera."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import (
    progress,
    say,
    say_warning,
    show,
    two_numbers,
    warnings_said,
    write_json,
    write_parts,
)
from thermocald.errors import DataError, UsageError
from thermocald.numbers import counted


def calibrate(
    images: opt.Photos,
    testfield: Path = typer.Option(..., help="The test field, testfield.csv, in mm."),
    camera: Path | None = typer.Option(
        None,
        help="Camera file with initial values: width, height, pixel_pitch, principal_distance, "
        "interior; or a file of OpenCV, ROS, COLMAP, mrcal, Kalibr, Metashape, AICON.",
    ),
    pixel_pitch: opt.PixelPitch = None,
    camera_out: Path | None = typer.Option(
        None, help="Write the camera, which every --camera reads: .json with covariance, or .yaml."
    ),
    report: Path | None = typer.Option(None, help="Write residuals and coverage to an HTML file."),
    free: opt.Free = opt.DEFAULT_FREE,
    json: opt.Json = None,
) -> None:
    """Calibrate a camera from photographs of a test field.

    All photographs share one interior orientation. If their geometry cannot determine it and the
    camera file gives one, that one is held fixed and only the poses are estimated.

    Example: thermocald calibrate photos/ --testfield field.csv --pixel-pitch 0.00112
    --camera-out camera.json --report calibration.html
    """
    if camera_out is not None and camera_out.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise UsageError(
            f"{camera_out}: --camera-out writes .json or .yaml; for another format use "
            "`thermocald camera convert`"
        )
    with progress(None, "measuring") as advance:
        result = tc.calibrate(
            images, testfield, camera=camera, pixel_pitch=pixel_pitch, free=free,
            progress=advance,
        )  # fmt: skip
    written = [f"written: {result.save(camera_out)}"] if camera_out is not None else []
    if report is not None:
        written.append(f"written: {result.report(report)}")
    show(result, json, result, *written)
    if not (result.status == "ok" or result.poses):
        raise DataError(f"no photograph has a result: {result.reason}")


_FORMATS = "opencv, ros, colmap, mrcal, kalibr, metashape, aicon, json, yaml"


def convert(
    source: Path = typer.Argument(..., metavar="FILE", help="The camera file to convert."),
    to: str = typer.Option(..., help=f"Format to write: {_FORMATS}."),
    out: Path = typer.Option(..., "--out", "-o", help="The file to write."),
    from_: str | None = expert(None, "--from", help="Format of FILE; default: by its content."),
    pixel_pitch: opt.PixelPitch = None,
    json: opt.Json = None,
) -> None:
    """Convert a camera file to another format.

    The conversion is exact where the conventions of both formats allow it; otherwise it is a fit
    whose residual is reported.

    Example: thermocald camera convert calibration.xml --to opencv --out camera.yaml
    """
    show(tc.convert_camera(source, out, to, format=from_, pixel_pitch=pixel_pitch), json)


def at(
    model: Path = typer.Argument(..., metavar="MODEL", help="Thermal model (YAML), from `fit`."),
    temperature: float = typer.Option(..., help="Steady temperature of the camera, °C."),
    to: str = typer.Option("json", help=f"Format to write: {_FORMATS}, pyorc."),
    out: Path | None = typer.Option(None, "--out", "-o", help="The file to write."),
    renew: Path | None = typer.Option(None, help="With --to pyorc: the configuration to update."),
    reference: Path | None = typer.Option(
        None, help="With --to pyorc: the image in which the control points were clicked."
    ),
    frame: Path | None = typer.Option(
        None, help="With --to pyorc: the image in which to measure the control points."
    ),
    extrapolate: opt.Extrapolate = False,
    json: opt.Json = None,
) -> None:
    """Predict the camera at one temperature and write it in any supported format.

    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to ros -o cam.yaml

    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to pyorc --renew site.json
    --reference clicked.jpg --frame now.jpg -o warm.json
    """
    from thermocald.output import series_export

    if (to == "pyorc") != (renew is not None) or (renew is not None and out is None):
        raise UsageError("--to pyorc needs --renew FILE (its camera configuration) and --out FILE")
    thermal = tc.load_camera(model)
    if renew is not None:
        thermal = thermal.for_images(*series_export.image_size(renew))
    with warnings_said():
        found = tc.predict(thermal, temperature, extrapolate=extrapolate)
    document, lines = found.as_dict(), found.lines()
    if out is not None:
        assert found.state is not None
        comment = f"{thermal.model.camera} at {temperature:g} °C, of {model.name}"
        if renew is None:
            statement = found.state.write(out, to, comment)
        else:
            renewed = series_export.renew_configuration(renew, found.state, reference, frame)
            if renewed.control.assumed:
                say(renewed.control.assumed)
            statement = renewed.write(out)
        document |= {"out": str(out), "out_format": to, "statement": statement}
        lines.append(f"{out} ({to}): {statement}")
    say_warning(thermal)
    show(document, json, *lines)


def diff(
    cold: Path = typer.Argument(..., help="A camera file of any format."),
    warm: Path = typer.Argument(..., help="A second camera file, of the same sensor."),
    pixel_pitch: opt.PixelPitch = None,
    report: Path | None = typer.Option(
        None, help="Write a map of the differences in the image to an HTML file."
    ),
    json: opt.Json = None,
) -> None:
    """Compare two cameras: differences of parameters and of image points (WARM minus COLD).

    Standard deviations are given if both files have a covariance.

    Example: thermocald camera diff cold.json warm.json
    """
    found = tc.compare_cameras(cold, warm, pixel_pitch=pixel_pitch)
    if report is not None:
        found.report(report)
    show(found, json)


group = subcommands(at=at, convert=convert, diff=diff)


@opt.takes_log_options
def predict(
    model: opt.Model,
    temperature: float | None = typer.Option(None, help="Steady temperature of the camera, °C."),
    log: Path | None = typer.Option(None, help="Temperatures: a log file, a recording or a store."),
    test: Path | None = typer.Option(
        None, help="Test the model: compare its prediction with this recording or store."
    ),
    programme: Path | None = typer.Option(None, help="Programme (YAML) for advice on warming up."),
    camera: Path | None = typer.Option(None, help="Camera file (YAML), for --programme."),
    channel: list[str] | None = expert(None, help="NAME=°C of a further thermometer; repeatable."),
    distance: float = expert(10.0, min=0.01, help="Distance to the object, m."),
    wanted: float = expert(5.0, "--wanted-mm", min=1e-3, help="Tolerated error on the object, mm."),
    extrapolate: opt.Extrapolate = False,
    log_options: Any = None,
    json: opt.Json = None,
) -> None:
    """Predict the interior orientation and its standard deviations.

    Example: thermocald predict --model camera.thermal.yaml --temperature 35
    """
    thermal = tc.load_camera(model)
    with warnings_said(), progress(None, "reading and measuring") as advance:
        found = tc.predict(
            thermal, temperature, channels=_channels(channel or []) or None, log=log,
            log_options=log_options, test=() if test is None else tc.open_all(test),
            programme=programme, camera=camera, distance_m=distance, wanted_mm=wanted,
            extrapolate=extrapolate, progress=advance,
        )  # fmt: skip
    say_warning(thermal)
    show(found, json)


def _channels(given: list[str]) -> dict[str, float]:
    found = {}
    for text in given:
        try:
            name, value = text.split("=")
            found[name] = float(value)
        except ValueError:
            raise UsageError(f"--channel {text}: write NAME=°C, such as lens=48.5") from None
    return found


@opt.takes_log_options
def correct(
    model: opt.Model,
    log: opt.Log,
    points: Path = typer.Argument(
        ...,
        metavar="POINTS.csv",
        help="Columns time, x, y (px) and any others; or time, image; - is standard input.",
    ),
    out: str = typer.Option(
        "-", "--out", "-o", help="CSV file (points; - is standard output) or folder (images)."
    ),
    to: float | None = expert(None, help="Temperature to correct to, °C; default: the model's T0."),
    temperature_sd: float | None = expert(
        None,
        min=0.0,
        help="Standard deviation of a reading, K; default: as estimated by the model's fit.",
    ),
    image_size: str | None = expert(None, "--size", help="WIDTHxHEIGHT of binned images, px."),
    extrapolate: opt.Extrapolate = False,
    timezone: opt.Timezone = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: opt.Json = None,
) -> None:
    """Correct image points or images for the temperature at which they were taken.

    A row that cannot be corrected is reported with its line number; the others are corrected, and
    the exit status is 1.

    Example: thermocald correct --model camera.thermal.yaml --log weather.csv points.csv
    """
    thermal, size = tc.load_camera(model), None
    if image_size is not None:
        size = two_numbers("--size", image_size, "WIDTHxHEIGHT in px, such as 1640x1232")
    with warnings_said():
        done = tc.correct(
            points, thermal, log=log, log_options=log_options, to=to, temperature_sd=temperature_sd,
            size=size, timezone=timezone, ambiguous=ambiguous, extrapolate=extrapolate, say=say,
        )  # fmt: skip
        if done.of_images and out == "-":
            raise UsageError("--out is missing: the folder for the corrected images")
        say_warning(thermal)
        if out != "-":
            with progress(None, "correcting images") as advance:
                done.write(Path(out), advance)
        else:
            write_parts(done.rows(), os.devnull if json == "-" else "-")
    write_json(done, json)
    if json != "-" and out != "-":
        typer.echo(f"{out}: {done}")
    done.require_all()


@opt.takes_log_options
def measure(
    model: opt.Model,
    log: opt.Log,
    points: Path = typer.Argument(
        ..., metavar="POINTS.csv", help="Columns time, name, x, y, sx, sy (px)."
    ),
    control: Path = typer.Option(
        ...,
        help="Control points and their image points: target, X, Y, Z, sX, sY, sZ, x, y, sx, sy.",
    ),
    seen: str = typer.Option(..., metavar="TIME", help="When the control points were observed."),
    plane: Path = typer.Option(..., help="Surface (YAML): level, plane, line or profile, with sd."),
    length_unit: str = typer.Option("mm", help="Unit of control points and surface: mm or m."),
    extrapolate: opt.Extrapolate = False,
    timezone: opt.Timezone = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: opt.Json = None,
) -> None:
    """Measure the positions of image points on a water surface, a plane or a staff.

    Each position has a standard deviation, and is compared with the position that would result
    without the thermal model. A row that cannot be measured is reported with its line number; the
    exit status then is 1.

    Example: thermocald measure points.csv --model camera.thermal.yaml --log weather.csv
    --control gcp.csv --seen 2026-05-04T09:00:00Z --plane water.yaml --length-unit m
    """
    thermal = tc.load_camera(model)
    with warnings_said():
        found = tc.measure(
            points, thermal, log=log, control=control, seen=seen, surface=plane, unit=length_unit,
            log_options=log_options, timezone=timezone, ambiguous=ambiguous,
            extrapolate=extrapolate, say=say,
        )  # fmt: skip
    say_warning(thermal)
    show(found, json)
    if found.refused:
        raise DataError(f"{points}: {counted(len(found.refused), 'row')} left out")
