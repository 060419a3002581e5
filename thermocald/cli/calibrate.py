"""`thermocald calibrate`: photographs of a test field give the camera, or where it stood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.atomic_file import make_folder, write_text
from thermocald.cli.camera_file import CameraFile, read_camera
from thermocald.cli.common import progress, write_result
from thermocald.cli.options import (
    DEFAULT_FREE_TEXT,
    FreeOption,
    JsonOption,
    adjustment_settings,
)
from thermocald.errors import DataError, ImageError, UsageError
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, Sensor

if TYPE_CHECKING:
    from thermocald.analysis.camera.photographs import PhotographResult, Photographs

__all__ = ["calibrate"]

_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff", ".webp"})
_ASSUMED_PITCH = 0.001


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
    free: FreeOption = DEFAULT_FREE_TEXT,
    json: JsonOption = None,
) -> None:
    """Calibrate a camera from photographs of a test field.

    All photographs share one interior orientation. Where their geometry does not carry it and the
    camera file has one, that is held and each photograph gets its pose.

    Example: thermocald calibrate photos/ --testfield testfield.csv --pixel-pitch 0.00112
    --camera-out camera.json --report calibration.html
    """
    from thermocald.analysis.camera.photographs import calibrate_photographs
    from thermocald.store.recording.reader import read_testfield

    images = _photographs(images)
    for out in (camera_out, report):
        if out is not None:  # what cannot be made is refused before the work
            make_folder(out.absolute().parent)
    if camera_out is not None and camera_out.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise UsageError(
            f"{camera_out}: --camera-out writes .json or .yaml; for another program convert it "
            "with `thermocald camera convert`"
        )
    field = read_testfield(testfield)
    if camera is not None:
        file = read_camera(camera, pixel_pitch)
    else:
        file = _unknown_camera(images, pixel_pitch)
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
    assumed = camera is None and pixel_pitch is None
    document = _document(result, file, assumed)
    written = _write(result, file, camera_out, report)
    if write_result(document, json):
        _print(document)
        for line in written:
            typer.echo(f"written: {line}")
    if not any(p.status == "ok" for p in result.photographs) and result.status != "ok":
        raise DataError(f"no photograph has a result: {result.reason}")


def _photographs(given: list[Path]) -> list[Path]:
    """Files as given, folders as the images that they hold, by name; UsageError where none."""
    images: list[Path] = []
    for path in given:
        if not path.is_dir():
            images.append(path)
            continue
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in _IMAGES)
        if not found:
            raise UsageError(f"{path}: the folder holds no image ({', '.join(sorted(_IMAGES))})")
        images += found
    if not images:
        raise UsageError("give at least one photograph")
    return images


def _unknown_camera(images: list[Path], pixel_pitch: float | None) -> CameraFile:
    """A camera of which no file says anything; without its pitch a pixel counts as 1 µm."""
    from thermocald.photogrammetry.targets.image_file import decode_grey

    first: ImageError | None = None
    for path in images:
        try:
            height, width = decode_grey(path).shape
        except ImageError as error:
            first = first or error
            continue
        pitch = _ASSUMED_PITCH if pixel_pitch is None else pixel_pitch
        return CameraFile("camera", Sensor(width, height, pitch), None, None)
    assert first is not None
    raise first


def _write(
    result: Photographs, file: CameraFile, camera_out: Path | None, report: Path | None
) -> list[str]:
    """The files that were asked for; returns their names."""
    written = []
    if camera_out is not None:
        if result.interior is None or not result.estimated:
            raise DataError(
                f"{camera_out}: not written, the camera was not calibrated: {result.reason}"
            )
        _write_camera(camera_out, result, file)
        written.append(str(camera_out))
    if report is not None:
        from thermocald.output.calibration.report import render_calibration
        from thermocald.output.study.report import write_report

        write_report(report, render_calibration(result, file.sensor, file.name))
        written.append(str(report))
    return written


def _write_camera(path: Path, result: Photographs, file: CameraFile) -> None:
    assert result.interior is not None
    comment = (
        f"calibrated by thermocald from {len(result.photographs)} photographs, "
        f"sigma0 {result.sigma0:.2f}"
    )
    if path.suffix.lower() == ".json":
        from thermocald.output import camera_files
        from thermocald.photogrammetry.camera.camera_model import CameraModel

        model = CameraModel(file.sensor, result.interior)
        covariance = result.covariance[:10, :10]
        camera_files.write(model, path, "json", covariance, comment, file.name)
        return
    import yaml

    values = dict(zip(IOP_NAMES, result.interior.as_array().tolist(), strict=True))
    document = {
        "name": file.name,
        "width": file.sensor.width,
        "height": file.sensor.height,
        "pixel_pitch": file.sensor.pixel_pitch,
        "principal_distance": values["c"],
        "interior": values,
    }
    write_text(path, f"# {comment}\n{yaml.safe_dump(document, sort_keys=False)}")


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


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from thermocald.output.figures.numbers import UNITS, plain, with_sd

    console = Console()
    interior = document["interior"]
    if document["status"] == "ok":
        typer.echo(
            f"calibrated from {document['n_photographs']} photographs: sigma0 "
            f"{document['sigma0']:.2f}, redundancy {document['redundancy']}"
        )
        table = Table(box=None, pad_edge=False)
        for title in ("", "value ± sd", "in px"):
            table.add_column(title)
        pitch = document["camera"]["pixel_pitch"]
        for name in IOP_NAMES:
            sd = interior.get(f"sd_{name}")
            if sd is None:
                table.add_row(name, f"{plain(interior[name], UNITS[name], 6)} (held)", "")
                continue
            px = with_sd(interior[name] / pitch, sd / pitch) if name in ("c", "x0", "y0") else ""
            table.add_row(name, with_sd(interior[name], sd, UNITS[name]), px)
        console.print(table, highlight=False)
        if document["camera"]["pixel_pitch_assumed"]:
            typer.echo(
                "the pixel pitch is not known and taken as 1 µm: c, x0, y0 in mm are thousandths "
                "of px; give --pixel-pitch or --camera"
            )
    else:
        typer.echo(f"not calibrated: {document['status']}: {document['reason']}")
    for p in document["photographs"]:
        line = f"{p['image']}: {p['status']}, {p['n_targets']} targets"
        if p["exterior"] is not None:
            e = p["exterior"]
            line += f", {p['rms_px']:.2f} px, at " + ", ".join(
                with_sd(e[n], e["sd_" + n]) for n in ("X0", "Y0", "Z0")
            )
            line += " mm"
        if p["reason"]:
            line += f": {p['reason']}"
        typer.echo(line)
