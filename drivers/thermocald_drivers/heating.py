"""The heating programme of `relay` and `android_load`, and the driver `android_load`.

At the limit, and at the end of the programme, heating stops until the configuration is reloaded. A
device that goes away and comes back continues its programme. Both drivers have these options:

    limit_c: 60                   # at or above it: off until the configuration is reloaded
    unknown_s: 60                 # without a temperature for this long: off
    programme:                    # steps in order; hold_c: null is "do not heat"
      - {seconds: 600, hold_c: null}
      - {seconds: 1500, hold_c: 45}
    hysteresis_k: 0.5

`android_load` warms up a phone by processor load, for experiments with a cold and a warm phone:

    outputs:
      - name: warm-pixel
        driver: android_load
        serial: 0A1B2C3D4E
        limit_c: 42                   # of the battery, which the driver itself reads
        programme: [{seconds: 600, hold_c: null}, {seconds: 1800, hold_c: 38}]
        processes: 4
        lease_s: 30
        timeout_s: 5
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # start a server if none runs

The load stops `lease_s` after its last renewal, so that a phone cools down when its cable is pulled
out.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field, model_validator

from thermocald.errors import ConfigurationError, DeviceError, PermanentDeviceError
from thermocald.hal import DriverOptions, HeatingStep, Output
from thermocald_drivers.android_phone import AdbPhone, PhoneOptions, battery

if TYPE_CHECKING:
    from collections.abc import Mapping


_MANY = 20  # results without a temperature, which are reported


class HeatingOptions(DriverOptions):
    """The options of every output that heats."""

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
    """An output that heats by its programme; a driver implements `measure` and `switch`."""

    heats = True
    channel: str
    """The name of the limited temperature, for messages."""

    heating = False
    tripped = ""
    _known_at = 0.0
    _unknown = 0  # results in a row without a temperature
    _started: float | None = None
    _reported = False

    def warnings(self) -> list[str]:
        if self._unknown < _MANY:
            return []
        return [f"{self.channel} is unknown in the last {self._unknown} results; it does not heat"]

    def begin(self) -> None:
        """Start the programme at the first opening; continue it, with the heating off, later."""
        self.heating = False
        if self._started is None:
            self._started = self.clock.monotonic()

    def emit(self, result: Mapping[str, Any]) -> None:
        """Switch the heating by the programme; PermanentDeviceError once at the limit."""
        self.opened()
        assert self._started is not None
        temperature_c = self.measure(result)
        self.switch(self._decide(self.clock.monotonic() - self._started, temperature_c))
        if self.tripped and not self._reported:
            self._reported = True
            raise PermanentDeviceError(
                f"{self.where}: heating is off, {self.tripped}; reload the configuration to heat "
                "again"
            )

    def measure(self, result: Mapping[str, Any]) -> float:
        """Return the temperature °C at an epoch; NaN if it is unknown."""
        raise NotImplementedError

    def switch(self, heat: bool) -> None:
        """Switch the heating on or off."""
        raise NotImplementedError

    def _decide(self, elapsed_s: float, temperature_c: float) -> bool:
        """Return whether to heat now; set `tripped` (a sentence) when the limit is reached."""
        limit = self.options.limit_c
        if temperature_c >= limit:
            self.tripped = f"{self.channel} {temperature_c:.2f} °C reached the limit {limit:g} °C"
        steps = self.options.programme
        ends = itertools.accumulate(step.seconds for step in steps)
        hold_c = next(
            (s.hold_c for s, end in zip(steps, ends, strict=True) if elapsed_s < end), None
        )
        if known := math.isfinite(temperature_c):
            self._known_at = elapsed_s
        self._unknown = 0 if known else self._unknown + 1
        half = self.options.hysteresis_k / 2
        if self.tripped or hold_c is None:
            self.heating = False
        elif not known:  # an occasional missing value does not stop a warm-up
            self.heating = self.heating and elapsed_s - self._known_at < self.options.unknown_s
        elif temperature_c >= hold_c + half or temperature_c <= hold_c - half:
            self.heating = temperature_c < hold_c
        return self.heating


MARK = "thermocald_load"


class AndroidLoadOutput(AdbPhone, HeatingOutput):
    """Busy loops on a phone while its programme calls for heat."""

    class Options(HeatingOptions, PhoneOptions):
        """The options of `android_load`; a battery above 50 °C is in danger."""

        limit_c: Annotated[float, Field(ge=0.0, le=50.0)]
        processes: Annotated[int, Field(ge=1, le=16)] = 4
        lease_s: Annotated[float, Field(ge=2.0, le=120.0)] = 30.0
        timeout_s: Annotated[float, Field(ge=0.1, le=60.0)] = 5.0

    channel = "battery"
    _renewed = float("-inf")

    def open(self) -> None:
        super().open()
        self.begin()
        self.switch(False)  # stops the load of a program that crashed

    def close(self) -> None:
        with contextlib.suppress(DeviceError):  # out of reach: the load stops with its lease
            self.switch(False)
        super().close()

    def measure(self, result: Mapping[str, Any]) -> float:  # noqa: ARG002 - asks the phone
        number, scale = battery(self.shell("dumpsys battery")) or (math.nan, 1.0)
        return number * scale

    def switch(self, heat: bool) -> None:
        """Stop the load, or renew it after half of its lease."""
        now = self.clock.monotonic()
        if heat and now - self._renewed < self.options.lease_s / 2.0:
            return
        self._renewed = float("-inf")
        # [t]: the pattern must not match the shell that runs this command
        self.shell(f"pkill -f '[{MARK[0]}]{MARK[1:]}'")
        if not heat:
            return
        load = f"{MARK}=1; while :; do :; done"
        for _ in range(self.options.processes):
            self.shell(
                f"timeout {self.options.lease_s:g} sh -c '{load}' >/dev/null 2>&1 </dev/null &"
            )
        self._renewed = now
