"""The thermometers of a configuration: read at their own pace, and paired with frames.

Frame and readings keep their own times when they are paired; nothing is interpolated here. Who
needs the temperature at the frame's time interpolates between neighbouring epochs' readings.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import Link
from thermocald.errors import ConfigurationError, WrongDevice
from thermocald.hal import open_device
from thermocald.names import require_channels

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from thermocald.acquisition.device_loop import OnEvent
    from thermocald.config import Config
    from thermocald.hal import Clock, Reading, Thermometer


_REMEMBERED = 16
_OLDEST_IN_PERIODS = 1.5


def pair_readings(
    readings: Mapping[str, Reading | None], frame_monotonic: float
) -> tuple[float, dict[str, float], float]:
    """Join one reading per thermometer, the reference first, into the temperatures of an epoch.

    Returns UTC s, of the reference; {channel: °C}; s, reading minus frame; NaN if there is none.

    Channels keep the thermometer's own names where there is one thermometer; with several they are
    `<thermometer>` for its channel `temperature` and `<thermometer>_<channel>` for others. Without
    the reference the next thermometer that answered gives the time.
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

    Raises `error` where one has the name of another, or of a column of this program.
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
            f"{where}: the name `temperature` is reserved for the reference, which is the first of "
            f"the channels ({', '.join(columns)}); make it the first, or rename it"
        )
    return columns


def _column(thermometer: str, channel: str, thermometers: int) -> str:
    if thermometers == 1:
        return channel
    return thermometer if channel == "temperature" else f"{thermometer}_{channel}"


class Thermometers:
    """All thermometers of a configuration, and their last readings; threads may share it.

    Raises ConfigurationError for options that are wrong, and where the channels cannot all be
    columns of a camera's epochs.
    """

    def __init__(self, config: Config, clock: Clock, on_event: OnEvent = lambda *_: None) -> None:
        self.links: dict[str, Link] = {}
        self._cameras = config.cameras
        self._devices: dict[str, Thermometer] = {}
        self._channels: dict[str, tuple[str, ...]] = {}  # as named, then as read
        self._periods_s = {one.name: one.period_s for one in config.thermometers}
        self._kept: dict[str, deque[Reading]] = {}
        self._changed = threading.Condition()
        for one in config.thermometers:
            device = open_device("thermometer", one.driver, one.options, clock)
            self._devices[one.name] = device
            self.links[one.name] = Link(
                "thermometer", one.name, device, clock, period_s=one.period_s, on_event=on_event
            )
            self._channels[one.name] = tuple(device.named_channels())
            self._kept[one.name] = deque(maxlen=_REMEMBERED)
        self._require(self._channels, ConfigurationError)

    def _require(self, channels: Mapping[str, Sequence[str]], error: type[Exception]) -> None:
        for camera in self._cameras:
            require_columns({name: channels[name] for name in camera.thermometers}, error)

    def columns(self, names: Sequence[str]) -> list[str]:
        """Return the columns of the temperatures of some, the reference first, as far as known."""
        return require_columns({name: self._channels[name] for name in names}, ConfigurationError)

    def identity(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Return what they say they are."""
        return {name: self.links[name].identity() for name in names}

    def read(self, name: str) -> Reading:
        """Read one that is open, and keep what it says; raises a DeviceError."""
        reading = self._devices[name].read()
        self.add(name, reading)
        return reading

    def read_now(self, names: Sequence[str]) -> None:
        """Read some in the caller's thread: a recording's come with its frames."""
        for name in names:
            self.links[name].do(partial(self.read, name))

    def add(self, name: str, reading: Reading) -> None:
        """Keep a reading; WrongDevice where one of its channels cannot be a column."""
        if new := [c for c in reading.values if c not in self._channels[name]]:
            channels = {**self._channels, name: (*self._channels[name], *new)}
            self._require(channels, WrongDevice)
            self._channels = channels
        with self._changed:
            self._kept[name].append(reading)
            self._changed.notify_all()

    def last(self, name: str) -> Mapping[str, float]:
        """Return the last values of one, {channel: °C}."""
        kept = self._kept[name]
        return kept[-1].values if kept else {}

    def nearest(self, name: str, monotonic: float) -> Reading | None:
        """Return the reading nearest to a time; None if all are more than 1.5 periods away."""
        with self._changed:
            found = min(self._kept[name], key=lambda r: abs(r.monotonic - monotonic), default=None)
        limit = _OLDEST_IN_PERIODS * self._periods_s[name]
        if found is None or abs(found.monotonic - monotonic) > limit:
            return None
        return found

    def around(
        self, names: Sequence[str], monotonic: float, patience_s: float
    ) -> tuple[float, dict[str, float], float]:
        """Return as `pair_readings` those around a frame; a channel that was not read is NaN.

        patience_s: of wall time to wait for a reading that is being taken just now; none is waited
        for that cannot come nearer.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: all(self._answered(name, monotonic) for name in names), patience_s
            )
        nearest = {name: self.nearest(name, monotonic) for name in names}
        utc, temperatures, skew_s = pair_readings(nearest, monotonic)
        # a reference that was not read leaves its place empty: no other takes it
        columns = dict.fromkeys(self.columns(names), math.nan)
        return utc, {**columns, **temperatures}, skew_s

    def _answered(self, name: str, monotonic: float) -> bool:
        kept = self._kept[name]
        return bool(kept) and kept[-1].monotonic >= monotonic - 0.5 * self._periods_s[name]
