"""Options that several commands share: which camera, what is free."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.errors import ConfigurationError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, InteriorOrientation, Sensor
from thermocald.photogrammetry.epoch.adjustment import DEFAULT_FREE, AdjustmentSettings
from thermocald.yaml_file import read_yaml

if TYPE_CHECKING:
    from thermocald.store.logger.clock import DeviceClock

__all__ = [
    "CameraFile",
    "ExteriorOption",
    "FreeOption",
    "JsonOption",
    "TimezoneOption",
    "device_clock",
    "free_names",
    "read_camera",
]

JsonOption = Annotated[
    str | None, typer.Option("--json", help="Write the result as JSON; - for standard output.")
]
FreeOption = Annotated[
    str,
    typer.Option(
        "--free", help="Interior orientation to estimate, separated by commas; the rest is held."
    ),
]
ExteriorOption = Annotated[
    str,
    typer.Option(
        "--exterior",
        help="per_epoch: every epoch has its own orientation; series: one for all epochs; mount: "
        "one and movements of the mount, whose size is estimated; auto: what the data show.",
    ),
]


TimezoneOption = Annotated[
    str | None,
    typer.Option("--timezone", help="Of times without a zone: Europe/Berlin, UTC, +02:00."),
]


def device_clock(timezone: str | None) -> DeviceClock:
    """The clock that `--timezone` describes; without it times without a zone are refused."""
    from thermocald.store.logger.clock import DeviceClock, time_zone

    return DeviceClock(None if timezone is None else time_zone(timezone), ambiguous="order")


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera as a YAML file describes it: sensor, nominal c mm, interior orientation if known."""

    name: str
    sensor: Sensor
    principal_distance: float | None
    interior: InteriorOrientation | None


def free_names(text: str) -> tuple[str, ...]:
    """Names of IOP from a comma-separated list; `none` frees nothing."""
    if text.strip().lower() in ("", "none"):
        return ()
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in IOP_NAMES:
            raise UsageError(f"--free: {name!r} is no IOP; there are {', '.join(IOP_NAMES)}, none")
    return tuple(name for name in IOP_NAMES if name in names)


def adjustment_settings(free: str) -> AdjustmentSettings:
    """The settings of an epoch's adjustment from `--free`."""
    return AdjustmentSettings(free=free_names(free))


DEFAULT_FREE_TEXT = ",".join(DEFAULT_FREE)


def read_camera(path: Path, pixel_pitch: float | None = None) -> CameraFile:
    """Read a camera file: name, width, height, pixel_pitch, principal_distance, interior.

    With `interior:` (c, x0, y0 mm, A1 … C2; CONVENTIONS §2) the camera counts as calibrated. A file
    of another program (OpenCV, ROS, Metashape, …) is read as what it is; pixel_pitch: mm, where it
    does not say it.
    """
    from thermocald.output import camera_files

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
