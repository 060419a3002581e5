"""The heating programme of `relay` and `android_load`, with a hard limit.

A pure decision: (elapsed time, temperature) → heat or not. The limit switches off until the device
is opened again; so does the end of the programme. The options of both drivers:

    limit_c: 60                   # at and above it: off until the device is opened again
    unknown_s: 60                 # off after so long without a temperature
    programme:                    # in order; hold_c: null is "do not heat"
      - {seconds: 600, hold_c: null}
      - {seconds: 1500, hold_c: 45}
    hysteresis_k: 0.5
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from thermocald.errors import ConfigurationError
from thermocald.hal import DriverOptions, HeatingStep


class HeatingOptions(DriverOptions):
    """What every output that heats has."""

    limit_c: Annotated[float, Field(ge=-40.0, le=150.0)]
    programme: Annotated[list[HeatingStep], Field(min_length=1)]
    unknown_s: Annotated[float, Field(ge=1.0, le=3600.0)] = 60.0
    hysteresis_k: Annotated[float, Field(ge=0.0, le=20.0)] = 0.5

    @model_validator(mode="after")
    def _below_the_limit(self) -> Self:
        high = self.limit_c - self.hysteresis_k
        for k, step in enumerate(self.programme):
            if step.hold_c is not None and step.hold_c > high:
                raise ConfigurationError(
                    f"programme[{k}].hold_c: {step.hold_c:g} °C is not below the limit by "
                    f"hysteresis_k ({high:g} °C)"
                )
        return self


class HeatingProgramme:
    """Decides at each epoch; times are s since the start of the programme.

    channel: what is limited, for messages.
    """

    def __init__(self, options: HeatingOptions, channel: str) -> None:
        self.options, self.channel = options, channel
        self.reset()

    def reset(self) -> None:
        """Start again: heating off, not tripped."""
        self.heating = False
        self.tripped = ""
        self._known_at = 0.0

    def decide(self, elapsed_s: float, temperature_c: float | None) -> bool:
        """Return whether to heat now; sets `tripped` (a sentence) once the limit was reached."""
        limit = self.options.limit_c
        if temperature_c is not None and not math.isfinite(temperature_c):
            temperature_c = None
        if temperature_c is not None and temperature_c >= limit:
            self.tripped = f"{self.channel} {temperature_c:.2f} °C reached the limit {limit:g} °C"
        steps = self.options.programme
        ends = itertools.accumulate(step.seconds for step in steps)
        hold_c = next(
            (s.hold_c for s, end in zip(steps, ends, strict=True) if elapsed_s < end), None
        )
        if temperature_c is not None:
            self._known_at = elapsed_s
        half = self.options.hysteresis_k / 2
        if self.tripped or hold_c is None:
            self.heating = False
        elif temperature_c is None:  # a missing value now and then does not stop a warm-up
            self.heating = self.heating and elapsed_s - self._known_at < self.options.unknown_s
        elif temperature_c >= hold_c + half or temperature_c <= hold_c - half:
            self.heating = temperature_c < hold_c
        return self.heating
