"""Bosch BME280 (temperature, humidity, pressure), I2C 0x76 and 0x77.

    thermometers:
      - {name: air, driver: bme280, bus: 1, address: 0x76, channel: air}

The identity register must read 0x60. Each reading is a forced measurement, and its end is awaited;
0x80000, the value of a channel that was not measured, is refused. The factory's calibration is read
at each open. Humidity and pressure go into the metadata. The chip warms itself: what it measures is
the temperature of its board. Source: data sheet BST-BME280-DS002 1.23, 4.2 and
8.1 (compensation in floating point).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, DeviceTimeout
from thermocald_drivers.i2c import I2cThermometer, signed

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Bme280Thermometer", "Compensation"]

CALIBRATION_TP, IDENTITY, CALIBRATION_H = 0x88, 0xD0, 0xE1
CONTROL_HUMIDITY, STATUS, CONTROL, DATA = 0xF2, 0xF3, 0xF4, 0xF7
FORCED_X2_X1 = 0b010 << 5 | 0b001 << 2 | 0b01
MEASURING = 1 << 3
CONVERSION_S = 0.012
POLLS = 20


@dataclass(frozen=True)
class Compensation:
    """The factory's calibration: dig_T (3), dig_P (9) and dig_H (6) of the data sheet."""

    t: tuple[int, ...]
    p: tuple[int, ...]
    h: tuple[int, ...]

    @classmethod
    def from_registers(cls, low: bytes, high: bytes) -> Compensation:
        """low: 0x88 … 0xA1 (26 bytes), high: 0xE1 … 0xE7 (7 bytes)."""
        h4 = signed(high[3] << 4 | high[4] & 0x0F, 12)
        h5 = signed(high[5] << 4 | high[4] >> 4, 12)
        return cls(
            t=struct.unpack("<Hhh", low[:6]),
            p=struct.unpack("<Hhhhhhhhh", low[6:24]),
            h=(low[25], *struct.unpack("<hB", high[:3]), h4, h5, *struct.unpack("<b", high[6:7])),
        )

    def fine(self, adc: int) -> float:
        """t_fine of a raw temperature; t_fine / 5120 is °C."""
        t1, t2, t3 = self.t
        first = (adc / 16384.0 - t1 / 1024.0) * t2
        return first + (adc / 131072.0 - t1 / 8192.0) ** 2 * t3

    def pressure(self, adc: int, fine: float) -> float | None:
        """Pa; None where the calibration would divide by zero."""
        p1, p2, p3, p4, p5, p6, p7, p8, p9 = self.p
        v1 = fine / 2.0 - 64000.0
        v2 = v1 * v1 * p6 / 32768.0 + v1 * p5 * 2.0
        v2 = v2 / 4.0 + p4 * 65536.0
        v1 = (1.0 + (p3 * v1 * v1 / 524288.0 + p2 * v1) / 524288.0 / 32768.0) * p1
        if v1 == 0.0:
            return None
        p = (1048576.0 - adc - v2 / 4096.0) * 6250.0 / v1
        return p + (p9 * p * p / 2147483648.0 + p * p8 / 32768.0 + p7) / 16.0

    def humidity(self, adc: int, fine: float) -> float:
        """% relative humidity, within 0 … 100."""
        h1, h2, h3, h4, h5, h6 = self.h
        x = fine - 76800.0
        x = (adc - (h4 * 64.0 + h5 / 16384.0 * x)) * (
            h2 / 65536.0 * (1.0 + h6 / 67108864.0 * x * (1.0 + h3 / 67108864.0 * x))
        )
        return min(100.0, max(0.0, x * (1.0 - h1 * x / 524288.0)))


class Bme280Thermometer(I2cThermometer):
    """One BME280, a forced measurement per reading."""

    chip = "BME280"
    addresses = (0x76, 0x77)
    range_c = (-40.0, 85.0)

    def _identify(self) -> Mapping[str, str]:
        self._expect("the identity", self._smbus.read_byte_data(self.address, IDENTITY), 0x60)
        low = bytes(self._smbus.read_i2c_block_data(self.address, CALIBRATION_TP, 26))
        high = bytes(self._smbus.read_i2c_block_data(self.address, CALIBRATION_H, 7))
        if low in (bytes(26), b"\xff" * 26):
            raise BadReading(f"{self.where}: the calibration registers are empty")
        self._compensation = Compensation.from_registers(low, high)
        return {}

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        self._smbus.write_byte_data(self.address, CONTROL_HUMIDITY, 0b001)
        self._smbus.write_byte_data(self.address, CONTROL, FORCED_X2_X1)
        self._wait(CONVERSION_S)
        for _ in range(POLLS):
            if not self._smbus.read_byte_data(self.address, STATUS) & MEASURING:
                break
            self._wait(0.005)
        else:
            raise DeviceTimeout(f"{self.where}: the measurement did not end in 0.1 s")
        data = bytes(self._smbus.read_i2c_block_data(self.address, DATA, 8))
        pressure = data[0] << 12 | data[1] << 4 | data[2] >> 4
        temperature = data[3] << 12 | data[4] << 4 | data[5] >> 4
        if temperature == 0x80000:
            raise BadReading(f"{self.where}: 0x80000, the temperature was not measured")
        if data == b"\xff" * 8:
            raise BadReading(f"{self.where}: reads 0xFFFF, nothing drives the bus")
        fine = self._compensation.fine(temperature)
        about: dict[str, Any] = {}
        pascal = self._compensation.pressure(pressure, fine)
        if pascal is not None and pressure != 0x80000:
            about["pressure_pa"] = pascal
        raw_humidity = data[6] << 8 | data[7]
        if raw_humidity != 0x8000:
            about["humidity_percent"] = self._compensation.humidity(raw_humidity, fine)
        return fine / 5120.0, about
