"""Alerts: thresholds on the results, reported once out and once in again, and delivered.

A condition that is out is in again only when the value is clearly back (hysteresis): a value at
its threshold does not ring all night. A result without the value changes nothing.

Each alert driver is an output of its own, with its own thread and bounded queue in the daemon, so
that one that cannot be reached delays neither a tick nor the others. What could not be delivered
is kept, in order, over closing and opening; the newest `MOST_WAITING` of them.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from thermocald.errors import ConfigurationError, DeviceGone
from thermocald.hal import DriverOptions, Output
from thermocald.names import WITH_VALUES
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

log = logging.getLogger(__name__)

MOST_WAITING = 100
_BACK = 0.8
"""A drift is in again below this part of its threshold."""
_DISK_BACK = 1.1


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
        return {"format": "thermocald-alert/1", **dataclasses.asdict(self)}


class Condition(DriverOptions):
    """A threshold. limits: low and high, NaN for none, and how far inside a value is in again."""

    per_device: ClassVar[bool] = True
    step: ClassVar[int] = 0

    @property
    def unit(self) -> str:
        """With a blank before it, or nothing."""
        return ""

    @property
    def name(self) -> str:
        """What it is called in alerts; given once in `when`."""
        raise NotImplementedError

    @property
    def limits(self) -> tuple[float, float, float]:
        """(low, high, back)."""
        raise NotImplementedError

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:
        """What is compared; NaN where the result does not have it.

        failed: epochs in a row; lost: epochs that were taken and not kept since the last result.
        """
        raise NotImplementedError

    def words(self, value: float) -> str:
        """The value in words."""
        raise NotImplementedError

    def beyond(self, value: float) -> float:
        """The bound that a value has passed, NaN if none."""
        low, high, _ = self.limits
        return low if value < low else high if value > high else math.nan

    def inside(self, value: float) -> bool:
        """Whether the value is clearly within the bounds again."""
        low, high, back = self.limits
        low_kept = math.isnan(low) or value >= low + back
        return low_kept and (math.isnan(high) or value <= high - back)

    def text(self, value: float, bound: float) -> str:
        """The value and its bound in words."""
        if math.isnan(bound):
            return f"{self.words(value)}: within its limits again"
        return f"{self.words(value)} (limit {bound + self.step:g}{self.unit})"


Amount = Annotated[float, Field(ge=1e-6, le=1e6)]


class Drift(Condition):
    """A parameter's drift, in px or in its standard deviations, from the start or from a value."""

    drift: Literal["c", "x0", "y0"]
    px: Amount | None = None
    sds: Amount | None = None
    from_mm: Annotated[float, Field(ge=-1e4, le=1e4)] | None = None

    @property
    def unit(self) -> str:
        return " sds" if self.px is None else " px"

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if (self.px is None) == (self.sds is None):
            raise ConfigurationError(f"drift of {self.drift} needs either px or sds")
        return self

    @property
    def name(self) -> str:
        return f"drift_{self.drift}_{self.unit.strip()}"

    @property
    def limits(self) -> tuple[float, float, float]:
        high = float(self.px or self.sds or math.nan)
        return math.nan, high, (1 - _BACK) * high

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:  # noqa: ARG002
        drift = _number(result.get(f"drift_{self.drift}_px"))
        sd = _number(result.get(f"sd_drift_{self.drift}_px"))
        if self.from_mm is not None:
            pitch = _number(result.get("pixel_pitch"))
            pitch = pitch if pitch > 0 else math.nan
            drift = (_number(result.get(self.drift)) - self.from_mm) / pitch
            sd = _number(result.get(f"sd_{self.drift}")) / pitch
        if self.px is not None:
            return abs(drift)
        return abs(drift) / sd if sd > 0 else math.nan

    def words(self, value: float) -> str:
        start = "the start of the series" if self.from_mm is None else f"{self.from_mm:g} mm"
        return f"{self.drift} is {value:.3g}{self.unit} from {start}"


class Temperature(Condition):
    """A channel's temperature."""

    temperature: support.Text
    above_c: support.Celsius | None = None
    below_c: support.Celsius | None = None
    hysteresis_k: Annotated[float, Field(ge=0.0, le=100.0)] = 1.0

    @model_validator(mode="after")
    def _something_between(self) -> Self:
        low, high, back = self.limits
        if math.isnan(low) and math.isnan(high):
            raise ConfigurationError(f"temperature {self.temperature} needs above_c or below_c")
        if high - low <= 2 * back:
            raise ConfigurationError(
                f"temperature {self.temperature}: nothing is left between the limits"
            )
        return self

    @property
    def name(self) -> str:
        return self.temperature

    @property
    def unit(self) -> str:
        return " °C"

    @property
    def limits(self) -> tuple[float, float, float]:
        low = math.nan if self.below_c is None else self.below_c
        return low, math.nan if self.above_c is None else self.above_c, self.hysteresis_k

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:  # noqa: ARG002
        return _number(result.get(self.temperature))

    def words(self, value: float) -> str:
        return f"{self.temperature} is {value:.1f} °C"


Count = Annotated[int, Field(ge=1, le=1_000_000)]


class _Counted(Condition):
    """Epochs: out from the count on, in again at none."""

    step: ClassVar[int] = 1
    count: ClassVar[str]
    said: ClassVar[str]

    @property
    def name(self) -> str:
        return self.count

    @property
    def limits(self) -> tuple[float, float, float]:
        most = getattr(self, self.count) - 1
        return math.nan, most, most

    def words(self, value: float) -> str:
        return f"{value:.0f} epochs {self.said}"


class NoResult(_Counted):
    """Epochs in a row without a result."""

    count: ClassVar[str] = "no_result"
    said: ClassVar[str] = "in a row without a result"
    no_result: Count

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:  # noqa: ARG002
        return float(failed)


class Lost(_Counted):
    """Epochs that were taken and not kept since the last result."""

    count: ClassVar[str] = "lost"
    said: ClassVar[str] = "were taken and not kept"
    per_device: ClassVar[bool] = False
    lost: Count

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:  # noqa: ARG002
        return float(lost)


class FreeDisk(Condition):
    """The space that is left at a path, GB."""

    per_device: ClassVar[bool] = False
    free_disk_gb: Amount
    path: support.Text = "."

    @property
    def name(self) -> str:
        return "free_disk"

    @property
    def unit(self) -> str:
        return " GB"

    @property
    def limits(self) -> tuple[float, float, float]:
        return self.free_disk_gb, math.nan, (_DISK_BACK - 1) * self.free_disk_gb

    def value(self, result: Mapping[str, Any], failed: int, lost: int) -> float:  # noqa: ARG002
        try:
            disk = os.statvfs(self.path)
        except OSError:
            return math.nan
        return disk.f_bavail * disk.f_frsize / 1e9

    def words(self, value: float) -> str:
        return f"{value:.2f} GB are free at {self.path}"


_KINDS: dict[str, type[Condition]] = {
    "drift": Drift, "temperature": Temperature, "no_result": NoResult, "lost": Lost,
    "free_disk_gb": FreeDisk,
}  # fmt: skip


def condition_of(stanza: Mapping[str, Any]) -> Condition:
    """A condition from an entry of `when`; ConfigurationError names what is wrong in it."""
    kind = next((kind for key, kind in _KINDS.items() if key in stanza), None)
    if kind is None:
        raise ConfigurationError(f"when: {dict(stanza)} has none of {', '.join(_KINDS)}")
    return kind.read(stanza, "when")


class Watch:
    """The state of all conditions for every device whose results come."""

    def __init__(self, conditions: Sequence[Condition]) -> None:
        self.conditions = conditions
        self._out: set[tuple[str, str]] = set()
        self._failed: dict[str, int] = {}
        self._seen: dict[str, tuple[Any, Any]] = {}
        self._lost = 0

    def changes(self, result: Mapping[str, Any], device: str) -> list[Alert]:
        """What this result changes; the same result again changes nothing."""
        moment = (result.get("series"), result.get("epoch"))
        if moment[1] is not None and self._seen.get(device) == moment:
            return []
        self._seen[device] = moment
        failed = 0 if result.get("status") in WITH_VALUES else self._failed.get(device, 0) + 1
        self._failed[device] = failed
        before, self._lost = self._lost, int(result.get("lost", self._lost))
        lost = max(0, self._lost - before)
        changes = []
        for condition in self.conditions:
            key = (device if condition.per_device else "", condition.name)
            value = condition.value(result, failed, lost)
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
    low, high, _ = condition.limits
    limit = high if math.isnan(bound) and math.isnan(low) else bound
    utc, epoch = _number(result.get("frame_time")), result.get("epoch")
    return Alert(
        device,
        condition.name,
        state,
        f"{device}: {condition.text(value, bound)}",
        value,
        low if math.isnan(limit) else limit,
        str(result.get("series", "")),
        int(epoch) if isinstance(epoch, int) else None,
        None if math.isnan(utc) else utc,
    )


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value)


class AlertOptions(DriverOptions):
    """What all alert drivers have."""

    when: Annotated[list[dict[str, Any]], Field(min_length=1)]
    device: support.Text = "thermocald"
    timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 5.0


class AlertOutput(Output):
    """An output that delivers alerts; a driver says how in `deliver`, and where in `where`."""

    where: str

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.timeout_s = self.options.timeout_s
        conditions = [condition_of(stanza) for stanza in self.options.when]
        names = [condition.name for condition in conditions]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ConfigurationError(f"when: {min(twice)} is given twice")
        self._watch = Watch(conditions)
        self._waiting: deque[Alert] = deque(maxlen=MOST_WAITING)
        self._opened = False

    def open(self) -> None:
        self.reach()
        self._opened = True

    def close(self) -> None:
        self._opened = False

    def emit(self, result: Mapping[str, Any]) -> None:
        if not self._opened:
            raise DeviceGone(f"{self.where}: not open")
        for alert in self._watch.changes(result, str(result.get("device", self.options.device))):
            log.warning("%s", alert.text, extra={"event": "alert"})
            self._waiting.append(alert)
        while self._waiting:
            self.deliver(self._waiting[0])
            self._waiting.popleft()

    def reach(self) -> None:
        """Look whether alerts can be delivered; a DeviceError if not."""
        raise NotImplementedError

    def deliver(self, alert: Alert) -> None:
        """Deliver one alert, within `timeout_s`; a DeviceError if that failed."""
        raise NotImplementedError


def secret(name: str, path: str | None) -> str | None:
    """The text of a file that holds a password or a token, None without a file."""
    if path is None:
        return None
    try:
        return Path(path).read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        problem = error if isinstance(error, OSError) else OSError(0, "is not text")
        raise support.fault(problem, f"{name} {path}", seen=False) from None
