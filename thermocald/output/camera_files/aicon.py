"""An AICON-style .ior: photogrammetric terms at the measured point, radial ones balanced by R0.

One `name value [sd]` per line, mm, in the notation of AICON's calibration records: Ck negative,
principal point Xh Yh, A1 A2 R0 A3, B1 B2, C1 C2, sensor size and pixels. Programs that write .ior
files differ in their layout; this one is meant to be read, typed over, and read back.
"""

from __future__ import annotations

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.output.camera_files.camera_record import (
    Format,
    ImportedCamera,
    Record,
    header,
    import_family,
    number,
)
from thermocald.photogrammetry.conversions import to_family
from thermocald.photogrammetry.model_families import MeasuredPoint

__all__ = ["FORMAT"]

# In the order of our ten: c x0 y0 A1 A2 A3 B1 B2 C1 C2.
_NAMES = ("Ck", "Xh", "Yh", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
_LINES = ("Ck", "Xh", "Yh", "A1", "A2", "R0", "A3", "B1", "B2", "C1", "C2")
_SIZES = ("sensor_width_mm", "sensor_height_mm", "pixels_x", "pixels_y")


def _encode(record: Record) -> tuple[str, str]:
    sensor = record.model.sensor
    half_diagonal = 0.5 * float(np.hypot(sensor.width, sensor.height)) * sensor.pixel_pitch
    # the radial correction vanishes at two thirds of the way to the corner, as is usual
    r0 = round(2 / 3 * half_diagonal, 3)
    result = to_family(record.model, MeasuredPoint(r0), record.covariance)
    values = dict(zip(_NAMES, result.values, strict=True))
    values["Ck"] = -values["Ck"]
    values["R0"] = r0
    sd = {}
    if result.covariance is not None:
        sd = dict(zip(_NAMES, np.sqrt(np.diag(result.covariance)), strict=True))
    lines = [f"camera {record.name}"]
    for name in _LINES:
        spread = f" {float(sd[name])!r}" if name in sd else ""
        lines.append(f"{name} {float(values[name])!r}{spread}")
    extent = sensor.width * sensor.pixel_pitch, sensor.height * sensor.pixel_pitch
    sizes = (*extent, sensor.width, sensor.height)
    lines += [f"{name} {value!r}" for name, value in zip(_SIZES, sizes, strict=True)]
    return header(record, result.statement) + "\n".join(lines) + "\n", result.statement


def _decode(text: str, pitch: float | None) -> ImportedCamera:
    found: dict[str, str] = {}
    spread: dict[str, float] = {}
    name = "camera"
    for i, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        key, rest = words[0], words[1:]
        if key == "camera":
            name = " ".join(rest)
        elif key not in (*_LINES, *_SIZES):
            raise ConfigurationError(f"line {i}: {key!r} is none of {', '.join(_LINES + _SIZES)}")
        elif key in found:
            raise ConfigurationError(f"line {i}: {key} stands twice")
        elif not rest:
            raise ConfigurationError(f"line {i}: {key} has no value")
        else:
            found[key] = rest[0]
            if len(rest) > 1:
                spread[key] = number(rest[1], f"line {i}: standard deviation of {key}")
    missing = [key for key in ("Ck", *_SIZES) if key not in found]
    if missing:
        raise ConfigurationError(f"{', '.join(missing)} missing")
    values = np.array([number(found.get(key, 0.0), key) for key in _NAMES])
    values[0] = abs(values[0])
    sizes = [number(found[key], key) for key in _SIZES]
    r0 = number(found.get("R0", 0.0), "R0")
    if not 0 <= r0 < 1000:
        raise ConfigurationError(f"R0 is {r0:g} mm; it is a radius in the image")
    covariance = None
    if spread:
        covariance = np.diag([spread.get(key, 0.0) ** 2 for key in _NAMES])
    return import_family(
        "aicon", text, (int(sizes[2]), int(sizes[3])),
        MeasuredPoint(r0), values,
        pitch if pitch is not None else sizes[0] / sizes[2], name, covariance,
    )  # fmt: skip


FORMAT = Format(
    "aicon", ".ior", "AICON-style interior orientation", _encode, _decode,
    lambda text: any(line.split()[:1] == ["Ck"] for line in text.splitlines()),
)  # fmt: skip
