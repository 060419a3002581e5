"""Warms a phone up by processor load, under a programme and with a temperature limit.

    outputs:
      - name: warm-pixel
        driver: android_load
        serial: 0A1B2C3D4E
        limit_c: 42                   # of the battery: at and above it off, until reopened
        programme: [{seconds: 600, hold_c: null}, {seconds: 1800, hold_c: 38}]
        processes: 4
        lease_s: 30
        unknown_s: 60                 # off after so long without a temperature
        hysteresis_k: 0.5
        timeout_s: 5
        host: 127.0.0.1               # of the adb server
        port: 5037
        start_server: true            # if none runs

For experiments with a cold and a warm phone. The load ends by itself `lease_s` after it was last
renewed, so that a phone whose cable falls out cools down. The battery's temperature is read by this
driver itself. See `heating` for the programme.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from thermocald.errors import BadReading, DeviceError
from thermocald.hal import Output
from thermocald_drivers.android_phone import ADB_CLASSES, AdbPhone, PhoneOptions
from thermocald_drivers.android_thermometer import battery
from thermocald_drivers.heating import HeatingOptions, HeatingProgramme

if TYPE_CHECKING:
    from collections.abc import Mapping

MARK = "thermocald_load"


class LoadOptions(HeatingOptions, PhoneOptions):
    """As above; a battery above 50 °C is in danger."""

    limit_c: Annotated[float, Field(ge=0.0, le=50.0)]
    processes: Annotated[int, Field(ge=1, le=16)] = 4
    lease_s: Annotated[float, Field(ge=2.0, le=120.0)] = 30.0
    timeout_s: Annotated[float, Field(ge=0.1, le=60.0)] = 5.0


class AndroidLoadOutput(Output):
    """Busy loops on the phone while the programme asks for heat."""

    device_classes = ADB_CLASSES
    heats = True
    Options = LoadOptions

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.phone = AdbPhone(self.options)
        self.programme = HeatingProgramme(self.options, "battery")

    def open(self) -> None:
        self.phone.connect()
        self.programme.reset()
        self._started = self.clock.monotonic()
        self._renewed = float("-inf")
        self._stop()  # what a crashed program left behind

    def close(self) -> None:
        with contextlib.suppress(DeviceError):  # out of reach: the lease ends the load
            self._stop()
        self.phone.disconnect()

    def emit(self, result: Mapping[str, Any]) -> None:  # noqa: ARG002 - it reads the phone
        found = battery(self.phone.shell("dumpsys battery"))
        celsius = None if found is None else found[0] * found[1]
        was_tripped = self.programme.tripped
        now = self.clock.monotonic()
        if not self.programme.decide(now - self._started, celsius):
            self._stop()
            if self.programme.tripped and not was_tripped:
                raise BadReading(f"{self.phone.where}: off for good, {self.programme.tripped}")
            return
        if now - self._renewed >= self.options.lease_s / 2.0:
            self._stop()
            self._start()
            self._renewed = now

    def _start(self) -> None:
        loop = f"{MARK}=1; while :; do :; done"
        for _ in range(self.options.processes):
            self.phone.shell(
                f"timeout {self.options.lease_s:g} sh -c '{loop}' >/dev/null 2>&1 </dev/null &"
            )

    def _stop(self) -> None:
        # [t]: the pattern must not match the shell that carries it
        self.phone.shell(f"pkill -f '[{MARK[0]}]{MARK[1:]}'")
        self._renewed = float("-inf")
