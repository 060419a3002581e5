"""Camera files, ours and those of other programs: one function writes them, one reads them.

    write(model, path, "mrcal")         → a statement of how exact the file is
    read(path) → ImportedCamera         the format is recognised by the content

Which conversions are exact, and the conventions: docs/reference/camera_files.md and
`camera.conversions`. `read_camera` reads the file given with `--camera`: our YAML, or a file of
another program.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, DataError, UsageError
from thermocald.files import QuantityReader, read_yaml, write_text
from thermocald.photogrammetry.camera import conversions
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    CameraSpec,
    InteriorOrientation,
    image_to_px,
)
from thermocald.photogrammetry.camera_files.camera_record import OWN, YAML, CameraRecord, Format
from thermocald.photogrammetry.camera_files.formats import (
    AICON,
    COLMAP,
    KALIBR,
    METASHAPE,
    MRCAL,
    OPENCV,
    ROS,
)
from thermocald.result import Result

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.arrays import Array

FORMATS: dict[str, Format] = {
    one.name: one for one in (OPENCV, ROS, COLMAP, MRCAL, KALIBR, METASHAPE, AICON, OWN, YAML)
}
_LARGEST_FILE = 10_000_000
_LARGEST_ASPECT = 2.0  # of fx and fy; that of anamorphic lenses
_EDGE = 0.01  # of the image's shorter side
_FAR = 0.1  # the same, for a principal point that is another image's centre


@dataclass(frozen=True, slots=True, eq=False)
class ImportedCamera:
    """A camera read from a file, as our model.

    exact: whether our model is the file's; else largest_px and rms_px: how far the two differ over
    the image area; covariance: (10, 10), None if the file has none.
    """

    model: CameraModel
    format: str
    name: str
    exact: bool
    largest_px: float
    rms_px: float
    covariance: Array | None = None

    @property
    def how_read(self) -> str:
        """How well our model reproduces the file's, in words."""
        return "exact" if self.exact else f"fitted, largest residual {self.largest_px:.3g} px"


def _format(name: str) -> Format:
    if name not in FORMATS:
        raise UsageError(f"unknown camera file format {name!r}; give one of {', '.join(FORMATS)}")
    return FORMATS[name]


def write(
    model: CameraModel,
    path: Path,
    format: str,  # noqa: A002
    covariance: Array | None = None,
    comment: str = "",
    name: str = "camera",
) -> str:
    """Write a camera; return a statement of how exact the file is, which the file also contains.

    covariance: (10, 10) in the order of `IOP_NAMES`; written if the format has room for it. An
    existing file is replaced as a whole or not at all. Raises UsageError for an unknown format,
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
    """Return the text that `write` writes, and the statement that it returns."""
    if covariance is not None and np.shape(covariance) != (10, 10):
        raise UsageError(f"the covariance has shape {np.shape(covariance)}, not (10, 10)")
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
    """Read a camera file; if no format is given, recognise it by the content.

    pixel_pitch: mm, for files that do not state it. A ConfigurationError names the file.
    """
    text, chosen = _read_text(path, format)
    try:
        record = chosen.decode(text)
        sensor = record.sensor(text, pixel_pitch)
        values, covariance, exact, largest, rms = conversions.convert(
            sensor, record.family, record.values, conversions.BROWN, record.covariance
        )
        # an interior orientation that no camera has
        aspect = 1.0 + float(values[8])
        if not 1.0 / _LARGEST_ASPECT < aspect < _LARGEST_ASPECT:
            raise ConfigurationError(f"fx is {aspect:.3g} times fy: is a number or a comma wrong?")
        u, v = image_to_px(sensor, values[1:3])
        W, H = sensor.width, sensor.height
        if not sensor.contains([u, v], _EDGE * min(W, H)):
            raise ConfigurationError(
                f"the principal point ({u:.0f}, {v:.0f}) px lies outside the {W} × {H} px of the "
                "image or at its edge: is a number wrong, or the size that of another image?"
            )
        away, exchanged = (np.hypot(u - x / 2, v - y / 2) for x, y in ((W, H), (H, W)))
        if away > _FAR * min(W, H) > 4 * exchanged:
            raise ConfigurationError(
                f"the principal point ({u:.0f}, {v:.0f}) px is the centre of an image of {H} × {W} "
                f"px, not of {W} × {H} px: are cx and cy, or width and height, exchanged?"
            )
    except (ConfigurationError, DataError) as cause:
        raise ConfigurationError(f"{path} ({chosen.about}): {cause}") from cause
    model = CameraModel(sensor, InteriorOrientation.from_array(values))
    return ImportedCamera(model, chosen.name, record.name, exact, largest, rms, covariance)


@dataclass(frozen=True, eq=False, repr=False)
class Conversion(Result):
    """A camera file written in another format; statement: how exact the written file is."""

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

    def lines(self) -> list[str]:
        """Return what `camera convert` prints."""
        return [
            f"{self.source} ({self.camera.format}): {self.camera.how_read}",
            f"{self.out} ({self.to}): {self.statement}",
        ]


def convert(
    source: Path,
    out: Path,
    to: str,
    format: str | None = None,  # noqa: A002
    pixel_pitch: float | None = None,
) -> Conversion:
    """Read a camera file and write it in another format; raises as `read` and `write` do."""
    camera = read(source, format, pixel_pitch)
    comment = f"converted from {source.name} ({camera.format}, {camera.how_read})"
    statement = write(camera.model, out, to, camera.covariance, comment, camera.name)
    return Conversion(source, camera, out, to, statement)


def _read_text(path: Path, format_: str | None = None) -> tuple[str, Format]:
    """Return the text of a camera file, and its format: the one given, or by the content."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ConfigurationError(f"{path}: too large for a camera file")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as cause:
        raise ConfigurationError(f"{path}: cannot be read: {cause.strerror}") from cause
    except UnicodeDecodeError:
        raise ConfigurationError(f"{path}: not a text file, so not a camera file") from None
    if format_ is not None:
        return text, _format(format_)
    for candidate in FORMATS.values():
        if candidate.recognises(text):
            return text, candidate
    thermal = "; it is a thermal model: `thermocald camera at` writes its camera at a temperature"
    raise ConfigurationError(
        f"{path}: not a camera file of any format: {', '.join(FORMATS)}"
        + thermal * text.startswith("format: thermocald-model/")
    )


def read_camera(path: Path, pixel_pitch: float | None = None) -> CameraSpec:
    """Read a camera file: our YAML, or a file of another program (OpenCV, ROS, Metashape, …).

    Our YAML has the keys name, width, height, pixel_pitch, principal_distance, and interior. With
    `interior:` (c, x0, y0 mm, A1 … C2; CONVENTIONS §2) the camera counts as calibrated.
    pixel_pitch: mm, for files of other programs that do not state it.
    """
    try:
        format_ = _read_text(path)[1].name
    except ConfigurationError:  # our own YAML without an interior orientation
        format_ = YAML.name
    if format_ == YAML.name:  # written by hand: its lines are named
        reader = QuantityReader(path, read_yaml(path, ConfigurationError))
        if "camera" in reader.mapping:
            reader = reader.inner("camera")
        return CameraSpec.read(reader, path.stem)
    camera = read(path, format_, pixel_pitch)
    interior = camera.model.interior
    return CameraSpec(camera.name, camera.model.sensor, interior.c, interior)


def write_camera(path: Path, camera: CameraSpec, covariance: Array, comment: str) -> None:
    """Write a camera with an interior orientation to a file of ours.

    path: `.json`, with the covariance (10, 10), or `.yaml`; both can be given with `--camera`.
    comment: one line for the head of the file. Raises UsageError for another suffix.
    """
    suffix = path.suffix.lower().replace(".yml", YAML.suffix)
    if suffix not in (OWN.suffix, YAML.suffix):
        raise UsageError(f"{path}: not .json or .yaml; convert one of these for another program")
    assert camera.interior is not None
    model, to = CameraModel(camera.sensor, camera.interior), suffix.lstrip(".")
    write(model, path, to, covariance, comment, camera.name)
