"""Units of temperatures: as the heads of columns and the readings of any device state them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermocald.arrays import Array

UNITS = ("degC", "K", "degF")

_LETTERS = {"c": "degC", "k": "K", "f": "degF"}
_STATED = re.compile(
    r"(?:°|º|˚|(?<![^\W\d_])deg(?:rees?|\.)?|(?<![^\W\d_])grad)[\s_]*(?P<degree>[CFK])(?![^\W\d_])"
    r"|[(\[{]\s*(?P<bracket>[CFK])\s*[)\]}]"
    r"|(?P<word>celsius|fahrenheit|kelvin)"
    r"|(?P<sign>[℃℉])"
    r"|temp(?:eratur[ae]?)?[\s_./-]*(?P<temp>[CFK])(?![^\W\d_])"
    r"|[_,/]\s*(?P<tail>[CFK])$",
    re.IGNORECASE,
)


def stated_unit(text: str) -> str | None:
    """Return the unit, one of `UNITS`, that a column's head or a reading states, or None.

    `(F)`, `[F]`, `°F`, `ºF`, `℉`, `degF`, `deg. F`, `TempF`, `temp_f`, `Temperature, F` and
    `Fahrenheit` state the same.
    """
    found = _STATED.search(text)
    if found is None:
        return None
    kind, value = next((k, v.lower()) for k, v in found.groupdict().items() if v)
    if kind == "sign":
        return "degC" if value == "℃" else "degF"
    return _LETTERS[value[0]]


def to_celsius(values: Array, unit: str) -> Array:
    """Convert temperatures (n,) in one of `UNITS` to °C."""
    if unit == "K":
        return values - 273.15
    return (values - 32.0) / 1.8 if unit == "degF" else values
