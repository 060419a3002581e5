"""What every camera file's module works on: the camera to be written, the camera that was read."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.camera.conversions import Family, from_family

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array


_LARGEST = 1e9
_PITCH = re.compile(r"pixel_pitch_mm[\"']?\s*[:=]\s*([0-9.eE+-]+)")


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """A camera to be written: covariance (10, 10) of the interior orientation or None; comment:
    free text for the file's head.
    """

    model: CameraModel
    name: str = "camera"
    covariance: Array | None = None
    comment: str = ""


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


@dataclass(frozen=True, slots=True, eq=False)
class ForeignCamera:
    """A camera as another program's file holds it.

    size: (width, height) px. values: in the order of the family's parameters. covariance: of the
    values, or None. pixel_pitch: mm, where the record itself holds it.
    """

    size: tuple[int, int]
    family: Family
    values: Array
    name: str = "camera"
    covariance: Array | None = None
    pixel_pitch: float | None = None

    def imported(self, format_name: str, text: str, pitch: float | None) -> ImportedCamera:
        """The camera in our model; pitch: mm, as the user gave it, else as the file states it."""
        width, height = self.size
        if not (0 < width <= 100_000 and 0 < height <= 100_000):
            raise ConfigurationError(f"image size {width} × {height} px is impossible")
        if not np.all(np.abs(self.values) < _LARGEST):
            raise ConfigurationError("a camera parameter is not a number, or far out of range")
        sensor = Sensor(width, height, _pitch(text, self.pixel_pitch if pitch is None else pitch))
        # a focal length of zero or less would only fail later, and in other words
        focal = self.values[0] / (sensor.pixel_pitch if self.family.parameters[0] == "c" else 1.0)
        if not 0.05 * max(self.size) < focal < 1000 * max(self.size):
            raise ConfigurationError(
                f"a principal distance of {focal:g} px does not belong to an image of {width} × "
                f"{height} px"
            )
        result = from_family(sensor, self.family, self.values, self.covariance)
        return ImportedCamera(
            CameraModel(sensor, InteriorOrientation.from_array(result.values)),
            format_name, self.name, result.exact, result.largest_px, result.rms_px,
            result.covariance,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Format:
    """A file format: its name, usual suffix, what it is for, and its writer and reader of text.

    `encode(record)` gives the file's text and the statement of its residual; `decode(text)` reads
    it; `recognises(text)` decides from the content alone.
    """

    name: str
    suffix: str
    about: str
    encode: Callable[[Record], tuple[str, str]]
    decode: Callable[[str], ForeignCamera | ImportedCamera]
    recognises: Callable[[str], bool]


def header(record: Record, statement: str, mark: str = "# ") -> str:
    """The head of a text file: origin, residual, pixel pitch, comment, each line after a mark."""
    lines = [
        "written by thermocald",
        f"conversion: {statement}",
        # other programs do without it, reading the file back into millimetres does not
        f"pixel_pitch_mm: {record.model.sensor.pixel_pitch!r}",
        *record.comment.splitlines(),
    ]
    return "".join(f"{mark}{line}\n" for line in lines)


def _pitch(text: str, given: float | None) -> float:
    """The pixel pitch: as given, else as a comment of ours states it."""
    found = _PITCH.search(text)
    pitch = given if given is not None else float(found.group(1)) if found else None
    if pitch is None:
        raise ConfigurationError(
            "the file does not say how large a pixel is: give it, in mm (--pixel-pitch 0.00112 for "
            "a Raspberry Pi camera v2.1)"
        )
    if not (math.isfinite(pitch) and 1e-5 < pitch < 1):
        raise ConfigurationError(f"pixel pitch {pitch:g} mm: between 0.00001 and 1 mm are possible")
    return pitch
