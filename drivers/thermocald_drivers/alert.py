"""Alerts: thresholds on results; each crossing is delivered once, out of its limits and back in.

Hysteresis: a value counts as back only when it is clearly within its limits, so that noise at a
threshold does not raise alerts all night. A result without the value changes nothing.

Each alert driver is a separate output with its own thread and bounded queue in the daemon: an
unreachable receiver delays neither a tick nor the others. Undelivered alerts wait in order, also
while the output is closed and opened again; the newest `MOST_WAITING` are retained.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from thermocald.addresses import hide
from thermocald.errors import ConfigurationError
from thermocald.hal import DriverOptions, Output
from thermocald.names import WITH_VALUES
from thermocald.numbers import counted
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

MOST_WAITING = 100
_ENOUGH = 20
"""Results, after which a condition without any value is reported: a drift has none in the first."""
_BACK = 0.8
"""A drift is back below this fraction of its threshold."""
_DISK_BACK = 1.1
"""Free space is back above this multiple of its threshold."""


@dataclass(frozen=True, slots=True)
class Alert:
    """A change of one condition; state: `out` or `in`; utc: the epoch's time, s."""

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
        """Return the alert's JSON document."""
        return {"format": "thermocald-alert/1", **dataclasses.asdict(self)}


@dataclass(frozen=True, slots=True)
class Measured:
    """A condition's value, NaN if the result does not have it, and its bounds.

    back: distance inside a bound at which the value counts as back; step: from a bound to the
    threshold that was set.
    """

    value: float
    low: float
    high: float
    back: float
    words: str
    unit: str = ""
    step: int = 0


class Condition(DriverOptions):
    """A threshold of `when`; name: its name in alerts."""

    per_device: ClassVar[bool] = True
    called: ClassVar[str] = ""

    @property
    def name(self) -> str:
        return self.called

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:
        """Return the value and bounds to compare.

        failed: epochs in a row without a result; lost: epochs that were taken but not stored since
        the last result.
        """
        raise NotImplementedError


Amount = Annotated[float, Field(ge=1e-6, le=1e6)]


class Drift(Condition):
    """A parameter's drift from the start of the series or a value, in px or standard deviations."""

    drift: Literal["c", "x0", "y0"]
    px: Amount | None = None
    sds: Amount | None = None
    from_mm: Annotated[float, Field(ge=-1e4, le=1e4)] | None = None

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if (self.px is None) == (self.sds is None):
            raise ConfigurationError(f"drift of {self.drift} needs either px or sds")
        return self

    @property
    def name(self) -> str:
        return f"drift_{self.drift}_{'sds' if self.px is None else 'px'}"

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:  # noqa: ARG002
        drift = support.number_or_nan(result.get(f"drift_{self.drift}_px"))
        sd = support.number_or_nan(result.get(f"sd_drift_{self.drift}_px"))
        start = "the start of the series"
        if self.from_mm is not None:
            start = f"{self.from_mm:g} mm"
            pitch = support.number_or_nan(result.get("pixel_pitch"))
            pitch = pitch if pitch > 0 else math.nan
            drift = (support.number_or_nan(result.get(self.drift)) - self.from_mm) / pitch
            sd = support.number_or_nan(result.get(f"sd_{self.drift}")) / pitch
        unit, value, high = " px", abs(drift), float(self.px or self.sds or math.nan)
        if self.px is None:
            unit, value = " sds", abs(drift) / sd if sd > 0 else math.nan
        words = f"{self.drift} is {value:.3g}{unit} from {start}"
        return Measured(value, -math.inf, high, (1 - _BACK) * high, words, unit)


class Temperature(Condition):
    """A channel's temperature."""

    temperature: support.Text
    above_c: support.Celsius | None = None
    below_c: support.Celsius | None = None
    hysteresis_k: Annotated[float, Field(ge=0.0, le=100.0)] = 1.0

    @model_validator(mode="after")
    def _something_between(self) -> Self:
        low, high = self._limits
        if math.isinf(low) and math.isinf(high):
            raise ConfigurationError(f"temperature {self.temperature} needs above_c or below_c")
        if high - low <= 2 * self.hysteresis_k:
            raise ConfigurationError(
                f"temperature {self.temperature}: above_c must exceed below_c by more than twice "
                f"hysteresis_k ({2 * self.hysteresis_k:g} K)"
            )
        return self

    @property
    def name(self) -> str:
        return self.temperature

    @property
    def _limits(self) -> tuple[float, float]:
        low, high = self.below_c, self.above_c
        return -math.inf if low is None else low, math.inf if high is None else high

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:  # noqa: ARG002
        value = support.number_or_nan(result.get(self.temperature))
        words = f"{self.temperature} is {value:.1f} °C"
        return Measured(value, *self._limits, self.hysteresis_k, words, " °C")


Count = Annotated[int, Field(ge=1, le=1_000_000)]


def _counted(count: int, most: int, described: str) -> Measured:
    """Return a count of epochs with its bounds: out at `most` or more, back below it."""
    words = f"{counted(count, 'epoch')} {described}"
    return Measured(float(count), -math.inf, most - 1, most - 1, words, step=1)


class NoResult(Condition):
    """Epochs in a row without a result."""

    no_result: Count
    called: ClassVar[str] = "no_result"

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:  # noqa: ARG002
        return _counted(failed, self.no_result, "in a row without a result")


class Lost(Condition):
    """Epochs that were taken but not stored since the last result, or in a row wait in memory."""

    per_device: ClassVar[bool] = False
    lost: Count
    called: ClassVar[str] = "lost"

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:  # noqa: ARG002
        return _counted(lost, self.lost, "taken but not stored")


class FreeDisk(Condition):
    """The free space at a path, GB."""

    per_device: ClassVar[bool] = False
    free_disk_gb: Amount
    path: support.Text = "."
    called: ClassVar[str] = "free_disk"

    def measure(self, result: Mapping[str, Any], failed: int, lost: int) -> Measured:  # noqa: ARG002
        low, value = self.free_disk_gb, math.nan
        with suppress(OSError):
            disk = os.statvfs(self.path)
            value = disk.f_bavail * disk.f_frsize / 1e9
        words = f"{value:.2f} GB are free at {self.path}"
        return Measured(value, low, math.inf, (_DISK_BACK - 1) * low, words, " GB")


_KINDS: dict[str, type[Condition]] = {
    "drift": Drift, "temperature": Temperature, "no_result": NoResult, "lost": Lost,
    "free_disk_gb": FreeDisk,
}  # fmt: skip


class AlertOptions(DriverOptions):
    """The options of every alert driver."""

    when: Annotated[list[dict[str, Any]], Field(min_length=1)]
    device: support.Text = "thermocald"
    timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 5.0


class AlertOutput(Output):
    """An output that delivers alerts; a driver implements `deliver` and `open` and sets `where`.

    `open` checks that alerts can be delivered.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._conditions: list[Condition] = []
        for stanza in self.options.when:
            kind = next((kind for key, kind in _KINDS.items() if key in stanza), None)
            if kind is None:
                raise ConfigurationError(f"when: {stanza} has none of {', '.join(_KINDS)}")
            self._conditions.append(kind.read(stanza, "when"))
        names = [condition.name for condition in self._conditions]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ConfigurationError(f"when: {min(twice)} is given twice")
        self._waiting: deque[Alert] = deque(maxlen=MOST_WAITING)
        self._out: set[tuple[str, str]] = set()  # (device, condition)
        self._in_a_row: dict[str, int] = {}  # {device: latest epochs without a result}
        self._last: dict[str, tuple[Any, Any]] = {}  # {device: (series, epoch)}
        self._lost = self._unstored = self._results = 0
        self._compared: set[str] = set()  # conditions of which a result had the value

    def warnings(self) -> list[str]:
        if self._results < _ENOUGH:
            return []
        return [
            f"when: {condition.name}: no result so far has a value of it, so that it gives no alert"
            for condition in self._conditions
            if condition.name not in self._compared
        ]

    def emit(self, result: Mapping[str, Any]) -> None:
        self.opened()
        for alert in self.changes(result, str(result.get("device", self.options.device))):
            log.warning("%s", alert.text, extra={"event": "alert"})
            self._waiting.append(alert)
        while self._waiting:
            self.deliver(self._waiting[0])
            self._waiting.popleft()

    def changes(self, result: Mapping[str, Any], device: str) -> list[Alert]:
        """Return an alert for each condition that a result changes; a repeated result, none."""
        moment = (result.get("series"), result.get("epoch"))
        if moment[1] is not None and self._last.get(device) == moment:
            return []
        self._last[device] = moment
        failed = 0 if result.get("status") in WITH_VALUES else self._in_a_row.get(device, 0) + 1
        self._in_a_row[device] = failed
        utc = support.number_or_nan(result.get("frame_time"))
        epoch = moment[1] if isinstance(moment[1], int) else None
        before, self._lost = self._lost, int(result.get("lost", self._lost))
        self._unstored = self._unstored + 1 if result.get("stored") is False else 0
        lost = max(0, self._lost - before, self._unstored)
        changes = []
        self._results += 1
        for condition in self._conditions:
            key = (device if condition.per_device else "", condition.name)
            found = condition.measure(result, failed, lost)
            value, low, high = found.value, found.low, found.high
            if not math.isnan(value):
                self._compared.add(condition.name)
            out, was_out = value < low or value > high, key in self._out
            if out == was_out or not (out or low + found.back <= value <= high - found.back):
                continue
            self._out ^= {key}
            limit = (high if value > high or math.isinf(low) else low) + found.step
            bound = f" (limit {limit:g}{found.unit})"
            text = found.words + (bound if out else ": within its limits again")
            changes += [Alert(
                device, condition.name, "out" if out else "in", f"{device}: {text}", value, limit,
                str(result.get("series", "")), epoch, None if math.isnan(utc) else utc,
            )]  # fmt: skip
        return changes

    def deliver(self, alert: Alert) -> None:
        """Deliver one alert within `timeout_s`; raises a DeviceError."""
        raise NotImplementedError


def secret(name: str, path: str | None) -> str | None:
    """Read a password or token from a file and hide it from logs; None without a file."""
    if path is None:
        return None
    try:
        text = Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        problem = error if isinstance(error, OSError) else OSError(0, "is not text")
        raise support.fault(problem, f"{name} {path}", seen=False) from None
    hide(text)
    return text
