"""The camera as every file format writes and reads it, and our own formats, JSON and YAML.

Also reads the numbers and the YAML in a file's text; an error names the value that is wrong.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import yaml

from thermocald.errors import ConfigurationError
from thermocald.files import QuantityReader, parse_yaml
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, CameraSpec, Sensor
from thermocald.photogrammetry.camera.conversions import BROWN, Family
from thermocald.photogrammetry.linalg import unit_diagonal
from thermocald.result import with_sds

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import CameraModel

_T = TypeVar("_T")
ITS_YAML = "its YAML"
"""Begins errors of a text, before which the file is named."""


def yaml_text(document: dict[str, Any]) -> str:
    """Return a document as YAML, each list of numbers on one line."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10_000)


def number(value: Any, what: str) -> float:
    """Return a finite number; `what` names it in the error."""
    try:
        result = float("" if isinstance(value, bool) else value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{what} is {value!r}, not a number") from None
    except OverflowError:
        raise ConfigurationError(f"{what} is too large a number") from None
    if not math.isfinite(result):
        raise ConfigurationError(f"{what} is {value!r}, not a finite number")
    return result


def numbers(values: Any, what: str, counts: tuple[int, ...]) -> Array:
    """Return a list of finite numbers whose length is in counts; `what` names it in the error."""
    if not isinstance(values, list | tuple | np.ndarray):
        raise ConfigurationError(f"{what} is missing or is not a list")
    result = np.array([number(v, what) for v in np.ravel(np.asarray(values, dtype=object))])
    if len(result) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ConfigurationError(f"{what} has {len(result)} numbers, not {wanted}")
    return result


def among(known: Mapping[str, _T], given: Any, what: str) -> _T:
    """Return what is known of a model that a file names; `what` names it in the error."""
    found = known.get(str(given))
    if found is None:
        raise ConfigurationError(f"{what} {given!r}: only {', '.join(known)} can be read")
    return found


_LARGEST = 1e9
_LONGEST = 300.0  # principal distance in image widths: a field of view of 0.2°
_ROUNDED = 1e-4  # of a correlation, in files with few digits
_PITCH = re.compile(r"pixel_pitch_mm[\"']?\s*[:=]\s*([0-9.eE+-]+)")


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecord:
    """A camera in the terms of a file format, as it is written or was read.

    size: (width, height) px; values: in the order of the family's parameters, with their covariance
    or None; pixel_pitch: mm, None if the format does not have it; statement: how exact the values
    are; comment: free text for the head of the file.
    """

    size: Sequence[float] | Array
    family: Family
    values: Array
    name: str = "camera"
    covariance: Array | None = None
    pixel_pitch: float | None = None
    statement: str = ""
    comment: str = ""

    def head(self, mark: str = "# ") -> str:
        """Return the comment at the head of a text file, each line after a mark."""
        lines = [
            "written by thermocald",
            f"conversion: {self.statement}",
            # not for other programs, but to read the file back into millimetres
            f"pixel_pitch_mm: {self.pixel_pitch!r}",
            *self.comment.splitlines(),
        ]
        return "".join(f"{mark}{line}\n" for line in lines)

    def sensor(self, text: str, given: float | None) -> Sensor:
        """Return the sensor, with the pixel pitch `given` by the user, else that of the file.

        text: that of the file. Raises ConfigurationError if no camera has such values.
        """
        width, height = (int(side) for side in self.size)
        whole = (width, height) == tuple(self.size)
        if not (whole and 0 < width <= 100_000 and 0 < height <= 100_000):
            given_size = " × ".join(f"{side:g}" for side in self.size)
            raise ConfigurationError(f"image size {given_size} px is impossible")
        if not np.all(np.abs(self.values) < _LARGEST):
            raise ConfigurationError("a camera parameter is not a number, or far out of range")
        if self.covariance is not None:
            r = unit_diagonal(self.covariance)[0]
            negative = self.covariance.diagonal().min() < 0 or np.linalg.eigvalsh(r)[0] < -_ROUNDED
            if negative or not np.allclose(r, r.T, atol=_ROUNDED):
                raise ConfigurationError(
                    "the covariance has a negative variance, a correlation above 1, or is not "
                    "symmetric: is a number wrong?"
                )
        own = self.pixel_pitch
        if own and given and not np.isclose(given, own, rtol=1e-9):  # its terms are in mm
            raise ConfigurationError(
                f"pixel pitch {given:g} mm was given, but the file states {own:g} mm"
            )
        pitch = own if given is None else given
        if pitch is None:
            stated = _PITCH.search(text)  # in the comment of `head`
            if stated is None:
                raise ConfigurationError(
                    "the file does not state the pixel pitch: give it, in mm (--pixel-pitch "
                    "0.00112 for a Raspberry Pi camera v2.1)"
                )
            pitch = number(stated.group(1), "pixel_pitch_mm")
        if not (math.isfinite(pitch) and 1e-5 < pitch < 1):
            raise ConfigurationError(
                f"pixel pitch {pitch:g} mm: it must be between 0.00001 and 1 mm"
            )
        sensor = Sensor(width, height, pitch)
        # a focal length of zero or less would fail later, with a message less clear
        focal = self.values[0] / (pitch if self.family.parameters[0] == "c" else 1.0)
        if self.family.parameters[1] == "fy" and abs(self.values[1]) < 1.0:
            focal = self.values[1]
        if not 0.05 * max(self.size) < focal < _LONGEST * max(self.size):
            raise ConfigurationError(
                f"a principal distance of {focal:g} px is impossible for an image of {width} × "
                f"{height} px"
            )
        return sensor


@dataclass(frozen=True, slots=True)
class Format:
    """A file format.

    about: what it is; family: returns the family of models in which a camera is written; encode,
    decode: write and read the text; recognises: whether a text is in this format, by its content.
    """

    name: str
    suffix: str
    about: str
    family: Callable[[CameraModel], Family]
    encode: Callable[[CameraRecord], str]
    decode: Callable[[str], CameraRecord]
    recognises: Callable[[str], bool]


_VERSION = "thermocald-camera/1"


def _encode_own(record: CameraRecord) -> str:
    values = dict(zip(IOP_NAMES, record.values.tolist(), strict=True))
    if record.covariance is not None:
        values = with_sds(IOP_NAMES, record.values, np.sqrt(record.covariance.diagonal()))
    width, height = record.size
    document = {
        "format": _VERSION,
        "name": record.name,
        "comment": record.comment,
        "sensor": {"width": width, "height": height, "pixel_pitch": record.pixel_pitch},
        "interior": values,
        "covariance": None
        if record.covariance is None
        else {"parameters": list(IOP_NAMES), "matrix": record.covariance.tolist()},
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; ConfigurationError for a key that is duplicated."""
    keys = [key for key, _ in pairs]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ConfigurationError(f"key {twice[0]!r} is duplicated")
    return dict(pairs)


def _decode_own(text: str) -> CameraRecord:
    try:
        document = json.loads(text, object_pairs_hook=_unique)
    except (json.JSONDecodeError, RecursionError) as cause:
        raise ConfigurationError(f"not valid JSON: {cause}") from None
    if not isinstance(document, dict) or document.get("format") != _VERSION:
        raise ConfigurationError(f"not a camera file: format is not {_VERSION!r}")
    head, values = document.get("sensor"), document.get("interior")
    if not isinstance(head, dict) or not isinstance(values, dict):
        raise ConfigurationError("sensor or interior is missing")
    size = [number(head.get(side), f"sensor.{side}") for side in ("width", "height")]
    pitch = number(head.get("pixel_pitch"), "sensor.pixel_pitch")
    if "c" not in values:
        raise ConfigurationError("interior.c is missing")
    for key in values:
        if str(key).removeprefix("sd_") not in IOP_NAMES:
            raise ConfigurationError(f"interior.{key} is none of {', '.join(IOP_NAMES)}")
    interior = np.array([number(values.get(name, 0.0), f"interior.{name}") for name in IOP_NAMES])
    covariance = document.get("covariance")
    if covariance is not None:
        stated = covariance if isinstance(covariance, dict) else {}
        if stated.get("parameters", list(IOP_NAMES)) != list(IOP_NAMES):
            raise ConfigurationError(f"covariance.parameters are not {', '.join(IOP_NAMES)}")
        covariance = numbers(stated.get("matrix"), "covariance.matrix", (100,)).reshape(10, 10)
    name = str(document.get("name", "camera"))
    return CameraRecord(size, BROWN, interior, name, covariance, pitch)


OWN = Format(
    "json", ".json", "thermocald's own, with covariance", lambda _: BROWN, _encode_own, _decode_own,
    lambda text: f'"{_VERSION}"' in text[:200],
)  # fmt: skip


def _encode_yaml(record: CameraRecord) -> str:
    (width, height), values = record.size, record.values.tolist()
    interior = dict(zip(IOP_NAMES, values, strict=True))
    document = {"name": record.name, "width": width, "height": height}
    document |= {"pixel_pitch": record.pixel_pitch, "principal_distance": values[0]}
    return record.head() + yaml_text({**document, "interior": interior})


def _decode_yaml(text: str) -> CameraRecord:
    camera = CameraSpec.read(QuantityReader("the camera", parse_yaml(text, ITS_YAML)))
    if camera.interior is None:
        raise ConfigurationError("the camera has no interior orientation")
    s, values = camera.sensor, camera.interior.as_array()
    return CameraRecord((s.width, s.height), BROWN, values, camera.name, None, s.pixel_pitch)


YAML = Format(
    "yaml", ".yaml", "thermocald's own, without covariance", lambda _: BROWN,
    _encode_yaml, _decode_yaml,
    lambda text: "\ninterior:" in f"\n{text}" and not text.startswith("format: thermocald-"),
)  # fmt: skip
