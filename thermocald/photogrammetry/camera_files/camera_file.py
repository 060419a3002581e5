"""A camera as `--camera` names it: our own YAML, or a file of another program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.errors import ConfigurationError, UsageError
from thermocald.files import read_yaml, write_text
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.arrays import Array


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera as a YAML file describes it: sensor, nominal c mm, interior orientation if known."""

    name: str
    sensor: Sensor
    principal_distance: float | None
    interior: InteriorOrientation | None


def read_camera(path: Path, pixel_pitch: float | None = None) -> CameraFile:
    """Read a camera file: name, width, height, pixel_pitch, principal_distance, interior.

    With `interior:` (c, x0, y0 mm, A1 … C2; CONVENTIONS §2) the camera counts as calibrated. A file
    of another program (OpenCV, ROS, Metashape, …) is read as what it is; pixel_pitch: mm, where it
    does not say it.
    """
    from thermocald.photogrammetry import camera_files

    if camera_files.recognised(path) is not None:
        found = camera_files.read(path, pixel_pitch=pixel_pitch)
        model = found.model
        return CameraFile(found.name, model.sensor, model.interior.c, model.interior)
    document = read_yaml(path, ConfigurationError)
    if not isinstance(document, dict):
        raise ConfigurationError(f"{path}: is not a camera file; it must hold `width: …` and so on")
    camera = document.get("camera", document)

    def number(key: str, required: bool = True) -> float | None:
        value = camera.get(key)
        if value is None and not required:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e5:
            raise ConfigurationError(
                f"{path}: {key} must be a number above 0 and below 100000, it is {str(value)[:40]}"
            )
        return float(value)

    width, height, pitch = number("width"), number("height"), number("pixel_pitch")
    assert width is not None
    assert height is not None
    assert pitch is not None
    nominal = number("principal_distance", required=False)
    interior = None
    given = camera.get("interior")
    if given is not None:
        unknown = set(given) - set(IOP_NAMES) if isinstance(given, dict) else {str(given)}
        if unknown or "c" not in given:
            raise ConfigurationError(
                f"{path}: interior must hold c and any of {', '.join(IOP_NAMES[1:])}"
                + (f"; {min(unknown)!r} is none of them" if unknown else "")
            )
        try:
            interior = InteriorOrientation(**{k: float(v) for k, v in given.items()})
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"{path}: interior: {error}") from error
    return CameraFile(
        str(camera.get("name", path.stem)),
        Sensor(int(width), int(height), pitch),
        nominal,
        interior,
    )


def write_camera(path: Path, camera: CameraFile, covariance: Array, comment: str) -> None:
    """Write a camera whose interior orientation is known, as our own file.

    path: `.json` with covariance (10, 10), which every `--camera` takes, or `.yaml`; comment: one
    line for its head. Raises UsageError for another suffix.
    """
    import yaml

    from thermocald.photogrammetry import camera_files

    suffix, sensor, interior = path.suffix.lower(), camera.sensor, camera.interior
    assert interior is not None
    if suffix == ".json":
        model = CameraModel(sensor, interior)
        camera_files.write(model, path, "json", covariance, comment, camera.name)
        return
    if suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: .json and .yaml are written; for another program convert it")
    values = dict(zip(IOP_NAMES, interior.as_array().tolist(), strict=True))
    document = {
        "name": camera.name,
        "width": sensor.width,
        "height": sensor.height,
        "pixel_pitch": sensor.pixel_pitch,
        "principal_distance": values["c"],
        "interior": values,
    }
    write_text(path, f"# {comment}\n{yaml.safe_dump(document, sort_keys=False)}")
