"""Times of day that a device wrote, brought to UTC: time zone, daylight saving, clock error.

A time without a zone is never taken as UTC, nor as this computer's: the zone must be given. An hour
that daylight saving repeats or leaves out is refused unless the caller says how it is meant.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from thermocald.errors import DataError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array

AMBIGUOUS = ("refuse", "order", "earlier", "later")
"""What to do with the hour that comes twice: refuse it, go by the order of the rows, take one."""

_OFFSET = re.compile(r"(?:UTC|GMT)?([+-])(\d{1,2})(?::?(\d{2}))?", re.IGNORECASE)
_ERROR = re.compile(r"([+-]?)(?:(\d+):)?(\d+):(\d+(?:\.\d+)?)|([+-]?)(\d+(?:\.\d+)?)s?")
_LARGEST_OFFSET_H = 14


def time_zone(text: str) -> tzinfo:
    """`Europe/Berlin`, `UTC`, `+02:00` or `UTC+2` as a zone; UsageError for anything else."""
    name = text.strip()
    if name.upper() in ("UTC", "GMT", "Z"):
        return UTC
    if found := _OFFSET.fullmatch(name.replace(" ", "")):
        sign, hours, minutes = found.groups()
        offset = timedelta(hours=int(hours), minutes=int(minutes or 0))
        if offset <= timedelta(hours=_LARGEST_OFFSET_H):
            return timezone(-offset if sign == "-" else offset)
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise UsageError(
            f"time zone {text!r} is not known: write Europe/Berlin, UTC, or an offset like +02:00"
        ) from None


def clock_error(text: str) -> float:
    """`+00:03:12`, `-12:30`, `+4.5` (s): how far a clock was ahead of the true time, in s.

    UsageError for anything else.
    """
    found = _ERROR.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"clock error {text!r}: write +HH:MM:SS where the clock was ahead, -HH:MM:SS where it "
            "was behind, or seconds"
        )
    sign, hours, minutes, seconds, sign_s, only = found.groups()
    if only is not None:
        return -float(only) if sign_s == "-" else float(only)
    total = int(hours or 0) * 3600 + int(minutes) * 60 + float(seconds)
    return -total if sign == "-" else total


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """How a device's times are meant.

    zone: of times without one, None where it was not said; ahead: s, how far the clock was ahead of
    the true time; ambiguous: one of AMBIGUOUS; forced: the zone is that of times with a zone too;
    option: what to write where the zone is missing, for messages.
    """

    zone: tzinfo | None = None
    ahead: float = 0.0
    ambiguous: str = "refuse"
    forced: bool = False
    option: str = "--timezone"

    def utc(self, moments: Sequence[datetime], where: Callable[[int], str]) -> Array:
        """Seconds since 1970 UTC (n,) of moments as the device wrote them.

        where: names the place of moment i. Raises DataError for a time without a zone, for one that
        does not exist, and for one that exists twice where the order does not tell which.
        """
        if self.ambiguous not in AMBIGUOUS:
            raise UsageError(f"{self.ambiguous!r} is not one of {', '.join(AMBIGUOUS)}")
        seconds = np.empty(len(moments))
        twice: list[int] = []
        for i, moment in enumerate(moments):
            if moment.tzinfo is not None and not self.forced:
                seconds[i] = moment.timestamp()
                continue
            if self.zone is None:
                raise DataError(
                    f"{where(i)}: {moment:%Y-%m-%d %H:%M:%S} has no time zone: say which with "
                    f"{self.option}, such as {self.option} Europe/Berlin or {self.option} UTC"
                )
            local = moment.replace(tzinfo=self.zone, fold=0)
            seconds[i] = local.timestamp()
            if local.utcoffset() != local.replace(fold=1).utcoffset():
                if not _exists(local):
                    raise DataError(
                        f"{where(i)}: {moment:%Y-%m-%d %H:%M:%S} does not exist in {self.zone}: "
                        "clocks were put forward. A device that does not change its clock has a "
                        f"fixed zone: {self.option} {_offset_before(local)}"
                    )
                twice.append(i)
        if twice:
            self._settle(seconds, moments, twice, where)
        return seconds - self.ahead

    def _settle(
        self,
        seconds: Array,
        moments: Sequence[datetime],
        twice: list[int],
        where: Callable[[int], str],
    ) -> None:
        """Decide between the two times of each moment that exists twice, in place."""
        first = twice[0]
        moment = moments[first]
        again = f"{where(first)}: {moment:%Y-%m-%d %H:%M:%S} exists twice in {self.zone}"
        if self.ambiguous == "refuse":
            raise DataError(
                f"{again} (clocks were put back): say --ambiguous order where the rows are in the "
                "order of time, else --ambiguous earlier or later"
            )
        if self.ambiguous == "earlier":
            return
        later = np.array([_later(moments[i], self.zone) for i in twice])
        if self.ambiguous == "later":
            seconds[twice] = later
            return
        back = [k for k in range(1, len(twice)) if seconds[twice[k]] < seconds[twice[k - 1]]]
        if len(back) != 1:
            raise DataError(
                f"{again}, and the order of the rows does not tell which is meant (it runs back "
                f"{len(back)} times, not once): say --ambiguous earlier or later"
            )
        seconds[twice[back[0] :]] = later[back[0] :]


def device_clock(
    timezone: str | None = None,
    own: str | None = None,
    ahead: str = "0",
    ambiguous: str = "order",
    option: str = "--timezone",
) -> DeviceClock:
    """Return the clock of one device from what is said of it as text.

    timezone: of all devices; own: its own, which counts for times with a zone too; ahead: how far
    it was ahead, as `clock_error` reads it; option: that says its own. Raises UsageError.
    """
    if ambiguous not in AMBIGUOUS:
        raise UsageError(f"--ambiguous {ambiguous}: must be one of {', '.join(AMBIGUOUS)}")
    text = own if own is not None else timezone
    return DeviceClock(
        zone=None if text is None else time_zone(text),
        ahead=clock_error(ahead),
        ambiguous=ambiguous,
        forced=own is not None,
        option=option if own is not None else "--timezone",
    )


def _exists(local: datetime) -> bool:
    back = local.astimezone(UTC).astimezone(local.tzinfo)
    return back.replace(tzinfo=None) == local.replace(tzinfo=None)


def _later(moment: datetime, zone: tzinfo | None) -> float:
    return moment.replace(tzinfo=zone, fold=1).timestamp()


def _offset_before(local: datetime) -> str:
    """The offset before the change, as it is written in a zone."""
    # in a gap, fold 0 has the offset that was valid before
    offset = local.utcoffset() or timedelta()
    minutes = int(offset.total_seconds() // 60)
    sign = "-" if minutes < 0 else "+"
    return f"{sign}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}"
