"""When to raise an alert: thresholds on the results, each reported once out and once in again.

A condition that is out is in again only when the value is clearly back (hysteresis): a value at
its threshold does not ring all night. A result without the value changes nothing.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Alert", "Condition", "Watch", "condition_of"]

_BACK = 0.8
"""A drift is in again below this part of its threshold."""
_DISK_BACK = 1.1
_KEYS = {
    "drift": {"drift", "px", "sds", "from_mm"},
    "temperature": {"temperature", "above_c", "below_c", "hysteresis_k"},
    "no_result": {"no_result"},
    "free_disk_gb": {"free_disk_gb", "path"},
}


@dataclass(frozen=True, slots=True)
class Alert:
    """One change of one condition: `state` is `out` or `in`; utc: s, the epoch's."""

    device: str
    condition: str
    state: str
    text: str
    value: float
    threshold: float
    series: str
    epoch: int | None
    utc: float | None

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "format": "thermocald-alert/1",
            "device": self.device,
            "condition": self.condition,
            "state": self.state,
            "text": self.text,
            "value": self.value,
            "threshold": self.threshold,
            "series": self.series,
            "epoch": self.epoch,
            "utc": self.utc,
        }


@dataclass(frozen=True, slots=True)
class Condition:
    """A threshold. kind: a key of `when`; of: parameter, channel or path; low, high: bounds, NaN
    for none; back: how far inside them the value is in again; unit: of the value; reference: mm, of
    a drift, NaN for the start of the series.
    """

    name: str
    kind: str
    of: str
    low: float
    high: float
    back: float
    unit: str
    reference: float = math.nan

    def value(self, result: Mapping[str, Any], failed: int) -> float:
        """What is compared; NaN where the result does not have it. failed: epochs in a row."""
        if self.kind == "no_result":
            return float(failed)
        if self.kind == "free_disk_gb":
            try:
                disk = os.statvfs(self.of)
            except OSError:
                return math.nan
            return disk.f_bavail * disk.f_frsize / 1e9
        if self.kind == "temperature":
            return _number(result.get(self.of))
        return self._drift(result)

    def _drift(self, result: Mapping[str, Any]) -> float:
        drift = _number(result.get(f"drift_{self.of}_px"))
        sd = _number(result.get(f"sd_drift_{self.of}_px"))
        if not math.isnan(self.reference):
            pitch = _number(result.get("pixel_pitch"))
            pitch = pitch if pitch > 0 else math.nan
            drift = (_number(result.get(self.of)) - self.reference) / pitch
            sd = _number(result.get(f"sd_{self.of}")) / pitch
        if self.unit == "px":
            return abs(drift)
        return abs(drift) / sd if sd > 0 else math.nan

    def beyond(self, value: float) -> float:
        """The bound that a value has passed, NaN if none."""
        return self.low if value < self.low else self.high if value > self.high else math.nan

    def inside(self, value: float) -> bool:
        """Whether the value is clearly within the bounds again."""
        low_kept = math.isnan(self.low) or value >= self.low + self.back
        return low_kept and (math.isnan(self.high) or value <= self.high - self.back)

    @property
    def _origin(self) -> str:
        if math.isnan(self.reference):
            return "the start of the series"
        return f"{self.reference:g} mm"

    def text(self, value: float, bound: float) -> str:
        """The value and its bound in words."""
        unit = f" {self.unit}" if self.unit else ""
        what = {
            "drift": f"{self.of} is {value:.3g}{unit} from {self._origin}",
            "temperature": f"{self.of} is {value:.1f}{unit}",
            "no_result": f"{value:.0f} epochs in a row without a result",
            "free_disk_gb": f"{value:.2f}{unit} are free at {self.of}",
        }[self.kind]
        if math.isnan(bound):
            return f"{what}: within its limits again"
        limit = bound + 1 if self.kind == "no_result" else bound
        return f"{what} (limit {limit:g}{unit})"


def condition_of(stanza: object) -> Condition:
    """A condition from an entry of `when`; ConfigurationError names what is wrong in it."""
    if not isinstance(stanza, dict):
        raise ConfigurationError(f"when: {stanza!r} is not a mapping such as {{drift: c, px: 0.5}}")
    kind = next((k for k in _KEYS if k in stanza), None)
    if kind is None:
        raise ConfigurationError(f"when: {stanza} has none of {', '.join(_KEYS)}")
    if unknown := set(map(str, stanza)) - _KEYS[kind]:
        raise ConfigurationError(f"when: {kind} has no key {min(unknown)!r}")

    def bound(key: str, low: float, high: float) -> float:
        return support.number(f"when: {key}", stanza[key], low, high) if key in stanza else math.nan

    if kind == "drift":
        of = support.choice("when: drift", stanza["drift"], ("c", "x0", "y0"))
        unit = "px" if "px" in stanza else "sds"
        if ("px" in stanza) == ("sds" in stanza):
            raise ConfigurationError(f"when: drift of {of} needs either px or sds")
        high = bound(unit, 1e-6, 1e6)
        name = f"drift_{of}_{unit}"
        origin = bound("from_mm", -1e4, 1e4)
        return Condition(name, kind, of, math.nan, high, (1 - _BACK) * high, unit, origin)
    if kind == "temperature":
        of = support.text("when: temperature", stanza["temperature"])
        low, high = bound("below_c", -273.15, 2000), bound("above_c", -273.15, 2000)
        back = support.number("when: hysteresis_k", stanza.get("hysteresis_k", 1.0), 0, 100, "K")
        if math.isnan(low) and math.isnan(high):
            raise ConfigurationError(f"when: temperature {of} needs above_c or below_c")
        if high - low <= 2 * back:
            raise ConfigurationError(f"when: temperature {of}: nothing is left between the limits")
        return Condition(of, kind, of, low, high, back, "°C")
    if kind == "no_result":
        count = support.number("when: no_result", stanza["no_result"], 1, 1e6, whole=True)
        # out from the count on, in with the first result
        return Condition(kind, kind, "", math.nan, count - 1, count - 1, "")
    low = bound("free_disk_gb", 1e-6, 1e6)
    path = support.text("when: path", stanza.get("path", "."))
    return Condition("free_disk", kind, path, low, math.nan, (_DISK_BACK - 1) * low, "GB")


class Watch:
    """The state of all conditions for every device whose results come."""

    def __init__(self, conditions: list[Condition]) -> None:
        self.conditions = conditions
        self._out: set[tuple[str, str]] = set()
        self._failed: dict[str, int] = {}
        self._seen: dict[str, tuple[Any, Any]] = {}

    def changes(self, result: Mapping[str, Any], device: str) -> list[Alert]:
        """What this result changes; the same result again changes nothing."""
        moment = (result.get("series"), result.get("epoch"))
        if moment[1] is not None and self._seen.get(device) == moment:
            return []
        self._seen[device] = moment
        failed = 0 if result.get("status") == "ok" else self._failed.get(device, 0) + 1
        self._failed[device] = failed
        changes = []
        for condition in self.conditions:
            key = ("" if condition.kind == "free_disk_gb" else device, condition.name)
            value = condition.value(result, failed)
            bound = condition.beyond(value)
            if key not in self._out and not math.isnan(bound):
                self._out.add(key)
                changes.append(_alert(condition, "out", value, bound, result, device))
            elif key in self._out and math.isnan(bound) and condition.inside(value):
                self._out.discard(key)
                changes.append(_alert(condition, "in", value, math.nan, result, device))
        return changes


def _alert(
    condition: Condition, state: str, value: float, bound: float, result: Mapping[str, Any],
    device: str,
) -> Alert:  # fmt: skip
    limit = condition.high if math.isnan(bound) and math.isnan(condition.low) else bound
    limit = condition.low if math.isnan(limit) else limit
    utc = _number(result.get("frame_time"))
    epoch = result.get("epoch")
    return Alert(
        device,
        condition.name,
        state,
        f"{device}: {condition.text(value, bound)}",
        value,
        limit,
        str(result.get("series", "")),
        int(epoch) if isinstance(epoch, int) else None,
        None if math.isnan(utc) else utc,
    )


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value)
