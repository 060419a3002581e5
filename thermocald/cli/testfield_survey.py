"""`thermocald testfield survey`: coordinates of a field from photographs of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.common import say
from thermocald.cli.options import JsonOption, PhotosArgument, PixelPitchOption
from thermocald.cli.testfield_options import (
    CameraFile,
)
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.photogrammetry.network.adjustment import Distance
    from thermocald.photogrammetry.survey.survey import Survey

__all__ = ["survey"]

_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm"}
_EOP = ("omega", "phi", "kappa", "X0", "Y0", "Z0")


def survey(
    photos: PhotosArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="The testfield.csv to write.")],
    scale: Annotated[
        tuple[str, str, float] | None,
        typer.Option(metavar="A B MM", help="Two targets and their measured distance."),
    ] = None,
    scale_sd: Annotated[float, typer.Option(min=1e-6, help="Its standard deviation, mm.")] = 0.1,
    distances: Annotated[
        Path | None, typer.Option(help="More of them, a CSV: a, b, length, sigma in mm.")
    ] = None,
    field: Annotated[
        Path | None, typer.Option(help="The nominal testfield.csv, as printed; for plain circles.")
    ] = None,
    camera: CameraFile = None,
    hold_camera: Annotated[
        bool, typer.Option("--hold-camera", help="Trust --camera and do not calibrate it again.")
    ] = False,
    pixel_pitch: PixelPitchOption = None,
    camera_out: Annotated[
        Path | None, typer.Option(help="Write the camera that was found (JSON).")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Measure a test field from photographs of it: coordinates and their standard deviations.

    Take 8 to 12 photographs with one camera, focus and zoom untouched, from all sides, the camera
    turned by 90° in some. Do not let a program rotate or crop them afterwards.

    Example: thermocald testfield survey photos/ --field field/testfield.csv --scale R65 R89 340.12
    --out surveyed.csv
    """
    from thermocald.cli.common import write_result
    from thermocald.output import camera_files
    from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
    from thermocald.photogrammetry.survey.survey import survey as run
    from thermocald.store.recording.testfield_file import read_testfield, write_testfield

    measured = _distances(scale, scale_sd, distances)
    pictures = [_picture(path) for path in _photos(photos)]
    known = None if camera is None else camera_files.read(camera, pixel_pitch=pixel_pitch).model
    if hold_camera and known is None:
        raise UsageError("--hold-camera needs --camera")
    pitch = known.sensor.pixel_pitch if known is not None else pixel_pitch
    if pitch is None:
        pitch = 0.001
        say("pixel pitch not given: 0.001 mm assumed, the camera's mm are only as good")
    result = run(
        pictures,
        measured,
        pitch,
        nominal=None if field is None else read_testfield(field),
        interior=None if known is None else known.interior,
        free=() if hold_camera else IOP_NAMES,
        progress=say,
    )
    write_testfield(out, result.field)
    if camera_out is not None:
        network = result.network
        comment = f"self-calibration in the survey of {out.name}, sigma0 {network.sigma0:.2f}"
        camera_files.write(network.camera, camera_out, "json", network.interior_covariance, comment)
    document = _survey_document(result, out)
    if write_result(document, json):
        _show_survey(result, out, document["advice"])


def _photos(paths: list[Path]) -> list[Path]:
    """The files, folders replaced by the pictures in them; UsageError for what is not there."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
            if not inside:
                raise UsageError(f"{path}: the folder holds no pictures")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise UsageError(f"{path}: there is no such file")
    if len(set(found)) < len(found):
        raise UsageError("a photograph is given twice")
    return found


def _picture(path: Path) -> Any:
    """A picture that is read when it is needed, as the sensor saw it."""
    from thermocald.photogrammetry.survey.survey import Picture
    from thermocald.photogrammetry.targets.image_file import decode_grey

    return Picture(str(path), lambda: decode_grey(path))


def _distances(
    scale: tuple[str, str, float] | None, sigma: float, file: Path | None
) -> list[Distance]:
    from thermocald.photogrammetry.network.adjustment import Distance

    found = [] if scale is None else [Distance(scale[0], scale[1], scale[2], sigma)]
    if file is not None:
        found += _read_distances(file)
    if not found:
        raise UsageError("the scale is missing: --scale A B MM, or --distances FILE")
    for d in found:
        if not (d.length > 0 and d.sigma > 0) or d.a == d.b:
            raise UsageError(f"{d.a} to {d.b}, {d.length:g} ± {d.sigma:g} mm, is not a distance")
    return found


def _read_distances(path: Path) -> list[Distance]:
    import csv

    from thermocald.photogrammetry.network.adjustment import Distance

    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream, skipinitialspace=True))
    except (OSError, UnicodeDecodeError) as cause:
        raise UsageError(f"{path}: cannot be read: {cause}") from cause
    found = []
    for number, row in enumerate(rows, start=2):
        try:
            found.append(Distance(row["a"], row["b"], float(row["length"]), float(row["sigma"])))
        except (KeyError, TypeError, ValueError):
            raise UsageError(
                f"{path}, row {number}: a, b, length, sigma (mm) are needed, it has "
                f"{', '.join(str(v) for v in row.values())}"
            ) from None
    return found


def _survey_document(result: Survey, out: Path) -> dict[str, Any]:
    from thermocald.photogrammetry.network.checks import advice

    n = result.network
    targets = []
    for i, name in enumerate(n.names):
        block = n.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        row: dict[str, Any] = {"target": name}
        for axis, letter in enumerate("XYZ"):
            row[letter] = float(n.points[i, axis])
            row[f"sd_{letter}"] = float(n.sigmas[i, axis])
        row |= {
            "covariance": block.tolist(),
            "rays": int(n.n_rays[i]),
            "angle_deg": float(n.angles[i] * 57.29577951308232),
        }
        targets.append(row)
    interior: dict[str, float] = {}
    for k, name in enumerate(type(n.camera.interior).__dataclass_fields__):
        interior[name] = float(getattr(n.camera.interior, name))
        interior[f"sd_{name}"] = float(n.interior_covariance[k, k] ** 0.5)
    stations = [
        {
            "photo": s.photo,
            "targets": s.n_targets,
            **{k: float(v) for k, v in zip(_EOP, s.exterior.as_array(), strict=True)},
            **{f"sd_{k}": v for k, v in zip(_EOP[3:], s.sd_centre, strict=True)},
        }
        for s in n.stations
    ]
    sensor = n.camera.sensor
    return {
        "format": "thermocald-survey/1",
        "testfield": str(out),
        "datum": n.datum,
        "sigma0": n.sigma0,
        "redundancy": n.redundancy,
        "relative_accuracy": n.relative_accuracy,
        "sd_scale": n.sd_scale,
        "camera": {
            "width": sensor.width, "height": sensor.height, "pixel_pitch": sensor.pixel_pitch,
            "free": list(n.free), **interior,
        },
        "targets": targets,
        "stations": stations,
        "rejected": [
            {"photo": r.photo, "target": r.target, "residual_px": r.residual, "test": r.test}
            for r in n.rejected
        ],
        "unused": n.unused,
        "measured": result.measured,
        "advice": advice(n),
    }  # fmt: skip


def _show_survey(result: Survey, out: Path, advice: list[str]) -> None:
    n = result.network
    mean = (n.sigmas**2).mean(axis=0) ** 0.5
    typer.echo(
        f"{out}: {len(n.names)} targets from {len(n.stations)} photographs, sigma0 "
        f"{n.sigma0:.2f}, redundancy {n.redundancy}, {len(n.rejected)} image points rejected"
    )
    typer.echo(
        f"  mean standard deviations {mean[0]:.4f}, {mean[1]:.4f}, {mean[2]:.4f} mm in X, Y, Z, of "
        f"which the scale's {n.sd_scale * n.extent / 2:.4f} mm at the edge; the shape alone "
        f"1:{1 / n.relative_accuracy:.0f} of the field"
    )
    typer.echo(f"  datum: {n.datum}")
    for name, reason in n.unused.items():
        typer.echo(f"  left out: {name}: {reason}")
    for note in advice:
        typer.echo(f"  better: {note}")
