"""`thermocald calibrate`: photographs of a test field give the camera, or where it stood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.cli.common import progress, write_json
from thermocald.cli.options import (
    DEFAULT_FREE_TEXT,
    CameraFile,
    FreeOption,
    JsonOption,
    adjustment_settings,
    read_camera,
)
from thermocald.errors import DataError, ImageError, UsageError
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, Sensor

if TYPE_CHECKING:
    from thermocald.analysis.camera.photographs import PhotographResult, Photographs

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(calibrate)


def calibrate(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE…", help="Photographs.")],
    testfield: Annotated[Path, typer.Option("--testfield", help="testfield.csv, in mm.")],
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            help="Camera file: width, height, pixel_pitch, principal_distance, interior; or one "
            "of OpenCV, ROS, COLMAP, mrcal, Kalibr, Metashape, AICON, as initial values.",
        ),
    ] = None,
    pixel_pitch: Annotated[
        float | None,
        typer.Option("--pixel-pitch", help="Size of a pixel in mm, where --camera lacks it."),
    ] = None,
    free: FreeOption = DEFAULT_FREE_TEXT,
    json: JsonOption = None,
) -> None:
    """Calibrate a camera from photographs of a test field.

    All photographs share one interior orientation. Where their geometry does not carry it and the
    camera file has one, that is held and each photograph gets its pose.

    Example: thermocald calibrate a.jpg b.jpg --testfield testfield.csv --camera rpi.yaml --json -
    """
    from thermocald.analysis.camera.photographs import calibrate_photographs
    from thermocald.store.recording.reader import read_testfield

    if not images:
        raise UsageError("give at least one photograph")
    field = read_testfield(testfield)
    file = read_camera(camera, pixel_pitch) if camera is not None else _unknown_camera(images)
    with progress(len(images), "measuring") as advance:
        result = calibrate_photographs(
            images,
            field,
            file.sensor,
            adjustment_settings(free),
            file.principal_distance,
            file.interior,
            advance,
        )
    document = _document(result, file, camera is None)
    if json is not None:
        write_json(document, json)
    if json != "-":
        _tell(document)
    if not any(p.status == "ok" for p in result.photographs) and result.status != "ok":
        raise DataError(f"no photograph has a result: {result.reason}")


def _unknown_camera(images: list[Path]) -> CameraFile:
    """A camera of which only the size of the image is known: its pixel counts as 1 µm."""
    from thermocald.photogrammetry.targets.image_file import decode_grey

    first: ImageError | None = None
    for path in images:
        try:
            height, width = decode_grey(path).shape
        except ImageError as error:
            first = first or error
            continue
        return CameraFile("unknown", Sensor(width, height, 0.001), None, None)
    assert first is not None
    raise first


def _document(result: Photographs, file: CameraFile, assumed: bool) -> dict[str, Any]:
    document: dict[str, Any] = {
        "format": "thermocald-calibration/1",
        "camera": {
            "name": file.name,
            "width": file.sensor.width,
            "height": file.sensor.height,
            "pixel_pitch": file.sensor.pixel_pitch,
            "pixel_pitch_assumed": assumed,
        },
        "status": result.status,
        "reason": result.reason,
        "sigma0": result.sigma0,
        "redundancy": result.redundancy,
        "n_photographs": len(result.photographs),
        "interior": None,
        "correlations": None,
        "photographs": [_photograph(p) for p in result.photographs],
    }
    if result.interior is not None:
        values = result.interior.as_array()
        document["interior_estimated"] = result.estimated
        document["interior"] = dict(zip(IOP_NAMES, values.tolist(), strict=True))
        if result.estimated:
            sd = np.sqrt(np.diag(result.covariance)[:10])
            free = sd > 0
            document["interior"] |= {
                f"sd_{n}": float(s) for n, s, f in zip(IOP_NAMES, sd, free, strict=True) if f
            }
            rows = np.flatnonzero(free)
            r = result.covariance[np.ix_(rows, rows)] / np.outer(sd[rows], sd[rows])
            document["correlations"] = {"names": [IOP_NAMES[i] for i in rows], "matrix": r}
    return document


def _photograph(p: PhotographResult) -> dict[str, Any]:
    out: dict[str, Any] = {
        "image": p.path,
        "status": p.status,
        "reason": p.reason,
        "n_targets": p.n_targets,
        "n_rejected": len(p.rejected),
        "rejected": list(p.rejected),
        "rms_px": p.rms_px,
        "exterior": None,
    }
    if p.exterior is not None:
        values = p.exterior.as_array()
        out["exterior"] = dict(zip(EOP_NAMES, values.tolist(), strict=True))
        out["exterior"] |= {
            f"sd_{n}": float(s) for n, s in zip(EOP_NAMES, p.exterior_sd, strict=True)
        }
    return out


def _tell(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    interior = document["interior"]
    if document["status"] == "ok":
        console.print(
            f"calibrated from {document['n_photographs']} photographs: sigma0 "
            f"{document['sigma0']:.2f}, redundancy {document['redundancy']}",
            highlight=False,
        )
        table = Table(box=None, pad_edge=False)
        for title in ("", "value", "sd"):
            table.add_column(title, justify="left" if not title else "right")
        for name in IOP_NAMES:
            sd = interior.get(f"sd_{name}")
            table.add_row(name, f"{interior[name]:.6g}", "held" if sd is None else f"{sd:.2g}")
        console.print(table, highlight=False)
        if document["camera"]["pixel_pitch_assumed"]:
            console.print(
                "the pixel pitch is not known and taken as 1 µm: c, x0, y0 in mm are thousandths "
                "of px; give --camera",
                highlight=False,
            )
    else:
        console.print(
            f"not calibrated: {document['status']}: {document['reason']}", highlight=False
        )
    for p in document["photographs"]:
        line = f"{p['image']}: {p['status']}, {p['n_targets']} targets"
        if p["exterior"] is not None:
            e = p["exterior"]
            line += f", {p['rms_px']:.2f} px, at " + ", ".join(
                f"{e[n]:.0f} ± {e['sd_' + n]:.0f}" for n in ("X0", "Y0", "Z0")
            )
            line += " mm"
        if p["reason"]:
            line += f": {p['reason']}"
        console.print(line, highlight=False)
