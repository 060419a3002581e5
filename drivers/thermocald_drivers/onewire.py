"""DS18B20 and its family on the kernel's 1-wire bus (w1_therm in sysfs).

    thermometers:
      - name: field
        driver: ds18b20
        sensors: {camera: 28-000000bfe244, air: 28-00000a1b2c3d}   # {channel: ROM id}
        timeout_s: 3                    # for each sensor; one conversion takes 0.75 s
        attempts: 2                     # a reading that is not believed is made once more
        sysfs: /sys

What this driver does not believe: a CRC that fails (computed here too, over the printed bytes), all
zeros (a shorted or unplugged line: the CRC of zeros is zero), a `t=` that does not fit its bytes,
values outside −55 … 125 °C, and 85 °C with the power-on scratchpad unless a neighbouring reading
makes it likely: that value is what the chip holds before its first conversion, but a probe also
passes through it on a ramp. Every sensor is asked at once, in its own thread; the kernel (seen with
6.1) nevertheless keeps the bus to itself during a conversion, so that n sensors of one bus take
n · 0.8 s, and the reading's time is the middle of them all.
Source: Maxim DS18B20 data sheet (19-7487), Linux w1_therm.c.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, ConfigurationError, DeviceError, DeviceGone, DeviceTimeout
from thermocald.hal import Thermometer
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock, Reading

__all__ = ["Ds18b20Thermometer", "crc8", "decode"]

POWER_ON = bytes.fromhex("50054b467fff0c10")
"""The scratchpad after power-on but for TH/TL, which are kept in EEPROM (bytes 2 and 3)."""
FAMILIES = {"10": "DS18S20", "22": "DS1822", "28": "DS18B20", "3b": "DS1825", "42": "DS28EA00"}
NEIGHBOUR_AGE_S = 60.0
NEIGHBOUR_STEP_K = 5.0


def crc8(data: bytes) -> int:
    """The 1-wire CRC, x⁸ + x⁵ + x⁴ + 1, least significant bit first (application note 27)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8C if crc & 1 else crc >> 1
    return crc


def decode(content: str, where: str, family: str = "28") -> tuple[float, bytes]:
    """(°C, scratchpad) of a `w1_slave` file; BadReading says what does not fit."""
    lines = content.split("\n")
    if not content.strip():
        raise BadReading(f"{where}: empty: no answer, or one whose CRC the kernel refused")
    try:
        left, right = lines[0].split(" : crc=", 1)
        pad = bytes.fromhex(left)
        milli = int(lines[1].rsplit("t=", 1)[1])
    except (ValueError, IndexError) as error:
        raise BadReading(f"{where}: {content!r} is no w1_slave content") from error
    if len(pad) != 9 or not right.rstrip().endswith("YES") or crc8(pad[:8]) != pad[8]:
        raise BadReading(f"{where}: CRC error in {left!r}; check the wiring and the pull-up")
    if not any(pad):
        raise BadReading(f"{where}: all zeros; the data line is shorted or the sensor unplugged")
    if milli != _kernel_millikelvin(pad, family):
        raise BadReading(f"{where}: t={milli} does not fit the bytes {left!r}")
    return support.believable(milli / 1000.0, -55.0, 125.0, where), pad


def _kernel_millikelvin(pad: bytes, family: str) -> int:
    """What w1_therm.c computes from the scratchpad, in 1/1000 °C, rounded towards zero."""
    raw = int.from_bytes(pad[:2], "little", signed=True)
    if family != "10":
        return int(raw * 1000 / 16)
    if pad[7] == 0:
        return 0
    return (raw >> 1) * 1000 - 250 + int(1000 * (pad[7] - pad[6]) / pad[7])


class Ds18b20Thermometer(Thermometer):
    """One or several 1-wire thermometers, read at the same time."""

    def __init__(
        self,
        *,
        clock: Clock,
        sensors: Mapping[str, str],
        timeout_s: float = 3.0,
        attempts: int = 2,
        sysfs: str = "/sys",
    ) -> None:
        self.clock = clock
        if not isinstance(sensors, dict) or not sensors:
            raise ConfigurationError(
                "sensors: write {channel: ROM id}, such as {temperature: 28-0123}"
            )
        self.sensors = {str(k): support.text(f"sensors.{k}", v) for k, v in sensors.items()}
        self.timeout_s = support.number("timeout_s", timeout_s, 0.01, 60, "s")
        self.attempts = int(support.number("attempts", attempts, 1, 10, whole=True))
        self.root = Path(support.text("sysfs", sysfs)) / "bus/w1/devices"
        self._seen = False
        self._open = False
        self._pending: dict[str, Future[float]] = {}
        self._neighbour: dict[str, tuple[float, float]] = {}

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[dict[str, Any]]:
        """Configuration stanzas of what is there, for `thermocald devices`."""
        ids = sorted(
            path.name
            for family in FAMILIES
            for path in (Path(sysfs) / "bus/w1/devices").glob(f"{family}-*")
        )
        if not ids:
            return []
        channels = ["temperature"] if len(ids) == 1 else [f"probe{k + 1}" for k in range(len(ids))]
        about = ", ".join(f"{FAMILIES[i[:2]]} {i}" for i in ids)
        return [{"options": {"sensors": dict(zip(channels, ids, strict=True))}, "about": about}]

    def open(self) -> None:
        missing = [rom for rom in self.sensors.values() if not (self.root / rom).is_dir()]
        if missing:
            there = ", ".join(sorted(p.name for p in self.root.glob("??-*"))) or "no sensor"
            raise support.absent(
                f"1-wire {', '.join(missing)}: not on the bus, there is {there}; "
                "is dtoverlay=w1-gpio set and the sensor wired?",
                seen=self._seen,
            )
        self._seen = self._open = True

    def close(self) -> None:
        self._open = False
        self._neighbour.clear()

    def identity(self) -> Mapping[str, str]:
        return {"sensors": ", ".join(self.sensors.values())}

    def read(self) -> Reading:
        if not self._open:
            raise DeviceGone("1-wire: not open")
        begin = self.clock.monotonic()
        patience_s = self.timeout_s * len(self.sensors)
        for channel in self.sensors:
            self._start(channel)
        values: dict[str, float] = {}
        missing: dict[str, DeviceError] = {}
        for channel, rom in self.sensors.items():
            left = max(0.0, patience_s - (self.clock.monotonic() - begin))
            try:
                values[channel] = self._pending[channel].result(timeout=left)
                del self._pending[channel]
            except DeviceError as error:
                missing[channel] = error
                del self._pending[channel]
            except TimeoutError:
                missing[channel] = DeviceTimeout(f"1-wire {rom}: no answer in {patience_s:g} s")
        if not values:
            raise next(iter(missing.values()))
        about = {"missing": {k: str(v) for k, v in missing.items()}} if missing else {}
        return support.middle_reading(self.clock, values, begin, about)

    def _start(self, channel: str) -> None:
        """Begin to read a sensor; one that still hangs from the last time is not asked twice."""
        late = self._pending.get(channel)
        if late is not None and not late.done():
            return
        task: Future[float] = Future()  # an answer that came after its epoch is dropped here
        self._pending[channel] = task

        def work() -> None:
            try:
                task.set_result(self._read_one(channel))
            except DeviceError as error:
                task.set_exception(error)
            except Exception as error:  # noqa: BLE001 - must not die silently in a thread
                task.set_exception(BadReading(f"1-wire {channel}: {error!r}"))

        threading.Thread(target=work, daemon=True, name=f"w1-{channel}").start()

    def _read_one(self, channel: str) -> float:
        rom = self.sensors[channel]
        problem: DeviceError = BadReading(f"1-wire {rom}: not read")
        for _ in range(self.attempts):
            try:
                content = (self.root / rom / "w1_slave").read_text()
                value, pad = decode(content, f"1-wire {rom}", rom[:2])
            except BadReading as error:
                problem = error
                continue
            except OSError as error:
                problem = support.fault(error, f"1-wire {rom}", seen=True)
                if isinstance(problem, DeviceGone):
                    raise DeviceGone(f"1-wire {rom}: vanished from the bus") from error
                continue
            if pad[:2] + pad[4:8] != POWER_ON[:2] + POWER_ON[4:8]:
                self._neighbour[channel] = (self.clock.monotonic(), value)
                return value
            if self._near_85(channel):
                return value
            problem = BadReading(
                f"1-wire {rom}: 85 °C is the power-on value and no reading before it was near; "
                "the sensor lost its supply during the conversion"
            )
        raise problem

    def _near_85(self, channel: str) -> bool:
        """Whether a recent reading that is not the power-on pattern itself lay beside 85 °C."""
        at, value = self._neighbour.get(channel, (float("-inf"), 0.0))
        recent = self.clock.monotonic() - at <= NEIGHBOUR_AGE_S
        return recent and abs(value - 85.0) <= NEIGHBOUR_STEP_K
