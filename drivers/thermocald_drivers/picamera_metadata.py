"""What libcamera reports with a frame: read as JSON, as settings, and compared with what was set.

Source: libcamera control_ids_core.yaml; metadata of IMX219, IMX477, IMX708 and OV5647.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["agrees", "frame_settings", "jsonable", "sensor_temperature"]

CLAMP_LOW_C, CLAMP_HIGH_C = -20.0, 80.0
_NUMBERS = (
    # setting, libcamera's name, unit
    ("exposure_s", "ExposureTime", 1e-6),
    ("gain", "AnalogueGain", 1.0),
    ("digital_gain", "DigitalGain", 1.0),
    ("focus_dioptres", "LensPosition", 1.0),
)


def sensor_temperature(metadata: Mapping[str, Any]) -> float | None:
    """°C of the sensor; None where it is absent or a value that means "unknown"."""
    value = metadata.get("SensorTemperature")
    if isinstance(value, bool) or not isinstance(value, int | float) or value == 0.0:
        return None
    return float(value) if CLAMP_LOW_C < value < CLAMP_HIGH_C else None


def jsonable(value: Any) -> Any:
    """Libcamera's rectangles and tuples as lists."""
    if isinstance(value, dict):
        return {str(key): jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def agrees(asked: Any, got: Any, tolerance: float) -> bool:
    """Whether a value, or each of several, was reported as it was set, to a relative tolerance."""
    if isinstance(asked, tuple | list):
        same = isinstance(got, tuple | list) and len(got) == len(asked)
        return same and all(agrees(a, g, tolerance) for a, g in zip(asked, got, strict=True))
    if isinstance(got, bool) or not isinstance(got, int | float):
        return False
    return bool(abs(got - asked) <= tolerance * max(abs(asked), 1e-9))


def frame_settings(metadata: Mapping[str, Any]) -> dict[str, float]:
    """What moves the image, as the sensor reports it, under the names of the stanza."""
    found = {
        name: round(float(metadata[key]) * unit, 9)
        for name, key, unit in _NUMBERS
        if isinstance(metadata.get(key), int | float)
    }
    gains = metadata.get("ColourGains")
    if isinstance(gains, tuple | list) and len(gains) == 2:
        found["colour_gain_red"], found["colour_gain_blue"] = map(float, gains)
    return found
