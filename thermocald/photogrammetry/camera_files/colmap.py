"""COLMAP's cameras.txt: `CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]`, pixel centres at 0.5.

Written as FULL_OPENCV, or as OPENCV where there is no k3; read from these and the simpler models.
"""

from __future__ import annotations

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import BrownOpenCV, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import number

# Where each model's parameters stand in fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6.
_SLOTS: dict[str, tuple[tuple[int, ...], ...]] = {
    "SIMPLE_PINHOLE": ((0, 1), (2,), (3,)),
    "PINHOLE": ((0,), (1,), (2,), (3,)),
    "SIMPLE_RADIAL": ((0, 1), (2,), (3,), (4,)),
    "RADIAL": ((0, 1), (2,), (3,), (4,), (5,)),
    "OPENCV": tuple((i,) for i in range(8)),
    "FULL_OPENCV": tuple((i,) for i in range(12)),
}
_HALF = 0.5


def _encode(record: Record) -> tuple[str, str]:
    four = record.model.interior.A3 == 0
    result = to_family(record.model, BrownOpenCV(4 if four else 5))
    values = result.values.copy()
    values[2:4] += _HALF
    model = "OPENCV" if four else "FULL_OPENCV"
    padded = [*values, *([0.0] * (len(_SLOTS[model]) - len(values)))]
    sensor = record.model.sensor
    fields = ["1", model, str(sensor.width), str(sensor.height), *(repr(float(v)) for v in padded)]
    head = header(record, result.statement) + "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return head + " ".join(fields) + "\n", result.statement


def _cameras(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]


def _decode(text: str) -> ForeignCamera:
    cameras = _cameras(text)
    if len(cameras) != 1:
        raise ConfigurationError(
            f"the file holds {len(cameras)} cameras: leave the line of the one that is wanted"
        )
    fields = cameras[0]
    if len(fields) < 5 or fields[1] not in _SLOTS:
        shown = fields[1] if len(fields) > 1 else ""
        raise ConfigurationError(f"camera model {shown!r}: {', '.join(_SLOTS)} can be read")
    slots = _SLOTS[fields[1]]
    given = [number(f, f"parameter {i + 1}") for i, f in enumerate(fields[4:])]
    if len(given) != len(slots):
        raise ConfigurationError(f"{fields[1]} has {len(slots)} parameters, not {len(given)}")
    values = np.zeros(12)
    for where, value in zip(slots, given, strict=True):
        values[list(where)] = value
    values[2:4] -= _HALF
    size = int(number(fields[2], "WIDTH")), int(number(fields[3], "HEIGHT"))
    return ForeignCamera(size, BrownOpenCV(8), values)


FORMAT = Format(
    "colmap", ".txt", "COLMAP cameras.txt", _encode, _decode,
    lambda text: any(len(f) > 4 and f[1].isupper() for f in _cameras(text)[:1]),
)  # fmt: skip
