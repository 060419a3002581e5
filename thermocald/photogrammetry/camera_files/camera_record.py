"""What every camera file works on: the camera to be written, the camera that was read, our own
JSON.

Numbers and YAML in the text of a file are read here; what is wrong there is an error that names it.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.camera.conversions import Family, from_family

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array


def yaml_document(text: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """What a YAML text holds; ConfigurationError for a text that is not YAML."""
    try:
        return yaml.load(text, loader)
    except (yaml.YAMLError, ValueError) as cause:
        raise ConfigurationError(f"no valid YAML: {str(cause).splitlines()[0]}") from None


def yaml_text(document: dict[str, Any]) -> str:
    """A document as YAML, one line for each list of numbers."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10_000)


def number(value: Any, what: str) -> float:
    """A finite number, or an error that names it."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{what} is {value!r}, not a number") from None
    except OverflowError:
        raise ConfigurationError(f"{what} is too large a number") from None
    if not math.isfinite(result):
        raise ConfigurationError(f"{what} is {value!r}, not a finite number")
    return result


def numbers(values: Any, what: str, counts: tuple[int, ...]) -> Array:
    """A list of finite numbers of one of some lengths, or an error that names it."""
    if not isinstance(values, list | tuple | np.ndarray):
        raise ConfigurationError(f"{what} is missing or no list")
    result = np.array([number(v, what) for v in np.ravel(np.asarray(values, dtype=object))])
    if len(result) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ConfigurationError(f"{what} has {len(result)} numbers, not {wanted}")
    return result


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


_VERSION = "thermocald-camera/1"


def _encode_own(record: Record) -> tuple[str, str]:
    sensor, interior = record.model.sensor, record.model.interior
    values: dict[str, float] = {}
    for k, name in enumerate(IOP_NAMES):
        values[name] = float(getattr(interior, name))
        if record.covariance is not None:
            values[f"sd_{name}"] = float(np.sqrt(record.covariance[k, k]))
    document = {
        "format": _VERSION,
        "name": record.name,
        "comment": record.comment,
        "sensor": {
            "width": sensor.width, "height": sensor.height, "pixel_pitch": sensor.pixel_pitch,
        },
        "interior": values,
        "covariance": None
        if record.covariance is None
        else {"parameters": list(IOP_NAMES), "matrix": record.covariance.tolist()},
    }  # fmt: skip
    return json.dumps(document, indent=1, allow_nan=False) + "\n", "exact: it is our own model"


def _decode_own(text: str) -> ImportedCamera:
    try:
        document = json.loads(text)
    except json.JSONDecodeError as cause:
        raise ConfigurationError(f"no valid JSON: {cause}") from None
    if not isinstance(document, dict) or document.get("format") != _VERSION:
        raise ConfigurationError(f"no camera file: format is not {_VERSION!r}")
    head, values = document.get("sensor"), document.get("interior")
    if not isinstance(head, dict) or not isinstance(values, dict):
        raise ConfigurationError("sensor or interior is missing")
    width, height = (int(number(head.get(side), f"sensor.{side}")) for side in ("width", "height"))
    own = number(head.get("pixel_pitch"), "sensor.pixel_pitch")
    if "c" not in values:
        raise ConfigurationError("interior.c is missing")
    interior = InteriorOrientation.from_mapping(
        {name: number(values[name], f"interior.{name}") for name in IOP_NAMES if name in values}
    )
    covariance = None
    if document.get("covariance") is not None:
        matrix = document["covariance"].get("matrix")
        covariance = numbers(matrix, "covariance.matrix", (100,)).reshape(10, 10)
    return ImportedCamera(
        CameraModel(Sensor(width, height, own), interior), "json",
        str(document.get("name", "camera")), True, 0.0, 0.0, covariance,
    )  # fmt: skip


OWN = Format(
    "json", ".json", "thermocald's own, with covariance", _encode_own, _decode_own,
    lambda text: f'"{_VERSION}"' in text[:200],
)  # fmt: skip
