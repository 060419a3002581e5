"""The thermometers of a configuration: each is read at its own period, and paired with frames.

Paired frames and readings keep their own times; nothing is interpolated here. For the temperature
at a frame's time, interpolate between the readings of neighbouring epochs.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from functools import partial
from typing import TYPE_CHECKING

from thermocald.acquisition.device_loop import Link
from thermocald.errors import ConfigurationError, WrongDevice
from thermocald.hal import open_device
from thermocald.names import require_channels

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from thermocald.acquisition.device_loop import OnEvent
    from thermocald.config import Config
    from thermocald.hal import Clock, Reading, Thermometer


log = logging.getLogger(__name__)

_REMEMBERED = 16  # readings at least
_REMEMBERED_S = 600.0  # a frame may wait for its calibration, and a phone's comes late
_MOST_AT_ONCE = 1000  # readings; the times of a recording may be those of another day
_FARTHEST_IN_PERIODS = 1.5


def pair_readings(
    readings: Mapping[str, Reading | None], frame_monotonic: float
) -> tuple[float, dict[str, float], float]:
    """Join one reading per thermometer, the reference first, into the temperatures of an epoch.

    Returns the reference's UTC, s; {channel: °C}; and its reading's time minus the frame's, s. If
    the reference has no reading, the next thermometer with one gives the times; NaN if none has.

    A single thermometer's channels keep their names; with several, the channel `temperature` is
    called `<thermometer>`, and others `<thermometer>_<channel>`.
    """
    temperatures = {
        _column(name, channel, len(readings)): value
        for name, reading in readings.items()
        if reading is not None
        for channel, value in reading.values.items()
    }
    reference = next((r for r in readings.values() if r is not None), None)
    if reference is None:
        return math.nan, {}, math.nan
    return reference.utc, temperatures, reference.monotonic - frame_monotonic


def require_columns(thermometers: Mapping[str, Iterable[str]], error: type[Exception]) -> list[str]:
    """Return the columns of an epoch for {thermometer: its channels}, the reference first.

    Raises `error` if two columns, or a column and one of this program, have the same name.
    """
    columns = [
        _column(name, channel, len(thermometers))
        for name, channels in thermometers.items()
        for channel in channels
    ]
    where = f"thermometers {', '.join(thermometers)}"
    require_channels(columns, where, error)
    if "temperature" in columns[1:]:
        raise error(
            f"{where}: `temperature` is the name of the reference, the first of the channels "
            f"({', '.join(columns)}); put this channel first, or rename it"
        )
    return columns


def _column(thermometer: str, channel: str, thermometers: int) -> str:
    if thermometers == 1:
        return channel
    return thermometer if channel == "temperature" else f"{thermometer}_{channel}"


class Thermometers:
    """All thermometers of a configuration, and their last readings; threads may share them.

    with_frames: those that are read with a camera's frames: recorded ones, with `fast` all. Raises
    ConfigurationError if options are wrong, or if the channels cannot all be columns of a camera's
    epochs.
    """

    def __init__(
        self, config: Config, clock: Clock, on_event: OnEvent = lambda *_: None, *,
        fast: bool = False,
    ) -> None:  # fmt: skip
        self.links: dict[str, Link] = {}
        self._cameras = config.cameras
        self._channels: dict[str, tuple[str, ...]] = {}  # as named by the options, then as read
        self._kept: dict[str, deque[Reading]] = {}
        self._missed: set[tuple[str, str]] = set()  # channels that were reported as missing
        self._changed = threading.Condition()
        self._reading = threading.Lock()  # of `read_up_to`, which several cameras may call
        self.with_frames: set[str] = set()
        used = {name for camera in config.cameras for name in camera.thermometers}
        for one in config.thermometers:
            device: Thermometer = open_device("thermometer", one.driver, one.options, clock)
            if fast or (device.recorded and one.name in used):
                self.with_frames.add(one.name)
            self.links[one.name] = Link(
                "thermometer", one.name, device, clock, one.period_s, on_event, device.recorded
            )
            self._channels[one.name] = tuple(device.named_channels())
            count = max(_REMEMBERED, round(_REMEMBERED_S / one.period_s))
            self._kept[one.name] = deque(maxlen=count)
        self._named = self._channels
        self._require(self._named, ConfigurationError)

    def _require(self, channels: Mapping[str, Sequence[str]], error: type[Exception]) -> None:
        for camera in self._cameras:
            require_columns({name: channels[name] for name in camera.thermometers}, error)

    def columns(self, names: Sequence[str]) -> list[str]:
        """Return some thermometers' temperature columns known so far, the reference first.

        One that was never opened and has no named channels is assumed to have `temperature`.
        """
        channels = {name: self._channels[name] or ("temperature",) for name in names}
        return require_columns(channels, ConfigurationError)

    def named_columns(self, names: Sequence[str]) -> list[str]:
        """Return the columns that the options name, not those that a device names when opened."""
        return require_columns({name: self._named[name] for name in names}, ConfigurationError)

    def read(self, name: str) -> Reading:
        """Read a thermometer that is open, and store the reading; raises DeviceError."""
        reading: Reading = self.links[name].device.read()
        self.add(name, reading)
        return reading

    def read_up_to(self, names: Sequence[str], monotonic: float) -> None:
        """Read those of some thermometers that are read with frames up to a frame's time, s."""
        with self._reading:
            for name in self.with_frames.intersection(names):
                read = partial(self.links[name].do, partial(self.read, name))
                for _ in range(_MOST_AT_ONCE):
                    if self._is_near(name, monotonic) or not read():
                        break

    def add(self, name: str, reading: Reading) -> None:
        """Store a reading; WrongDevice if one of its channels cannot be a column."""
        if new := [c for c in reading.values if c not in self._channels[name]]:
            channels = {**self._channels, name: (*self._channels[name], *new)}
            self._require(channels, WrongDevice)
            self._channels = channels
        for channel, why in reading.missing.items():
            if (name, channel) not in self._missed:
                log.warning("thermometer %s lacks %s: %s", name, channel, why)
                self._missed.add((name, channel))
        with self._changed:
            self._kept[name].append(reading)
            self._changed.notify_all()

    def last(self, name: str) -> tuple[Mapping[str, float], list[str]]:
        """Return the values of a thermometer's last reading, °C, and why channels are missing."""
        kept = self._kept[name]
        return (kept[-1].values, list(kept[-1].missing.values())) if kept else ({}, [])

    def nearest(self, name: str, monotonic: float) -> Reading | None:
        """Return a thermometer's reading nearest to a time; None if it is over 1.5 periods away."""
        with self._changed:
            near = min(self._kept[name], key=lambda r: abs(r.monotonic - monotonic), default=None)
        limit = _FARTHEST_IN_PERIODS * self.links[name].period_s
        return near if near is not None and abs(near.monotonic - monotonic) <= limit else None

    def around(
        self, names: Sequence[str], monotonic: float, patience_s: float
    ) -> tuple[float, dict[str, float], float]:
        """Pair the readings nearest to a frame as `pair_readings`; an unread channel is NaN.

        patience_s: how long to wait, in wall time, for a reading that is being taken; a thermometer
        whose next reading would be no nearer is not waited for.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: all(self._is_near(name, monotonic) for name in names), patience_s
            )
        nearest = {name: self.nearest(name, monotonic) for name in names}
        utc, temperatures, skew_s = pair_readings(nearest, monotonic)
        # a reference that was not read stays NaN, no other channel replaces it
        columns = dict.fromkeys(self.columns(names), math.nan)
        return utc, {**columns, **temperatures}, skew_s

    def _is_near(self, name: str, monotonic: float) -> bool:
        kept = self._kept[name]
        return bool(kept) and kept[-1].monotonic >= monotonic - 0.5 * self.links[name].period_s
