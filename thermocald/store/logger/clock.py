"""Convert dates and times of loggers and cameras to UTC.

A time without a zone is taken neither as UTC nor as local time: the zone must be given. A time that
daylight saving skips is refused, and one that it repeats too, unless it is given which is meant.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, timezone, tzinfo
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

import numpy as np

from thermocald.errors import DataError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array


ORDERS = {"dmy": "day/month/year", "mdy": "month/day/year", "ymd": "year/month/day"}
"""Orders of a date that does not begin with a year of four digits."""
AMBIGUOUS = ("refuse", "order", "earlier", "later")
"""How to treat the repeated hour: refuse it, use the order of the rows, or take one."""

_OFFSET = re.compile(r"(?:UTC|GMT)?([+-])(\d{1,2})(?:[:.]?(\d{2}))?", re.IGNORECASE)
_ERROR = re.compile(r"([+-]?)(?:(?:(\d+):)?(\d+):)?(\d+(?:\.\d+)?)s?")
_LARGEST_OFFSET_H = 14


def time_zone(text: str) -> tzinfo:
    """Return the zone `Europe/Berlin`, `UTC`, `+02:00` or `UTC+2`. Raises UsageError."""
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
            f"time zone {text!r} is unknown; give Europe/Berlin, UTC, or an offset like +02:00"
        ) from None


def stated_zones(text: str) -> dict[str, tzinfo]:
    """Return the zones that a head names: Europe/Berlin, else such as GMT+01:00 or EST and EDT."""
    cities = {n: time_zone(n) for n in _CITY.findall(text) if n in available_timezones()}
    return cities or {name: _zone(name.upper()) for name in _STATED_ZONE.findall(text)}


def lacks_zone(text: str) -> bool:
    """Return whether text is a date with a time, or a time, to which a zone can be added."""
    text = _month_to_number(text.strip())
    found = _FULL.fullmatch(text) or _ONLY_TIME.fullmatch(text)
    return found is not None and not found["zone"]


def clock_error(text: str) -> float:
    """Return by how many seconds a clock was ahead, from `+00:03:12`, `-12:30` or `+4.5` (s).

    Raises UsageError for other text.
    """
    found = _ERROR.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"clock error {text!r}: give +HH:MM:SS if the clock was ahead, -HH:MM:SS if it was "
            "behind, or seconds"
        )
    sign, hours, minutes, seconds = found.groups()
    total = int(hours or 0) * 3600 + int(minutes or 0) * 60 + float(seconds)
    return -total if sign == "-" else total


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """The clock of a device: its zone and its error.

    zone: of times without one, None if not given; ahead: s, by which the clock was ahead of the
    true time; ambiguous: one of AMBIGUOUS; forced: the zone also replaces that of times with one;
    option: the option that gives a missing zone, for messages.
    """

    zone: tzinfo | None = None
    ahead: float = 0.0
    ambiguous: str = "refuse"
    forced: bool = False
    option: str = "--timezone"

    def utc(
        self,
        moments: Sequence[datetime],
        where: Callable[[int], str],
        of: NDArray[np.int64] | None = None,
        after: Array | None = None,
    ) -> Array:
        """Convert times written by the device to seconds since 1970 UTC, (n,).

        Time i is `after[i]` s after the moment `of[i]`, in the same minute; by default it is moment
        i. where: names the place of time i. Raises DataError for a time without a zone, for one
        that does not exist, and for one that exists twice if it is not known which one is meant.
        """
        of = np.arange(len(moments)) if of is None else of
        after = np.zeros(len(of)) if after is None else after

        def written(i: int) -> str:
            moment = moments[of[i]] + timedelta(seconds=float(after[i]))
            return f"{where(i)}: {moment:%Y-%m-%d %H:%M:%S}"

        early, late = np.empty((2, len(moments)))  # differ where the clock was put back or forward
        for k, moment in enumerate(moments):
            local = moment
            if moment.tzinfo is None or self.forced:
                if self.zone is None:
                    raise DataError(
                        f"{written(int(np.argmax(of == k)))} has no time zone: give it with "
                        f"{self.option}, such as {self.option} Europe/Berlin or {self.option} UTC"
                    )
                local = moment.replace(tzinfo=self.zone)
            early[k], late[k] = (local.replace(fold=fold).timestamp() for fold in (0, 1))
            if early[k] > late[k]:
                raise DataError(
                    f"{written(int(np.argmax(of == k)))} does not exist in {self.zone}: "
                    "clocks were put forward. For a device that does not change its clock, "
                    # fold 0 has the offset from before the change
                    f"give a fixed zone: {self.option} {local.replace(fold=0).isoformat()[-6:]}"
                )
        early, late = early[of] + after, late[of] + after
        twice = np.flatnonzero(early < late)
        if len(twice) and self.ambiguous != "earlier":
            again = f"{written(twice[0])} exists twice in {self.zone}"
            early[twice] = self._choose(early[twice], late[twice], again)
        return early - self.ahead

    def _choose(self, earlier: Array, later: Array, again: str) -> Array:
        """Return the times (n,) s that are meant of those which exist twice."""
        if self.ambiguous == "refuse":
            raise DataError(
                f"{again} (clocks were put back): give --ambiguous order if the rows are in the "
                "order of time, else --ambiguous earlier or later"
            )
        if self.ambiguous == "later":
            return later
        back = np.flatnonzero(np.diff(earlier) < 0) + 1
        if (np.diff(earlier) > 0).sum() == 1 < len(back):  # the newest row is the first
            return self._choose(earlier[::-1], later[::-1], again)[::-1]
        if len(back) != 1:
            raise DataError(
                f"{again}, and the order of the rows does not show which is meant (time runs back "
                f"{len(back)} times, not once): give --ambiguous earlier or later"
            )
        return np.concatenate([earlier[: back[0]], later[back[0] :]])


def device_clock(
    timezone: str | None = None,
    own: str | None = None,
    ahead: str = "0",
    ambiguous: str = "order",
    option: str = "--timezone",
) -> DeviceClock:
    """Return the clock of one device from the text of options.

    timezone: of all devices; own: the device's, which also replaces the zone of times with one;
    ahead: the clock's error, see `clock_error`; option: that of `own`. Raises UsageError.
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


_DATE = r"(?P<a>\d{1,4})(?P<mark>[-/:]|\. ?)(?P<b>\d{1,2})(?P=mark)(?P<c>\d{1,4})\.?"
_COMPACT_DATE = r"(?P<compact>\d{8})"
_TIME = (
    r"(?P<h>\d{1,2})[:.](?P<m>\d{2})(?:[:.](?P<s>\d{2})(?:[.,:](?P<f>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?|[FfEe][Mm]|[ΠΜπμ]\.?μ\.?|(?:vor|nach)m\.)?"
)
_COMPACT_TIME = r"(?P<ct>\d{6})(?:[.,]?(?P<cf>\d{1,9}))?"
ZONES_H = {
    "Z": 0, "UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2,
    "MESZ": 2, "EET": 2, "EEST": 3, "EST": -5, "EDT": -4, "CDT": -5, "MST": -7, "MDT": -6,
    "PST": -8, "PDT": -7, "JST": 9, "AEST": 10, "AEDT": 11,
}  # fmt: skip
"""Zones by their letters; without CST, which China and America have."""
_ZONE = rf"(?:,?\s*(?P<zone>{'|'.join(ZONES_H)}|(?:UTC|GMT)?[+-]\d{{2}}(?::?\d{{2}})?))?"
_STATED_ZONE = re.compile(
    rf"(?<![^\W_])((?i:UTC|GMT)\s*[+-]\s*\d{{1,2}}(?:[:.]?\d{{2}})?(?![.,]?\d|[½¼¾])"
    r"|(?:(?i:UTC|GMT)(?![\s_-]*(?:offset|plus|minus|[+-]\s*\d))|CST(?=/CDT)|"
    rf"{'|'.join(ZONES_H.keys() - {'Z', 'UTC', 'GMT'})})(?![^\W_]))"
)
_CITY = re.compile(r"[A-Z][a-z]+/[A-Z][\w/+-]+")
_FULL = re.compile(rf"(?:{_DATE}|{_COMPACT_DATE})[ T,;_-]+(?:{_TIME}|{_COMPACT_TIME}){_ZONE}")
_ONLY_DATE = re.compile(rf"(?:{_DATE}|{_COMPACT_DATE})")
_ONLY_TIME = re.compile(rf"{_TIME}{_ZONE}")
_NUMBER = re.compile(r"\d{9,13}(?:[.,]\d+)?|\d{16}|\d{19}|\d\.\d{9,}[eE]\+(?:09|12)")
_NAMED_DATE = re.compile(
    r"(?:[^\W\d_]{2,9}\.?,?\s+)?"  # the day of the week
    r"(?:(?P<m1>[^\W\d_]{3,9})\.?\s+(?P<d1>\d{1,2})(?:st|nd|rd|th)?,?\s+(?P<y1>\d{4})"
    r"|(?P<d2>\d{1,2})[\s.-]+(?P<m2>[^\W\d_]{3,9})[\s.,-]+(?P<y2>\d{4}|\d{2}))(?P<rest>\D.*|)"
)
_OF_DATE = re.compile(  # of `date` and ctime: Sun Jun 14 12:00:00 CEST 2026, So 14. Jun 12:00:00 …
    r"^[^\W\d_]{2,4}\.? +(?:([^\W\d_]{3,4})\.? +(\d{1,2})|(\d{1,2})\.? +([^\W\d_]{3,4})\.?) "
    r"(\d\d:\d\d:\d\d(?: [AP]M)?(?: [A-Z]{3,4})?) (\d{4})$"
)
_MONTHS = {
    name: number
    for number, names in enumerate(
        ("jan ene gen", "feb fev fév fév", "mar mär mär mrz mrt", "apr avr abr", "may mai mei mag",
         "jun juin giu", "jul juil lug", "aug aou aoû aoû ago", "sep set", "oct okt ott out", "nov",
         "dec dez déc déc dic"), 1)
    for name in names.split()
}  # fmt: skip
"""Months by their first letters in six languages; those that begin with `jui` by four."""
_SERIAL = re.compile(r"\d{5}(?:[.,]\d+)?")
_WORD = re.compile(r"[A-Za-z]{3}")
_CHINESE = str.maketrans(dict(zip("年月日时時分秒", "-- ::: ", strict=True)))
_COMPACT = re.compile(r"((?:19|20)\d\d[01]\d[0-3]\d)([0-2]\d[0-5]\d)([0-5]\d)?")
_HALF_DAY = re.compile(r"(?:(上午|午前|오전)|下午|午後|오후)\s*([\d:]+)")
_PARTS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))  # seconds are less until the year 5138


def iso(seconds: float, digits: str = "milliseconds") -> str:
    """Return a time as ISO 8601 in UTC; digits: milliseconds or microseconds."""
    moment = datetime.fromtimestamp(float(seconds), UTC)
    return moment.isoformat(timespec=digits).replace("+00:00", "Z")


def parse_moment(text: str, order: str | None = None) -> datetime | date | time:
    """Parse a date with a time, with or without a zone; or a date or a time alone.

    order: one of ORDERS; None: year-month-day or dmy, by the date's form.
    Numbers are seconds (or ms, µs, ns) since 1970 UTC. Raises ValueError for other text.
    """
    text = _month_to_number(text.strip())
    if found := _COMPACT.fullmatch(text):  # as ms it would be 1976
        text = f"{found[1]} {found[2]}{found[3] or '00'}"
    if _NUMBER.fullmatch(text):
        try:
            return datetime.fromtimestamp(whole_seconds(float(text.replace(",", "."))), UTC)
        except (OverflowError, OSError) as cause:
            raise ValueError(f"{text} is not a time") from cause
    if found := _FULL.fullmatch(text):
        if found["h"] == "24" and int(found["m"] + (found["s"] or "0")) == 0:  # a day's end
            begin = parse_moment(f"{text[: found.start('h')]}00{text[found.end('h') :]}", order)
            assert isinstance(begin, datetime)
            with suppress(OverflowError):
                return begin + timedelta(days=1)
        return datetime.combine(_date(found, order), _time(found))
    if found := _ONLY_TIME.fullmatch(text):
        return _time(found)
    if found := _ONLY_DATE.fullmatch(text):
        return _date(found, order)
    raise ValueError(f"{text[:40]!r} is not a time")


def day_begin(moment: date) -> datetime:
    """Return midnight of a date; a date with a time as it is."""
    return moment if isinstance(moment, datetime) else datetime.combine(moment, time())


def parse_serial(text: str) -> datetime:
    """Parse a spreadsheet's number of days since 1899-12-30. Raises ValueError for other text.

    Five decimals, as a cell shows, give the second; eight give the millisecond.
    """
    if not _SERIAL.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is no number of days")
    seconds = round(float(text.replace(",", ".")) * 86400.0, 3 if len(text) >= 14 else None)
    return datetime(1899, 12, 30) + timedelta(seconds=seconds)


def are_serials(texts: Sequence[str]) -> bool:
    """Return whether texts are a spreadsheet's days: of 2010 to 2050, at most 15 minutes apart.

    Seconds since a start would have to pass that range at 100 readings a second.
    """
    days = [float(t.replace(",", ".")) for t in texts if _SERIAL.fullmatch(t)]
    if len(days) <= max(1, 0.8 * len(texts)) or min(days) < 40179 or max(days) > 54789:
        return False
    return 0.0 < float(np.median(np.abs(np.diff(days)))) < 0.0105


def whole_seconds(number: float) -> float:
    """Convert a number of s, ms, µs or ns since 1970 to s; its size shows the unit."""
    return number / next((parts for least, parts in _PARTS if number >= least), 1.0)


def date_orders(text: str) -> set[str] | None:
    """Return the orders, of ORDERS, in which text is a date; None if it has only one form."""
    text = _month_to_number(text.strip())
    found = _FULL.fullmatch(text) or _ONLY_DATE.fullmatch(text)
    if found is None or found["compact"] or len(found["a"]) == 4:
        return None
    if found["mark"][0] == "." and len(found["c"]) == 4:
        return None
    possible = set()
    for order in ORDERS:
        with suppress(ValueError):
            _date(found, order)
            possible.add(order)
    if found["mark"][0] == ".":
        possible.discard("mdy")  # unless the user gives it
    return possible


def _month_to_number(text: str) -> str:
    """Rewrite a date with the month as a word, or in Chinese, as 2026-06-14."""
    if text.isascii() and not _WORD.search(text):
        return text
    text = _HALF_DAY.sub(lambda half: f"{half[2]} {'AM' if half[1] else 'PM'}", text)
    text = _OF_DATE.sub(r"\1\4 \2\3 \6 \5", text.translate(_CHINESE).rstrip(": "))
    found = _NAMED_DATE.fullmatch(text)
    if found is None:
        return text
    word = (found["m1"] or found["m2"]).lower()
    month = _MONTHS.get(word[:4]) or _MONTHS.get(word[:3])
    if month is None:
        return text
    day, year = int(found["d1"] or found["d2"]), found["y1"] or found["y2"]
    return f"{_full_year(int(year))}-{month}-{day}{found['rest']}"


def _full_year(year: int) -> int:
    """Return a year of two digits with its century, as POSIX does: 1969 to 2068."""
    return year + (0 if year > 99 else 1900 if year > 68 else 2000)


def _date(found: re.Match[str], order: str | None) -> date:
    if found["compact"]:
        return date.fromisoformat(found["compact"])
    a, b, c = (int(found[part]) for part in "abc")
    if len(found["a"]) == 4:
        return date(a, b, c)
    if len(found["c"]) != 4:
        a, c = (_full_year(a), c) if order == "ymd" else (a, _full_year(c))
    return date(a, b, c) if order == "ymd" else date(c, *((a, b) if order == "mdy" else (b, a)))


def _time(found: re.Match[str]) -> time:
    groups = found.groupdict()
    if groups.get("ct"):
        text = groups["ct"]
        hour, minute, second = int(text[:2]), int(text[2:4]), int(text[4:])
        part = groups.get("cf") or ""
    else:
        hour, minute, second = int(groups["h"]), int(groups["m"]), int(groups["s"] or 0)
        part = groups["f"] or ""
        if groups["half"]:
            if hour > 12:
                raise ValueError(f"{hour} {groups['half']} is not a time")
            hour = hour % 12 + (12 if groups["half"][0] in "PpEeΜμn" else 0)
    micro = int(part.ljust(6, "0")[:6]) if part else 0
    zone = _zone(groups["zone"]) if groups["zone"] else None
    return time(hour, minute, second, micro, tzinfo=zone)


def _zone(text: str) -> tzinfo:
    if text[-1].isdigit():
        return time_zone(text)
    return timezone(timedelta(hours=ZONES_H.get(text, -6)))  # else CST beside CDT
