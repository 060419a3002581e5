"""Camera files, our own and those of other programs: one entry to write and one to read.

    write(model, path, "mrcal")         → the statement of how exact the file is
    read(path) → ImportedCamera         format recognised by its content

Conventions and what is exact: docs/reference/camera_files.md and `photogrammetry.conversions`.
`read_camera` takes what `--camera` names: our own YAML, or a file of another program.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from thermocald.errors import ConfigurationError, DataError, UsageError
from thermocald.files import QuantityReader, read_yaml, write_text
from thermocald.photogrammetry.camera import conversions
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    CameraSpec,
    InteriorOrientation,
)
from thermocald.photogrammetry.camera_files.camera_record import OWN, CameraRecord, Format
from thermocald.photogrammetry.camera_files.formats import (
    AICON,
    COLMAP,
    KALIBR,
    METASHAPE,
    MRCAL,
    OPENCV,
    ROS,
)

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.arrays import Array

FORMATS: dict[str, Format] = {
    format_.name: format_ for format_ in (OPENCV, ROS, COLMAP, MRCAL, KALIBR, METASHAPE, AICON, OWN)
}
_LARGEST_FILE = 10_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ImportedCamera:
    """A camera as read: our model, how well it reproduces the file's own over the image area."""

    model: CameraModel
    format: str
    name: str
    exact: bool
    largest_px: float
    rms_px: float
    covariance: Array | None = None

    @property
    def how_read(self) -> str:
        """How well our model is the file's, in words."""
        return "exact" if self.exact else f"fitted, largest residual {self.largest_px:.3g} px"


def _format(name: str) -> Format:
    if name not in FORMATS:
        raise UsageError(f"camera file format {name!r}: there are {', '.join(FORMATS)}")
    return FORMATS[name]


def write(
    model: CameraModel,
    path: Path,
    format: str,  # noqa: A002
    covariance: Array | None = None,
    comment: str = "",
    name: str = "camera",
) -> str:
    """Write a camera; returns the statement of how exact it is, which also stands in the file.

    covariance: (10, 10) in the order of `IOP_NAMES`, goes into the formats that have room for it.
    An existing file is replaced as a whole or not at all. Raises UsageError for an unknown format,
    GeometryError if the model has no rays for part of its image.
    """
    text, statement = encode(model, format, covariance, comment, name)
    write_text(path, text)
    return statement


def encode(
    model: CameraModel,
    format: str,  # noqa: A002
    covariance: Array | None = None,
    comment: str = "",
    name: str = "camera",
) -> tuple[str, str]:
    """Return the text that `write` writes, and its statement."""
    if covariance is not None and np.shape(covariance) != (10, 10):
        raise UsageError(f"a covariance of shape {np.shape(covariance)}, not (10, 10)")
    chosen, sensor = _format(format), model.sensor
    family = chosen.family(model)
    values, covariance, exact, largest, rms = conversions.convert(
        sensor, conversions.BROWN, model.interior.as_array(), family, covariance
    )
    statement = f"fitted over the image area: largest residual {largest:.3g} px, RMS {rms:.3g} px"
    if exact:
        own = family is conversions.BROWN
        statement = f"exact: {'it is our own model' if own else 'both models give the same pixels'}"
    record = CameraRecord(
        (sensor.width, sensor.height), family, values, name, covariance,
        sensor.pixel_pitch, statement, comment,
    )  # fmt: skip
    return chosen.encode(record), statement


def read(
    path: Path,
    format: str | None = None,  # noqa: A002
    pixel_pitch: float | None = None,
) -> ImportedCamera:
    """Read a camera file; without a format it is told by the content.

    pixel_pitch: mm, for files that do not say it. Raises ConfigurationError that names the file.
    """
    text, chosen = _opened(path, format)
    try:
        record = chosen.decode(text)
        sensor = record.sensor(text, pixel_pitch)
        values, covariance, exact, largest, rms = conversions.convert(
            sensor, record.family, record.values, conversions.BROWN, record.covariance
        )
    except (ConfigurationError, DataError) as cause:
        raise ConfigurationError(f"{path} ({chosen.about}): {cause}") from cause
    model = CameraModel(sensor, InteriorOrientation.from_array(values))
    return ImportedCamera(model, chosen.name, record.name, exact, largest, rms, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """A camera file written in another format; statement: how exact what was written is."""

    source: Path
    camera: ImportedCamera
    out: Path
    to: str
    statement: str

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `camera convert` writes with `--json`."""
        camera = self.camera
        return {
            "format": "thermocald-camera-conversion/1",
            "source": str(self.source),
            "source_format": camera.format,
            "exact_import": camera.exact,
            "largest_px": camera.largest_px,
            "rms_px": camera.rms_px,
            "out": str(self.out),
            "out_format": self.to,
            "statement": self.statement,
            **asdict(camera.model.sensor),
            **asdict(camera.model.interior),
        }

    def __str__(self) -> str:
        camera = self.camera
        return (
            f"{self.source} ({camera.format}): {camera.how_read}\n"
            f"{self.out} ({self.to}): {self.statement}"
        )


def convert(
    source: Path,
    out: Path,
    to: str,
    format: str | None = None,  # noqa: A002
    pixel_pitch: float | None = None,
) -> Conversion:
    """Read a camera file and write it in another format; errors as of `read` and `write`."""
    camera = read(source, format, pixel_pitch)
    comment = f"converted from {source.name} ({camera.format}, {camera.how_read})"
    statement = write(camera.model, out, to, camera.covariance, comment, camera.name)
    return Conversion(source, camera, out, to, statement)


def _opened(path: Path, format_: str | None = None) -> tuple[str, Format]:
    """The text of a camera file, and its format; without a name it is told by the content."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ConfigurationError(f"{path}: too large for a camera file")
        text = path.read_text(encoding="utf-8")
    except OSError as cause:
        raise ConfigurationError(f"{path}: cannot be read: {cause.strerror}") from cause
    except UnicodeDecodeError:
        raise ConfigurationError(f"{path}: no text, and so no camera file") from None
    if format_ is not None:
        return text, _format(format_)
    for candidate in FORMATS.values():
        if candidate.recognises(text):
            return text, candidate
    raise ConfigurationError(f"{path}: no camera file of any of {', '.join(FORMATS)}")


def read_camera(path: Path, pixel_pitch: float | None = None) -> CameraSpec:
    """Read a camera file: name, width, height, pixel_pitch, principal_distance, interior.

    With `interior:` (c, x0, y0 mm, A1 … C2; CONVENTIONS §2) the camera counts as calibrated. A file
    of another program (OpenCV, ROS, Metashape, …) is read as what it is; pixel_pitch: mm, where it
    does not say it.
    """
    try:
        known = _opened(path)[1].name
    except ConfigurationError:  # of none of the formats: our own YAML
        reader = QuantityReader(path, read_yaml(path, ConfigurationError))
        camera = reader.inner("camera") if "camera" in reader.mapping else reader
        return CameraSpec.read(camera, path.stem)
    found = read(path, known, pixel_pitch)
    interior = found.model.interior
    return CameraSpec(found.name, found.model.sensor, interior.c, interior)


def write_camera(path: Path, camera: CameraSpec, covariance: Array, comment: str) -> None:
    """Write a camera whose interior orientation is known, as our own file.

    path: `.json` with covariance (10, 10), which every `--camera` takes, or `.yaml`; comment: one
    line for its head. Raises UsageError for another suffix.
    """
    suffix, sensor, interior = path.suffix.lower(), camera.sensor, camera.interior
    assert interior is not None
    if suffix == ".json":
        write(CameraModel(sensor, interior), path, "json", covariance, comment, camera.name)
        return
    if suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: .json and .yaml are written; for another program convert it")
    document = {
        "name": camera.name,
        **asdict(sensor),
        "principal_distance": interior.c,
        "interior": asdict(interior),
    }
    write_text(path, f"# {comment}\n{yaml.safe_dump(document, sort_keys=False)}")
