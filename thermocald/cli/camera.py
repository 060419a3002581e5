"""`thermocald camera convert`: a camera file of one program for another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.options import JsonOption

__all__ = ["group"]

_FORMATS = "opencv, ros, colmap, mrcal, kalibr, metashape, aicon, json"


def _group() -> None:
    """Camera files of other programs."""


def convert(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="A camera file.")],
    to: Annotated[str, typer.Option(help=f"Format to write: {_FORMATS}.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")],
    from_: Annotated[
        str | None, typer.Option("--from", help="Format of FILE; default: told by its content.")
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
    from thermocald.cli.common import write_json
    from thermocald.output import camera_files

    camera = camera_files.read(source, from_, pixel_pitch)
    read = "exact" if camera.exact else f"fitted, largest residual {camera.largest_px:.3g} px"
    statement = camera_files.write(
        camera.model, out, to, camera.covariance,
        f"converted from {source.name} ({camera.format}, {read})", camera.name,
    )  # fmt: skip
    interior = camera.model.interior
    if json is not None:
        sensor = camera.model.sensor
        document = {
            "format": "thermocald-camera-conversion/1",
            "source": str(source),
            "source_format": camera.format,
            "exact_import": camera.exact,
            "largest_px": camera.largest_px,
            "rms_px": camera.rms_px,
            "out": str(out),
            "out_format": to,
            "statement": statement,
            "width": sensor.width,
            "height": sensor.height,
            "pixel_pitch": sensor.pixel_pitch,
            **{name: getattr(interior, name) for name in type(interior).__dataclass_fields__},
        }
        write_json(document, json)
    if json != "-":
        typer.echo(f"{source} ({camera.format}): {read}")
        typer.echo(f"{out} ({to}): {statement}")


group = typer.Typer(help="Camera files of other programs.", no_args_is_help=True)
group.callback()(_group)
group.command("convert")(convert)
