"""`thermocald calibrate` and `camera`: cameras calibrated, converted, compared, predicted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import progress, say, warnings_said, write_result
from thermocald.cli.options import (
    DEFAULT_FREE,
    ExtrapolateOption,
    FreeOption,
    JsonOption,
    PixelPitchOption,
)
from thermocald.errors import DataError, UsageError
from thermocald.files import make_folder


def calibrate(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE_OR_FOLDER…", help="Photographs, or folders of them."),
    ],
    testfield: Annotated[Path, typer.Option(help="testfield.csv, in mm.")],
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera file: width, height, pixel_pitch, principal_distance, interior; or one "
            "of OpenCV, ROS, COLMAP, mrcal, Kalibr, Metashape, AICON, as initial values.",
        ),
    ] = None,
    pixel_pitch: Annotated[
        float | None,
        typer.Option(
            min=1e-6, help="Size of a pixel in mm, without --camera or where that lacks it."
        ),
    ] = None,
    camera_out: Annotated[
        Path | None,
        typer.Option(
            help="Write the camera: .json with covariance (what every --camera takes), or .yaml."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write residuals and coverage as one HTML file.")
    ] = None,
    free: FreeOption = DEFAULT_FREE,
    json: JsonOption = None,
) -> None:
    """Calibrate a camera from photographs of a test field.

    All photographs share one interior orientation. Where their geometry does not carry it and the
    camera file has one, that is held and each photograph gets its pose.

    Example: thermocald calibrate photos/ --testfield testfield.csv --pixel-pitch 0.00112
    --camera-out camera.json --report calibration.html
    """
    import thermocald as tc

    for out in (camera_out, report):
        if out is not None:  # what cannot be made is refused before the work
            make_folder(out.absolute().parent)
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
    written = []
    if camera_out is not None:
        written.append(str(result.save(camera_out)))
    if report is not None:
        written.append(str(result.report(report)))
    if write_result(result.as_dict(), json):
        typer.echo("\n".join([str(result), *(f"written: {line}" for line in written)]))
    if not result.posed:
        raise DataError(f"no photograph has a result: {result.photographs.reason}")


_FORMATS = "opencv, ros, colmap, mrcal, kalibr, metashape, aicon, json"


def convert(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="A camera file.")],
    to: Annotated[str, typer.Option(help=f"Format to write: {_FORMATS}.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")],
    from_: Annotated[
        str | None, expert("--from", help="Format of FILE; default: told by its content.")
    ] = None,
    pixel_pitch: Annotated[
        float | None, typer.Option(help="Size of a pixel in mm, where FILE does not say it.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Convert a camera file, exactly where the conventions allow, else by a fit whose residual is
    stated.

    Example: thermocald camera convert calibration.xml --to opencv --out camera.yaml
    """
    import thermocald as tc

    found = tc.convert_camera(source, out, to, format=from_, pixel_pitch=pixel_pitch)
    if write_result(found.as_dict(), json):
        typer.echo(str(found))


def at(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A thermal model, from `fit`.")],
    temperature: Annotated[float, typer.Option(help="°C: a camera that has long been there.")],
    to: Annotated[str, typer.Option(help=f"Format to write: {_FORMATS}, pyorc.")] = "json",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file to write.")] = None,
    renew: Annotated[
        Path | None, typer.Option(help="With --to pyorc: its camera configuration.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(help="With --to pyorc: the image its points were clicked in.")
    ] = None,
    frame: Annotated[
        Path | None, typer.Option(help="With --to pyorc: measure its points in this image.")
    ] = None,
    extrapolate: ExtrapolateOption = False,
    json: JsonOption = None,
) -> None:
    """Give the camera at one temperature, as a file of any program.

    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to ros -o cam.yaml
    Example: thermocald camera at camera.thermal.yaml --temperature 35 --to pyorc --renew site.json
    --reference clicked.jpg --frame now.jpg -o warm.json
    """
    import thermocald as tc
    from thermocald.output import pyorc

    if (to == "pyorc") != (renew is not None) or (renew is not None and out is None):
        raise UsageError("--to pyorc needs --renew, its camera configuration, and --out")
    thermal = tc.load_camera(model)
    if renew is not None:
        thermal = thermal.for_images(*pyorc.image_size(renew))
    if thermal.warning:
        say(f"warning: {thermal.warning}")
    with warnings_said():
        found = tc.predict(thermal, temperature, extrapolate=extrapolate)
    document, lines = found.as_dict(), found.lines()
    if out is not None:
        assert found.state is not None
        comment = f"{thermal.model.camera} at {temperature:g} °C, of {model.name}"
        if renew is None:
            statement = found.state.write(out, to, comment)
        else:
            renewed = pyorc.renew_configuration(renew, found.state, reference, frame)
            if renewed.control.assumed:
                say(renewed.control.assumed)
            statement = renewed.write(out)
        document |= {"out": str(out), "out_format": to, "statement": statement}
        lines.append(f"{out} ({to}): {statement}")
    if write_result(document, json):
        typer.echo("\n".join(lines))


def diff(
    cold: Annotated[Path, typer.Argument(help="A camera file of any format.")],
    warm: Annotated[Path, typer.Argument(help="Another, of the same sensor.")],
    pixel_pitch: PixelPitchOption = None,
    report: Annotated[
        Path | None, typer.Option(help="Draw where in the image they differ, one HTML file.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Compare two cameras: parameters, and by how much the image differs (WARM minus COLD).

    With standard deviations where both files have a covariance.

    Example: thermocald camera diff cold.json warm.json
    """
    import thermocald as tc

    found = tc.compare_cameras(cold, warm, pixel_pitch=pixel_pitch)
    if report is not None:
        found.report(report)
    if write_result(found.as_dict(), json):
        typer.echo(str(found))


group = subcommands(at=at, convert=convert, diff=diff)
