"""Thermometers of the DS18B20 family on the kernel's 1-wire bus (w1_therm in sysfs).

    thermometers:
      - name: field
        driver: ds18b20
        sensors: {camera: 28-000000bfe244, air: 28-00000a1b2c3d}   # {channel: ROM id}
        timeout_s: 3                    # per sensor; one conversion takes 0.75 s
        attempts: 2                     # a rejected reading is repeated once
        sysfs: /sys

The driver rejects a wrong CRC (recomputed from the printed bytes), all zeros (a shorted or
unplugged line: the CRC of zeros is zero), a `t=` that does not follow from its bytes, values
outside −55 … 125 °C (127.94 °C is a failed conversion), the fault flag of a MAX31850's
thermocouple, and the power-on value, which the chip holds before its first conversion. This is
85 °C in every family and at every resolution (DS18S20: 0x00AA), and 25 °C in the counterfeits of
family D, whose last scratchpad byte is not 0x10. It is accepted only if a recent reading is within
5 K: a probe may pass through this temperature, too.

All sensors are read at once, each in its own thread. The kernel (as of 6.1) still holds the bus
during a conversion, so n sensors on one bus take n · 0.8 s; the reading's time is the middle.
Source: Maxim DS18B20 data sheet (19-7487), DS18S20 (19-5474), MAX31850 (19-6171), Linux
w1_therm.c, C. Petrich's survey of counterfeit DS18B20.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from thermocald.errors import BadReading, ConfigurationError, DeviceGone
from thermocald.hal import DriverOptions, Found
from thermocald_drivers import support

if TYPE_CHECKING:
    from concurrent.futures import Future

    from thermocald.hal import Reading

POWER_ON = "the power-on value (the sensor lost its supply or has not converted yet)"
_FILE = re.compile(
    r"(?P<pad>[0-9a-f]{2}(?: [0-9a-f]{2}){8}) : crc=[0-9a-f]{2} (?P<verdict>YES|NO)\s*\n"
    r"[0-9a-f ]*t=(?P<milli>-?[0-9]{1,7})"
)
FAMILIES = {"10": "DS18S20", "22": "DS1822", "28": "DS18B20", "3b": "DS1825", "42": "DS28EA00"}


def crc8(data: bytes) -> int:
    """Return the 1-wire CRC: x⁸ + x⁵ + x⁴ + 1, low bit first (Maxim application note 27)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8C if crc & 1 else crc >> 1
    return crc


def decode(content: str, where: str, family: str = "28") -> tuple[float, str]:
    """Return (°C, POWER_ON or "") of a `w1_slave` file; raises BadReading if it fails a check."""
    if not content:
        raise BadReading(f"{where}: the file is empty: no answer, or one whose CRC failed")
    match = _FILE.fullmatch(content)
    if match is None:
        raise BadReading(f"{where}: {content!r} is not a w1_slave file")
    pad, milli = bytes.fromhex(match["pad"]), int(match["milli"])
    if match["verdict"] != "YES" or crc8(pad[:8]) != pad[8]:
        raise BadReading(f"{where}: CRC error in {match['pad']!r}; check the wiring and pull-up")
    if not any(pad):
        raise BadReading(f"{where}: all zeros; the data line is shorted or the sensor unplugged")
    if family == "3b" and pad[4] & 0x80 and pad[0] & 1:
        raise BadReading(f"{where}: the MAX31850 reports a fault; check the thermocouple")
    if family == "10" and pad[7] == 0:
        raise BadReading(f"{where}: COUNT_PER_C is 0 in {match['pad']!r}; no DS18S20 sends that")
    computed = _kernel_millidegrees(pad, family)
    # kernels before 5.10 ignore the additional bits of GX20MH01 and MAX31850
    if milli not in (computed, int(int.from_bytes(pad[:2], "little", signed=True) * 1000 / 16)):
        raise BadReading(f"{where}: t={milli} does not follow from the bytes {match['pad']!r}")
    raw = int.from_bytes(pad[:2], "little") & (~3 if family == "3b" and pad[4] & 0x80 else ~0)
    counterfeit = family == "28" and (pad[5] != 0xFF or pad[7] != 0x10)
    idle = raw == (0x00AA if family == "10" else 0x0550) or (counterfeit and raw == 0x0190)
    return computed / 1000.0, POWER_ON if idle else ""


def _kernel_millidegrees(pad: bytes, family: str) -> int:
    """Return what w1_therm.c computes from the scratchpad, in 1/1000 °C, rounded towards zero."""
    raw = int.from_bytes(pad[:2], "little", signed=True)
    if family == "10":
        return (raw >> 1) * 1000 - 250 + int(1000 * (pad[7] - pad[6]) / pad[7])
    if family == "3b" and pad[4] & 0x80:  # MAX31850: fault and reserved bit are masked
        return int((raw & ~3) * 1000 / 16)
    if family in ("22", "28", "42") and pad[4] & 0x80:  # GX20MH01: two more bits
        bits = (raw << 2 | pad[4] & 3) & 0xFFFF
        return int((bits - (bits >> 15 << 16)) * 1000 / 64)
    return int(raw * 1000 / 16)


class Ds18b20Thermometer(support.CheckedThermometer):
    """One or several 1-wire thermometers, read at the same time."""

    class Options(DriverOptions):
        """The options of `ds18b20`; sensors: {channel: ROM id}."""

        sensors: Annotated[dict[str, support.Text], Field(min_length=1)]
        timeout_s: Annotated[float, Field(ge=0.01, le=60.0)] = 3.0
        attempts: Annotated[int, Field(ge=1, le=10)] = 2
        sysfs: support.Text = "/sys"

    range_c = (-55.0, 125.0)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.sensors: dict[str, str] = self.options.sensors
        ids = list(self.sensors.values())
        if twice := {rom for rom in ids if ids.count(rom) > 1}:
            raise ConfigurationError(f"sensors: {min(twice)} is given twice")
        self.where = f"1-wire {', '.join(ids)}"
        self.timeout_s *= len(ids)
        self.root = Path(self.options.sysfs) / "bus/w1/devices"
        self._pending: dict[str, Future[float]] = {}

    def named_channels(self) -> list[str]:
        return list(self.sensors)

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:
        """List the sensors on the bus as one stanza, for `thermocald devices`."""
        ids = sorted(
            path.name
            for family in FAMILIES
            for path in (Path(sysfs) / "bus/w1/devices").glob(f"{family}-*")
        )
        if not ids:
            return []
        channels = ["temperature"] if len(ids) == 1 else [f"probe{k + 1}" for k in range(len(ids))]
        about = ", ".join(f"{FAMILIES[i[:2]]} {i}" for i in ids)
        return [Found({"sensors": dict(zip(channels, ids, strict=True))}, about)]

    def open(self) -> None:
        # the others are read: one broken cable does not cost their readings after a restart
        if not any((self.root / rom).is_dir() for rom in self.sensors.values()):
            there = ", ".join(sorted(p.name for p in self.root.glob("??-*"))) or "no sensor"
            raise support.absent(
                f"{self.where}: not on the bus, there is {there}; check "
                "dtoverlay=w1-gpio and the wiring",
                seen=self.seen,
            )
        self.handle = self.seen = True

    def read(self) -> Reading:
        self.opened()
        deadline = self.clock.monotonic() + self.timeout_s
        for channel in self.sensors:
            late = self._pending.get(channel)
            if late is None or late.done():  # a sensor that still hangs is not read twice
                # a result that came after its epoch is discarded here
                self._pending[channel] = support.in_thread(
                    partial(self._read_one, channel), f"w1-{channel}"
                )
        return self.reading(
            {
                channel: (f"1-wire {rom}", partial(self._await, channel, deadline))
                for channel, rom in self.sensors.items()
            }
        )

    def _await(self, channel: str, deadline: float) -> float:
        """Wait for a sensor's thread and return its result."""
        late = f"1-wire {self.sensors[channel]}: no answer in {self.timeout_s:g} s"
        left_s = deadline - self.clock.monotonic()
        return float(support.result_in_time(self._pending[channel], left_s, late))

    def _read_one(self, channel: str) -> float:
        rom = self.sensors[channel]
        for _ in range(self.options.attempts):
            try:
                content = support.read_line(self.root / rom / "w1_slave")
                where = f"1-wire {rom}"
                return self.judge(channel, where, *decode(content, where, rom[:2]))
            except OSError as error:  # also a BadReading
                problem = support.fault(error, f"1-wire {rom}", seen=True)
                if isinstance(problem, DeviceGone):
                    raise DeviceGone(f"1-wire {rom}: is not on the bus") from error
        raise problem
