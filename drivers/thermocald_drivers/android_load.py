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
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, DeviceError
from thermocald.hal import Output
from thermocald_drivers import android_temperatures, support
from thermocald_drivers.android_phone import AdbPhone
from thermocald_drivers.heating import HeatingProgramme

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock

__all__ = ["AndroidLoadOutput"]

MARK = "thermocald_load"


class AndroidLoadOutput(Output):
    """Busy loops on the phone while the programme asks for heat."""

    device_classes = ("char-usb_device",)
    heats = True

    def __init__(
        self,
        *,
        clock: Clock,
        serial: str,
        limit_c: float,
        programme: Sequence[Mapping[str, Any]],
        processes: int = 4,
        lease_s: float = 30.0,
        timeout_s: float = 5.0,
        host: str = "127.0.0.1",
        port: int = 5037,
        start_server: bool = True,
        unknown_s: float = 60.0,
        hysteresis_k: float = 0.5,
    ) -> None:
        self.clock = clock
        self.phone = AdbPhone(
            support.text("serial", serial),
            support.text("host", host),
            int(support.number("port", port, 1, 65535, whole=True)),
            support.number("timeout_s", timeout_s, 0.1, 60, "s"),
            bool(start_server),
        )
        support.number("limit_c", limit_c, 0, 50, "°C")  # a battery above 50 °C is in danger
        self.processes = int(support.number("processes", processes, 1, 16, whole=True))
        self.lease_s = support.number("lease_s", lease_s, 2, 120, "s")
        self.programme = HeatingProgramme(
            limit_c=limit_c,
            programme=programme,
            channel="battery",
            unknown_s=unknown_s,
            hysteresis_k=hysteresis_k,
        )

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
        battery = android_temperatures.battery(self.phone.shell("dumpsys battery"))
        was_tripped = self.programme.tripped
        now = self.clock.monotonic()
        if not self.programme.decide(now - self._started, battery):
            self._stop()
            if self.programme.tripped and not was_tripped:
                raise BadReading(f"{self.phone.where}: off for good, {self.programme.tripped}")
            return
        if now - self._renewed >= self.lease_s / 2.0:
            self._stop()
            self._start()
            self._renewed = now

    def _start(self) -> None:
        loop = f"{MARK}=1; while :; do :; done"
        for _ in range(self.processes):
            self.phone.shell(
                f"timeout {self.lease_s:g} sh -c '{loop}' >/dev/null 2>&1 </dev/null &"
            )

    def _stop(self) -> None:
        # [t]: the pattern must not match the shell that carries it
        self.phone.shell(f"pkill -f '[{MARK[0]}]{MARK[1:]}'")
        self._renewed = float("-inf")
