"""`thermocald camera`: one at a temperature, two compared, files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import say, warnings_said, write_result
from thermocald.cli.options import ExtrapolateOption, JsonOption, PixelPitchOption
from thermocald.errors import UsageError

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
