"""Sensirion SHT30, SHT31, SHT35, I2C 0x44 and 0x45; every word carries a CRC.

    thermometers:
      - {name: air, driver: sht3x, bus: 1, address: 0x44, channel: air}

The serial number is read as identity and the status register checked. Each reading is a single shot
with high repeatability (15 ms); both CRCs must be right. The relative humidity goes into the
reading's metadata. Source: data sheet SHT3x-DIS v6, 4.3, 4.12, 4.13.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading
from thermocald_drivers import support
from thermocald_drivers.i2c import I2cThermometer

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Sht3xThermometer", "crc8"]

SINGLE_SHOT_HIGH, SERIAL_NUMBER, SOFT_RESET = 0x2400, 0x3780, 0x30A2
CONVERSION_S = 0.0155


def crc8(data: bytes) -> int:
    """CRC of the chip: polynomial 0x31, initial value 0xFF; BE EF gives 0x92 (table 20)."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x31) & 0xFF if crc & 0x80 else crc << 1
    return crc


class Sht3xThermometer(I2cThermometer):
    """One SHT3x, a conversion per reading."""

    chip = "SHT3x"
    addresses = (0x44, 0x45)
    range_c = (-40.0, 125.0)

    def _identify(self) -> Mapping[str, str]:
        self._command(SOFT_RESET)  # leave the periodic mode of an earlier user
        self._wait(0.002)
        self._command(SERIAL_NUMBER)
        self._wait(0.001)
        high, low = self._words(2)
        return {"serial": f"{high:04x}{low:04x}"}

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        self._command(SINGLE_SHOT_HIGH)
        self._wait(CONVERSION_S)
        temperature, humidity = self._words(2)
        if temperature == 0xFFFF and humidity == 0xFFFF:
            raise BadReading(f"{self.where}: reads 0xFFFF, nothing drives the bus")
        value = -45.0 + 175.0 * temperature / 65535.0
        return value, {"humidity_percent": 100.0 * humidity / 65535.0}

    def _command(self, command: int) -> None:
        self._smbus.write_i2c_block_data(self.address, command >> 8, [command & 0xFF])

    def _words(self, count: int) -> list[int]:
        """Plain read of `count` words, each followed by its CRC."""
        message = support.library("smbus2").i2c_msg.read(self.address, 3 * count)
        self._smbus.i2c_rdwr(message)
        data = bytes(message)
        words = []
        for k in range(0, 3 * count, 3):
            if crc8(data[k : k + 2]) != data[k + 2]:
                raise BadReading(f"{self.where}: CRC error in {data.hex(' ')}; check the wiring")
            words.append(int.from_bytes(data[k : k + 2], "big"))
        return words
