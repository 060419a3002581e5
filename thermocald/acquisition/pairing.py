"""Pairing: which readings belong to a frame.

Frame and readings keep their own times; nothing is interpolated here. Who needs the temperature at
the frame's time interpolates between the readings of neighbouring epochs.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.names import require_channels

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from thermocald.hal import Reading

_REMEMBERED = 16
_OLDEST_IN_PERIODS = 1.5


@dataclass(frozen=True, slots=True)
class PairedReadings:
    """What the thermometers said around a frame.

    utc: s, of the reference thermometer, NaN if there is none; temperatures: {channel: °C};
    skew_s: reading minus frame, NaN if there is none.
    """

    utc: float
    temperatures: Mapping[str, float]
    skew_s: float


def pair_readings(readings: Mapping[str, Reading | None], frame_monotonic: float) -> PairedReadings:
    """Join one reading per thermometer, the reference first, into the temperatures of an epoch.

    Channels keep the thermometer's own names where there is one thermometer; with several they are
    `<thermometer>` for its channel `temperature` and `<thermometer>_<channel>` for others. Without
    the reference the next thermometer that answered gives the time.
    """
    temperatures: dict[str, float] = {}
    reference: Reading | None = None
    for name, reading in readings.items():
        if reading is None:
            continue
        reference = reference or reading
        for channel, value in reading.values.items():
            temperatures[_column(name, channel, len(readings))] = value
    if reference is None:
        return PairedReadings(math.nan, {}, math.nan)
    return PairedReadings(reference.utc, temperatures, reference.monotonic - frame_monotonic)


def require_columns(thermometers: Mapping[str, Iterable[str]], error: type[Exception]) -> list[str]:
    """The columns of an epoch for {thermometer: its channels}, the reference first.

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
            f"{where}: `temperature` is what the reference is called, the first of the channels "
            f"({', '.join(columns)}); make it the first, or rename it"
        )
    return columns


def _column(thermometer: str, channel: str, thermometers: int) -> str:
    if thermometers == 1:
        return channel
    return thermometer if channel == "temperature" else f"{thermometer}_{channel}"


class Readings:
    """The last readings of all thermometers; threads add, pipelines ask."""

    def __init__(self, periods_s: Mapping[str, float]) -> None:
        self._periods_s = dict(periods_s)
        self._kept: dict[str, deque[Reading]] = {
            name: deque(maxlen=_REMEMBERED) for name in periods_s
        }
        self._changed = threading.Condition()

    def add(self, name: str, reading: Reading) -> None:
        """Keep a reading."""
        with self._changed:
            self._kept[name].append(reading)
            self._changed.notify_all()

    def nearest(self, name: str, monotonic: float) -> Reading | None:
        """The reading nearest to a time; None if all are more than 1.5 periods away."""
        with self._changed:
            found = min(self._kept[name], key=lambda r: abs(r.monotonic - monotonic), default=None)
        limit = _OLDEST_IN_PERIODS * self._periods_s[name]
        if found is None or abs(found.monotonic - monotonic) > limit:
            return None
        return found

    def around(self, names: Sequence[str], monotonic: float, patience_s: float) -> PairedReadings:
        """The readings around a frame.

        patience_s: of wall time to wait for a reading that is being taken just now; none is waited
        for that cannot come nearer.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: all(self._answered(name, monotonic) for name in names), patience_s
            )
        return pair_readings({name: self.nearest(name, monotonic) for name in names}, monotonic)

    def _answered(self, name: str, monotonic: float) -> bool:
        kept = self._kept[name]
        return bool(kept) and kept[-1].monotonic >= monotonic - 0.5 * self._periods_s[name]
