"""Dates and times as loggers and cameras write them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, timezone

DATE_ORDERS = ("ymd", "dmy", "mdy")

_DATE = r"(?P<a>\d{1,4})(?P<mark>[-./:])(?P<b>\d{1,2})(?P=mark)(?P<c>\d{1,4})\.?"
_COMPACT_DATE = r"(?P<compact>\d{8})"
_TIME = (
    r"(?P<h>\d{1,2})[:.](?P<m>\d{2})(?:[:.](?P<s>\d{2})(?:[.,:](?P<f>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_COMPACT_TIME = r"(?P<ct>\d{6})(?:[.,]?(?P<cf>\d{1,9}))?"
_ZONE = r"\s*(?P<zone>Z|UTC|GMT|CES?T|MES?Z|(?:UTC|GMT)?[+-]\d{2}:?\d{2}|[+-]\d{2})?"
_FULL = re.compile(rf"(?:{_DATE}|{_COMPACT_DATE})[ T,;_-]+(?:{_TIME}|{_COMPACT_TIME}){_ZONE}")
_ONLY_DATE = re.compile(rf"(?:{_DATE}|{_COMPACT_DATE})")
_ONLY_TIME = re.compile(rf"{_TIME}{_ZONE}")
_NUMBER = re.compile(r"\d{9,13}(?:[.,]\d+)?|\d{16}|\d{19}")
_NAMED_DATE = re.compile(
    r"(?:[^\W\d_]{2,9}\.?,?\s+)?"  # the day of the week
    r"(?:(?P<m1>[^\W\d_]{3,9})\.?\s+(?P<d1>\d{1,2})(?:st|nd|rd|th)?,?\s+(?P<y1>\d{4})"
    r"|(?P<d2>\d{1,2})[\s.-]+(?P<m2>[^\W\d_]{3,9})[\s.,-]+(?P<y2>\d{4}|\d{2}))(?P<rest>\D.*|)"
)
_MONTHS = {
    name: number
    for number, names in enumerate(
        ("jan", "feb", "mar mär mrz mrt", "apr", "may mai mei", "jun", "jul", "aug", "sep",
         "oct okt", "nov", "dec dez"), 1)
    for name in names.split()
}  # fmt: skip
"""By the first letters, as English, German and Dutch loggers write them."""
_WORD = re.compile(r"[A-Za-z]{3}")
_CHINESE = str.maketrans({"年": "-", "月": "-", "日": " "})
_ZONES_H = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}
_PARTS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))  # seconds since 1970 are fewer for 3000 years


@dataclass(frozen=True, slots=True)
class MomentFormat:
    """order: of the parts of a date, one of DATE_ORDERS, None for what its form says."""

    order: str | None = None


def parse_moment(text: str, form: MomentFormat | None = None) -> datetime | date | time:
    """A date with a time, with or without a zone; or a date, or a time, alone.

    Numbers are seconds (or ms, µs, ns) since 1970 UTC. Raises ValueError for what is none of these.
    """
    form = form or MomentFormat()
    text = _numbered(text.strip())
    if _NUMBER.fullmatch(text):
        return seconds_as_moment(float(text.replace(",", ".")))
    if found := _FULL.fullmatch(text):
        return datetime.combine(_date(found, form), _time(found))
    if found := _ONLY_TIME.fullmatch(text):
        return _time(found)
    if found := _ONLY_DATE.fullmatch(text):
        return _date(found, form)
    raise ValueError(f"{text[:40]!r} is not a time")


def seconds_as_moment(seconds: float) -> datetime:
    """Seconds, or ms, µs, ns, since 1970 UTC; ValueError where they are not."""
    try:
        return datetime.fromtimestamp(whole_seconds(seconds), UTC)
    except (OverflowError, OSError) as cause:
        raise ValueError(f"{seconds} is not a time") from cause


def whole_seconds(number: float) -> float:
    """Seconds since 1970 of a number of s, ms, µs, or ns, told by its size."""
    return number / next((parts for least, parts in _PARTS if number >= least), 1.0)


def is_date_like(text: str) -> bool:
    """Whether it is 06/14/2026, with or without a time, whichever number is the month."""
    return re.match(r"\d{1,2}[/-]\d{1,2}[/-]\d{2,4}(?!\d)", text) is not None


def day_and_month(text: str) -> tuple[int, int] | None:
    """First and second number of a date written with / or -, not beginning with the year."""
    text = _numbered(text.strip())
    found = _FULL.fullmatch(text) or _ONLY_DATE.fullmatch(text)
    if found is None or found["compact"] or len(found["a"]) == 4 or found["mark"] == ".":
        return None
    return int(found["a"]), int(found["b"])


def _numbered(text: str) -> str:
    """A date whose month is a word, or which is Chinese, as 2026-06-14."""
    if text.isascii() and not _WORD.search(text):
        return text
    text = text.translate(_CHINESE)
    found = _NAMED_DATE.fullmatch(text)
    if found is None:
        return text
    month = _MONTHS.get((found["m1"] or found["m2"])[:3].lower())
    if month is None:
        return text
    day, year = int(found["d1"] or found["d2"]), found["y1"] or found["y2"]
    return f"{year if len(year) == 4 else 2000 + int(year)}-{month}-{day}{found['rest']}"


def _date(found: re.Match[str], form: MomentFormat) -> date:
    if found["compact"]:
        text = found["compact"]
        return date(int(text[:4]), int(text[4:6]), int(text[6:]))
    a, b, c = (int(found[part]) for part in "abc")
    if len(found["a"]) == 4:
        return date(a, b, c)
    year = c if len(found["c"]) == 4 else 2000 + c
    month_first = form.order == "mdy" and found["mark"] != "."
    return date(year, a, b) if month_first else date(year, b, a)


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
            if not 1 <= hour <= 12:
                raise ValueError(f"{hour} {groups['half']} is not a time")
            hour = hour % 12 + (12 if groups["half"][0] in "Pp" else 0)
    micro = int(part.ljust(6, "0")[:6]) if part else 0
    return time(hour, minute, second, micro, tzinfo=_zone(groups["zone"]))


def _zone(text: str | None) -> timezone | None:
    if not text:
        return None
    if text in _ZONES_H:
        return timezone(timedelta(hours=_ZONES_H[text]))
    sign = -1 if "-" in text else 1
    digits = re.sub(r"\D", "", text)
    return timezone(sign * timedelta(hours=int(digits[:2]), minutes=int(digits[2:] or 0)))
