"""`thermocald calibrate`, `camera`, `predict`, `correct`, `measure`: a camera and its use.

It is calibrated, converted, compared; at a temperature, with what was measured with it; places in
metres from its image points.
"""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

import typer

import thermocald as tc
from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import (
    DEFAULT_FREE,
    ExtrapolateOption,
    FreeOption,
    JsonOption,
    LogOption,
    ModelOption,
    PixelPitchOption,
    TimezoneOption,
    progress,
    say,
    show,
    takes_log_options,
    warned,
    warnings_said,
    write_json,
    write_parts,
)
from thermocald.errors import DataError, UsageError


def calibrate(
    images: list[Path] = typer.Argument(
        ..., metavar="IMAGE_OR_FOLDER…", help="Photographs, or folders of them."
    ),
    testfield: Path = typer.Option(..., help="testfield.csv, in mm."),
    camera: Path | None = typer.Option(
        None,
        help="Camera file: width, height, pixel_pitch, principal_distance, interior; or one "
        "of OpenCV, ROS, COLMAP, mrcal, Kalibr, Metashape, AICON, as initial values.",
    ),
    pixel_pitch: float | None = typer.Option(
        None,
        min=1e-5,
        max=1.0,
        help="Size of a pixel in mm, without --camera or where that lacks it.",
    ),
    camera_out: Path | None = typer.Option(
        None, help="Write the camera: .json with covariance (what every --camera takes), or .yaml."
    ),
    report: Path | None = typer.Option(None, help="Write residuals and coverage as one HTML file."),
    free: FreeOption = DEFAULT_FREE,
    json: JsonOption = None,
) -> None:
    """Calibrate a camera from photographs of a test field.

    All photographs share one interior orientation. Where their geometry does not carry it and the
    camera file has one, that is held and each photograph gets its pose.

    Example: thermocald calibrate photos/ --testfield testfield.csv --pixel-pitch 0.00112
    --camera-out camera.json --report calibration.html
    """
    if camera_out is not None and camera_out.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise UsageError(
            f"{camera_out}: --camera-out writes .json or .yaml; for another program convert it "
            "with `thermocald camera convert`"
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
    if not result.posed:
        raise DataError(f"no photograph has a result: {result.photographs.reason}")


_FORMATS = "opencv, ros, colmap, mrcal, kalibr, metashape, aicon, json"


def convert(
    source: Path = typer.Argument(..., metavar="FILE", help="A camera file."),
    to: str = typer.Option(..., help=f"Format to write: {_FORMATS}."),
    out: Path = typer.Option(..., "--out", "-o", help="The file to write."),
    from_: str | None = expert(
        None, "--from", help="Format of FILE; default: told by its content."
    ),
    pixel_pitch: float | None = typer.Option(
        None, help="Size of a pixel in mm, where FILE does not say it."
    ),
    json: JsonOption = None,
) -> None:
    """Convert a camera file, exactly where the conventions allow, else by a fit whose residual is
    stated.

    Example: thermocald camera convert calibration.xml --to opencv --out camera.yaml
    """
    found = tc.convert_camera(source, out, to, format=from_, pixel_pitch=pixel_pitch)
    show(found, json)


def at(
    model: Path = typer.Argument(..., metavar="MODEL", help="A thermal model, from `fit`."),
    temperature: float = typer.Option(..., help="°C: a camera that has long been there."),
    to: str = typer.Option("json", help=f"Format to write: {_FORMATS}, pyorc."),
    out: Path | None = typer.Option(None, "--out", "-o", help="The file to write."),
    renew: Path | None = typer.Option(None, help="With --to pyorc: its camera configuration."),
    reference: Path | None = typer.Option(
        None, help="With --to pyorc: the image its points were clicked in."
    ),
    frame: Path | None = typer.Option(
        None, help="With --to pyorc: measure its points in this image."
    ),
    extrapolate: ExtrapolateOption = False,
    json: JsonOption = None,
) -> None:
    """Give the camera at one temperature, as a file of any program.

    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to ros -o cam.yaml

    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to pyorc --renew site.json
    --reference clicked.jpg --frame now.jpg -o warm.json
    """
    from thermocald.output import series_export

    if (to == "pyorc") != (renew is not None) or (renew is not None and out is None):
        raise UsageError("--to pyorc needs --renew, its camera configuration, and --out")
    thermal = tc.load_camera(model)
    if renew is not None:
        thermal = thermal.for_images(*series_export.image_size(renew))
    warned(thermal)
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
    show(document, json, *lines)


def diff(
    cold: Path = typer.Argument(..., help="A camera file of any format."),
    warm: Path = typer.Argument(..., help="Another, of the same sensor."),
    pixel_pitch: PixelPitchOption = None,
    report: Path | None = typer.Option(
        None, help="Draw where in the image they differ, one HTML file."
    ),
    json: JsonOption = None,
) -> None:
    """Compare two cameras: parameters, and by how much the image differs (WARM minus COLD).

    With standard deviations where both files have a covariance.

    Example: thermocald camera diff cold.json warm.json
    """
    found = tc.compare_cameras(cold, warm, pixel_pitch=pixel_pitch)
    if report is not None:
        found.report(report)
    show(found, json)


group = subcommands(at=at, convert=convert, diff=diff)


@takes_log_options
def predict(
    model: ModelOption,
    temperature: float | None = typer.Option(None, help="°C: a camera that has long been there."),
    log: Path | None = typer.Option(None, help="A logger's file, a recording, or a store."),
    test: Path | None = typer.Option(
        None, help="Recording or store: how well the model predicts it."
    ),
    programme: Path | None = typer.Option(
        None, help="Warm-up advice for what is done to the camera."
    ),
    camera: Path | None = typer.Option(None, help="Camera file, for --programme."),
    channel: list[str] | None = expert(None, help="NAME=°C of another thermometer; repeatable."),
    distance: float = expert(10.0, min=0.01, help="Distance of the object, m."),
    wanted: float = expert(5.0, "--wanted-mm", min=1e-3, help="Wanted error on the object, mm."),
    extrapolate: ExtrapolateOption = False,
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Predict the interior orientation with standard deviations.

    Example: thermocald predict --model camera.thermal.yaml --temperature 35
    """
    thermal = warned(tc.load_camera(model))
    with warnings_said(), progress(None, "reading and measuring") as advance:
        found = tc.predict(
            thermal, temperature, channels=_channels(channel or []) or None, log=log,
            log_options=log_options, test=() if test is None else tc.open_all(test),
            programme=programme, camera=camera, distance_m=distance, wanted_mm=wanted,
            extrapolate=extrapolate, progress=advance,
        )  # fmt: skip
    show(found, json)


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


@takes_log_options
def correct(
    model: ModelOption,
    log: LogOption,
    points: Path = typer.Argument(
        ...,
        metavar="POINTS.csv",
        help="Columns time, x, y (px) and others; or time, image; - for standard input.",
    ),
    out: Path | None = typer.Option(None, help="CSV to write (points), or folder (images)."),
    to: float | None = expert(None, help="°C to correct to; default: the model's T0."),
    temperature_sd: float | None = expert(
        None,
        min=0.0,
        help="Standard deviation of a reading, K; default: what the model's fit found.",
    ),
    image_size: str | None = expert(None, "--size", help="WIDTHxHEIGHT where images are binned."),
    extrapolate: ExtrapolateOption = False,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Correct image points, or images, that were taken at known temperatures.

    A row that cannot be corrected is named by its line and does not stop the others; exit status 1.

    Example: thermocald correct --model camera.thermal.yaml --log weather.csv points.csv
    """
    thermal = warned(tc.load_camera(model))
    done = tc.correct(
        points, thermal, log=log, log_options=log_options, to=to, temperature_sd=temperature_sd,
        size=None if image_size is None else _size(image_size), timezone=timezone,
        ambiguous=ambiguous, extrapolate=extrapolate, say=say,
    )  # fmt: skip
    with warnings_said():
        if done.of_images and out is None:
            raise UsageError("--out is missing: the folder for the corrected images")
        if out is not None:
            with progress(None, "correcting images") as advance:
                done.write(out, advance)
        elif json == "-":
            collections.deque(done.lines(), 0)
        else:
            write_parts(done.lines(), "-")
    write_json(done, json)
    if json != "-" and out is not None:
        typer.echo(f"{out}: {done}")
    done.require_all()


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not width.isdigit() or not height.isdigit() or int(width) * int(height) == 0:
        raise UsageError(f"--size {text}: write WIDTHxHEIGHT in px, such as 1640x1232")
    return int(width), int(height)


@takes_log_options
def measure(
    model: ModelOption,
    log: LogOption,
    points: Path = typer.Argument(
        ..., metavar="POINTS.csv", help="Columns time, name, x, y, sx, sy (px)."
    ),
    control: Path = typer.Option(
        ..., help="Control points: target, X, Y, Z, sX, sY, sZ and x, y, sx, sy."
    ),
    seen: str = typer.Option(..., metavar="TIME", help="When the control points were seen there."),
    plane: Path = typer.Option(..., help="YAML: level, or plane, or line; and sd."),
    length_unit: str = typer.Option("mm", help="Unit of control points and plane: mm or m."),
    extrapolate: ExtrapolateOption = False,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Measure where image points lie on a water surface, a plane or a staff.

    Each place has its standard deviation, and stands beside what the camera would have given
    without its thermal model.

    Example: thermocald measure points.csv --model camera.thermal.yaml --log weather.csv
    --control gcp.csv --seen 2026-05-04T09:00:00Z --plane water.yaml --length-unit m
    """
    thermal = warned(tc.load_camera(model))
    with warnings_said():
        found = tc.measure(
            points, thermal, log=log, control=control, seen=seen, surface=plane, unit=length_unit,
            log_options=log_options, timezone=timezone, ambiguous=ambiguous,
            extrapolate=extrapolate, say=say,
        )  # fmt: skip
    show(found, json)
