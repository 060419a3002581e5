"""`recording.yaml` (CONVENTIONS §3): the description of a recording."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import DataError, RecordingError
from thermocald.files import QuantityReader, read_yaml, reading
from thermocald.names import require_channels
from thermocald.photogrammetry.camera.camera_model import CameraSpec as CameraSpec

if TYPE_CHECKING:
    from collections.abc import Mapping


FORMAT = "thermocald-recording/1"
_LONGEST_NAME = 200


@dataclass(frozen=True, slots=True)
class Channel:
    """A temperature column, °C: the thermometer's resolution, K, None if unknown."""

    resolution: float | None = None


@dataclass(frozen=True)
class Head:
    """The content of `recording.yaml`.

    name, series: as the user calls them; interval: s, nominal; channels: the temperature columns,
    the first is the reference; extra: keys that the format does not define, unchanged.
    """

    name: str
    series: str
    interval: float
    camera: CameraSpec
    channels: Mapping[str, Channel] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def predicted(self) -> bool:
        """Whether its cameras were predicted by a thermal model, not calibrated."""
        return "thermal_model" in self.extra

    def require_calibrated(self, where: str) -> None:
        """Raise DataError if a thermal model predicted the series' cameras."""
        if self.predicted:
            raise DataError(
                f"{where}: series {self.series!r} was predicted by the thermal model "
                f"{self.extra['thermal_model']!r}; nothing in it was calibrated; run `thermocald "
                "export` on its store to get the cameras"
            )


class _Reader(QuantityReader):
    """A reader of one mapping of the file."""

    error = RecordingError

    def text(self, key: str, default: str | None = None) -> str:
        """Read text that a message or a table can show."""
        text = super().text(key, default)
        if not text.isprintable() or len(text) > _LONGEST_NAME:
            raise self.fail(
                key, f"{text[:40]!r} must be printable text of at most {_LONGEST_NAME} characters"
            )
        return text


def read_head(folder: Path) -> Head:
    """Read `recording.yaml` of a folder. Raises RecordingError naming file and key."""
    path = folder / "recording.yaml"
    with reading(path, RecordingError):
        if not folder.is_dir():
            what = "is not a folder with recording.yaml, as a recording is"
            raise RecordingError(f"{folder}: {what}")
        if not path.is_file():
            raise RecordingError(f"{folder}: is not a recording: recording.yaml is missing")
    head = parse_head(read_yaml(path, RecordingError), path)
    require_channels(head.channels, f"{path}, key temperatures", RecordingError)
    return head


def parse_head(document: Mapping[str, Any], path: Path | str) -> Head:
    """Return the head from the mapping of a `recording.yaml`; `path` is for the messages."""
    top = _Reader(path, document)
    top.require_format(FORMAT)
    known = {"format", "name", "series", "interval", "camera", "temperatures"}
    extra = {key: value for key, value in document.items() if key not in known}
    try:  # as JSON holds them: a YAML date becomes text, as in a store
        extra = json.loads(json.dumps(extra, default=str))
    except TypeError as cause:
        raise top.fail(next(iter(extra)), f"or another unknown key: {cause}") from cause
    return Head(
        name=top.text("name", Path(path).resolve().parent.name),
        series=top.text("series", "M1"),
        interval=top.number("interval", "s", above=0.0, low=1e-4, high=1e8),
        camera=CameraSpec.read(top.inner("camera")),
        channels=_channels(top) if "temperatures" in document else {},
        extra=extra,
    )


def _channels(top: _Reader) -> dict[str, Channel]:
    reader = top.inner("temperatures")
    channels: dict[str, Channel] = {}
    for name, value in reader.mapping.items():
        if not str(name).isprintable():
            raise reader.fail(repr(name), "a column's name must be printable")
        if value is not None and not isinstance(value, dict):
            raise reader.fail(name, "must hold `unit: degC, resolution: …`")
        inner = _Reader(top._path, value or {}, f"temperatures.{name}.")
        if (unit := inner.text("unit", "degC")) != "degC":
            raise inner.fail("unit", f"is {unit!r}; temperatures must be in degC: convert them")
        resolution = None
        if inner.mapping.get("resolution") is not None:
            resolution = inner.number("resolution", "K", above=0.0, low=1e-6, high=100.0)
        channels[name] = Channel(resolution)
    return channels


def head_document(head: Head) -> dict[str, Any]:
    """Return the mapping that `recording.yaml` holds; it can be written as JSON if `extra` can."""
    sensor, interior = head.camera.sensor, head.camera.interior
    camera = {
        "name": head.camera.name, "width": sensor.width, "height": sensor.height,
        "pixel_pitch": sensor.pixel_pitch, "principal_distance": head.camera.principal_distance,
        "interior": interior and asdict(interior),
    }  # fmt: skip
    temperatures = {
        name: _known({"unit": "degC", "resolution": channel.resolution})
        for name, channel in head.channels.items()
    }
    document = {
        "format": FORMAT, "name": head.name, "series": head.series, "interval": head.interval,
        "camera": _known(camera), "temperatures": temperatures or None,
    }  # fmt: skip
    return {**_known(document), **head.extra}


def _known(mapping: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in mapping.items() if value is not None}
