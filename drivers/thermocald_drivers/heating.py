"""The heating programme of `relay` and `android_load`, with a hard limit.

A pure decision: (elapsed time, temperature) → heat or not. The limit switches off until the device
is opened again; so does the end of the programme. The options of both drivers:

    channel: temperature          # the key of the epoch's result that is limited
    limit_c: 60                   # at and above it: off until the device is opened again
    unknown_s: 60                 # off after so long without a temperature
    programme:                    # in order; hold_c: null is "do not heat"
      - {seconds: 600, hold_c: null}
      - {seconds: 1500, hold_c: 45}
    hysteresis_k: 0.5
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["HeatingProgramme", "Step"]


@dataclass(frozen=True)
class Step:
    """Hold a temperature (°C; None: do not heat) for a time (s)."""

    seconds: float
    hold_c: float | None


class HeatingProgramme:
    """Decides at each epoch; times are s since the start of the programme."""

    def __init__(
        self,
        *,
        programme: Sequence[Mapping[str, Any]],
        limit_c: float,
        channel: str = "temperature",
        unknown_s: float = 60.0,
        hysteresis_k: float = 0.5,
    ) -> None:
        self.limit_c = support.number("limit_c", limit_c, -40, 150, "°C")
        self.channel = support.text("channel", channel)
        self.unknown_s = support.number("unknown_s", unknown_s, 1, 3600, "s")
        self.hysteresis_k = support.number("hysteresis_k", hysteresis_k, 0, 20, "K")
        self.steps = [self._step(k, entry) for k, entry in enumerate(programme)]
        if not self.steps:
            raise ConfigurationError("programme: write at least one step {seconds: …, hold_c: …}")
        self.reset()

    def _step(self, k: int, entry: Mapping[str, Any]) -> Step:
        if not isinstance(entry, dict) or set(entry) != {"seconds", "hold_c"}:
            raise ConfigurationError(
                f"programme[{k}]: write {{seconds: 600, hold_c: 45}}, not {entry!r}"
            )
        seconds = support.number(f"programme[{k}].seconds", entry["seconds"], 1, 1e6, "s")
        if entry["hold_c"] is None:
            return Step(seconds, None)
        high = self.limit_c - self.hysteresis_k
        return Step(
            seconds, support.number(f"programme[{k}].hold_c", entry["hold_c"], -40, high, "°C")
        )

    def reset(self) -> None:
        """Start again: heating off, not tripped."""
        self.heating = False
        self.tripped = ""
        self._known_at = 0.0

    def step_at(self, elapsed_s: float) -> Step | None:
        """The current step; None after the last one."""
        for step in self.steps:
            elapsed_s -= step.seconds
            if elapsed_s < 0:
                return step
        return None

    def decide(self, elapsed_s: float, temperature_c: float | None) -> bool:
        """Whether to heat now; sets `tripped` (a sentence) once the limit was reached."""
        known = temperature_c is not None and math.isfinite(temperature_c)
        if known and temperature_c is not None and temperature_c >= self.limit_c:
            self.tripped = (
                f"{self.channel} {temperature_c:.2f} °C reached the limit {self.limit_c:g} °C"
            )
        step = self.step_at(elapsed_s)
        self.heating = (
            not self.tripped
            and step is not None
            and self._wanted(step, temperature_c if known else None, elapsed_s)
        )
        return self.heating

    def _wanted(self, step: Step, temperature_c: float | None, elapsed_s: float) -> bool:
        if temperature_c is not None:
            self._known_at = elapsed_s
        if step.hold_c is None:
            return False
        if temperature_c is None:  # a missing value now and then does not stop a warm-up
            return self.heating and elapsed_s - self._known_at < self.unknown_s
        if temperature_c >= step.hold_c + self.hysteresis_k / 2:
            return False
        return self.heating or temperature_c <= step.hold_c - self.hysteresis_k / 2
