"""The heating programme of `relay` and `android_load`, with a hard limit; `android_load` itself.

The limit switches off until the device
is opened again; so does the end of the programme. The options of both drivers:

    limit_c: 60                   # at and above it: off until the device is opened again
    unknown_s: 60                 # off after so long without a temperature
    programme:                    # in order; hold_c: null is "do not heat"
      - {seconds: 600, hold_c: null}
      - {seconds: 1500, hold_c: 45}
    hysteresis_k: 0.5

`android_load` warms a phone up by processor load, for experiments with a cold and a warm phone:

    outputs:
      - name: warm-pixel
        driver: android_load
        serial: 0A1B2C3D4E
        limit_c: 42                   # of the battery, which this driver reads itself
        programme: [{seconds: 600, hold_c: null}, {seconds: 1800, hold_c: 38}]
        processes: 4
        lease_s: 30
        timeout_s: 5
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # if none runs

The load ends by itself `lease_s` after it was last renewed, so that a phone whose cable falls out
cools down.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field, model_validator

from thermocald.errors import BadReading, ConfigurationError, DeviceError
from thermocald.hal import DriverOptions, HeatingStep, Output
from thermocald_drivers.android_phone import AdbPhone, PhoneOptions, battery

if TYPE_CHECKING:
    from collections.abc import Mapping


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


class HeatingOutput(Output):
    """Heats by its programme: a driver says in `measure` how warm it is, and obeys in `switch`."""

    heats = True
    channel: str
    """What is limited, for messages."""

    def begin(self) -> None:
        """Start the programme again: heating off, limit not reached."""
        self.heating = False
        self.tripped = ""
        self._known_at = 0.0
        self._started = self.clock.monotonic()

    def emit(self, result: Mapping[str, Any]) -> None:
        """Heat or not; BadReading once, when the limit was reached."""
        temperature_c, was_tripped = self.measure(result), self.tripped
        self.switch(self._decide(self.clock.monotonic() - self._started, temperature_c))
        if self.tripped and not was_tripped:
            raise BadReading(f"{self.where}: off for good, {self.tripped}")

    def measure(self, result: Mapping[str, Any]) -> float | None:
        """Return the temperature °C that an epoch gives; None if it is not known."""
        raise NotImplementedError

    def switch(self, heat: bool) -> None:
        """Heat, or do not."""
        raise NotImplementedError

    def _decide(self, elapsed_s: float, temperature_c: float | None) -> bool:
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


MARK = "thermocald_load"


class LoadOptions(HeatingOptions, PhoneOptions):
    """As above; a battery above 50 °C is in danger."""

    limit_c: Annotated[float, Field(ge=0.0, le=50.0)]
    processes: Annotated[int, Field(ge=1, le=16)] = 4
    lease_s: Annotated[float, Field(ge=2.0, le=120.0)] = 30.0
    timeout_s: Annotated[float, Field(ge=0.1, le=60.0)] = 5.0


class AndroidLoadOutput(AdbPhone, HeatingOutput):
    """Busy loops on the phone while the programme asks for heat."""

    Options = LoadOptions
    channel = "battery"
    _renewed = float("-inf")

    def open(self) -> None:
        super().open()
        self.begin()
        self.switch(False)  # what a crashed program left behind

    def close(self) -> None:
        with contextlib.suppress(DeviceError):  # out of reach: the lease ends the load
            self.switch(False)
        super().close()

    def measure(self, result: Mapping[str, Any]) -> float | None:  # noqa: ARG002 - it asks the phone
        found = battery(self.shell("dumpsys battery"))
        return None if found is None else found[0] * found[1]

    def switch(self, heat: bool) -> None:
        """End the load, or renew it where half of its lease is over."""
        now = self.clock.monotonic()
        if heat and now - self._renewed < self.options.lease_s / 2.0:
            return
        self._renewed = float("-inf")
        # [t]: the pattern must not match the shell that carries it
        self.shell(f"pkill -f '[{MARK[0]}]{MARK[1:]}'")
        if not heat:
            return
        load = f"{MARK}=1; while :; do :; done"
        for _ in range(self.options.processes):
            self.shell(
                f"timeout {self.options.lease_s:g} sh -c '{load}' >/dev/null 2>&1 </dev/null &"
            )
        self._renewed = now
