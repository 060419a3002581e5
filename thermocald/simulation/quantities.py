"""Numbers with units in files written by hand: `3.04`, or `{value: 3.04, sd: 0.01, unit: mm}`.

A bare number has the unit the documentation states; a unit that is written out must be that one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

__all__ = ["Quantity", "QuantityReader", "written"]


@dataclass(frozen=True, slots=True)
class Quantity:
    """A value and its standard deviation (None where none is known), in the unit asked for."""

    value: float
    sd: float | None = None


def written(value: float, unit: str, sd: float | None = None) -> dict[str, Any]:
    """The mapping that a file holds for a number."""
    document: dict[str, Any] = {"value": float(value)}
    if sd is not None and math.isfinite(sd):
        document["sd"] = float(sd)
    return {**document, "unit": unit}


class QuantityReader:
    """One mapping of a file; errors name the file and the dotted key."""

    def __init__(self, path: Path | str, mapping: Any, prefix: str = "") -> None:
        self._path = path
        self._prefix = prefix
        if not isinstance(mapping, dict):
            what = "is missing" if mapping is None else "must hold `key: value` pairs"
            raise ConfigurationError(f"{path}, {prefix.rstrip('.') or 'the file'}: {what}")
        self.mapping: Mapping[str, Any] = mapping

    def fail(self, key: str, message: str) -> ConfigurationError:
        """An error at a key; the caller raises it."""
        return ConfigurationError(f"{self._path}, key {self._prefix}{key}: {message}")

    def only(self, known: Iterable[str]) -> None:
        """Refuse keys that nobody reads."""
        names = list(known)
        for key in self.mapping:
            if key not in names:
                near = get_close_matches(str(key), names, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}"
                raise self.fail(str(key), f"is unknown; {hint}")

    def text(self, key: str, default: str | None = None) -> str:
        """Text; a number counts as its digits."""
        value = self.mapping.get(key, default)
        if value is None:
            raise self.fail(key, "is missing")
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise self.fail(key, "must be text")
        return str(value)

    def number(self, key: str, unit: str, default: float | None = None, low: float = -math.inf,
               above: float = -math.inf) -> float:  # fmt: skip
        """The value of a quantity, at least `low` and more than `above`."""
        return self.quantity(key, unit, default, low, above).value

    def quantity(self, key: str, unit: str, default: float | None = None, low: float = -math.inf,
                 above: float = -math.inf) -> Quantity:  # fmt: skip
        """A number in `unit`; an error if it is missing, no number, of another unit, too low."""
        raw = self.mapping.get(key, default)
        if raw is None:
            raise self.fail(key, f"is missing; it is a number in {unit}")
        sd: float | None = None
        if isinstance(raw, dict):
            inner = QuantityReader(self._path, raw, f"{self._prefix}{key}.")
            inner.only(("value", "sd", "unit"))
            found = inner.text("unit", unit)
            if found != unit:
                raise inner.fail("unit", f"is {found!r}; it must be {unit!r}: convert the value")
            if "value" not in raw:
                raise inner.fail("value", "is missing")
            if raw.get("sd") is not None:
                sd = inner._float("sd", raw["sd"])
                if sd < 0:
                    raise inner.fail("sd", f"is {sd:g}; a standard deviation is not negative")
            raw = raw["value"]
        value = self._float(key, raw)
        if value < low:
            raise self.fail(key, f"is {value:g} {unit}; it must be at least {low:g}")
        if value <= above:
            raise self.fail(key, f"is {value:g} {unit}; it must be above {above:g}")
        return Quantity(value, sd)

    def _float(self, key: str, raw: Any) -> float:
        try:
            # PyYAML reads 1e-3 as text, since YAML 1.1 wants a point
            value = float(raw) if isinstance(raw, str | int | float) else math.nan
        except (ValueError, OverflowError):
            value = math.nan
        if isinstance(raw, bool) or not math.isfinite(value):
            raise self.fail(key, f"{str(raw)[:40]!r} is not a finite number")
        return value

    def whole(self, key: str, unit: str, low: int = 1) -> int:
        """A whole number."""
        value = self.number(key, unit, low=low)
        if value != int(value):
            raise self.fail(key, f"is {value:g}; it must be a whole number")
        return int(value)

    def inner(self, key: str) -> QuantityReader:
        """The mapping at a key."""
        if self.mapping.get(key) is None:
            raise self.fail(key, "is missing")
        return QuantityReader(self._path, self.mapping[key], f"{self._prefix}{key}.")

    def items(self, key: str) -> Iterator[QuantityReader]:
        """The mappings of a list at a key; none where the key is absent."""
        values = self.mapping.get(key) or []
        if not isinstance(values, list):
            raise self.fail(key, "must be a list (lines that begin with `-`)")
        for number, value in enumerate(values, start=1):
            yield QuantityReader(self._path, value, f"{self._prefix}{key}[{number}].")
