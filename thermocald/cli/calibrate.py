"""`thermocald calibrate`: photographs of a test field give the camera, or where it stood."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import progress, write_result
from thermocald.cli.options import DEFAULT_FREE, FreeOption, JsonOption
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
