"""Microchip MCP9808, ±0.25 °C, 0.0625 K, I2C 0x18–0x1f.

    thermometers:
      - {name: lens, driver: mcp9808, bus: 1, address: 0x18, channel: lens}

Manufacturer 0x0054 and device 0x04 are checked. Bits 15–13 of the temperature register are alert
flags and bit 12 the sign. A chip in shut-down would repeat its last value for ever: it is woken and
one conversion awaited (0.25 s). The register is 0 at power-up; see `i2c`.
Source: data sheet DS25095A, 5.1.3 and 5.2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading
from thermocald_drivers.i2c import I2cThermometer, signed

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Mcp9808Thermometer"]

CONFIGURATION, AMBIENT, MANUFACTURER, DEVICE = 0x01, 0x05, 0x06, 0x07
SHUTDOWN = 1 << 8
CONVERSION_S = 0.25


class Mcp9808Thermometer(I2cThermometer):
    """One MCP9808 in continuous conversion."""

    chip = "MCP9808"
    addresses = range(0x18, 0x20)
    range_c = (-40.0, 125.0)

    def _identify(self) -> Mapping[str, str]:
        self._expect("the manufacturer", self._word(MANUFACTURER), 0x0054)
        self._expect("the device register", self._word(DEVICE) >> 8, 0x04)
        self._wake()
        return {}

    def _wake(self) -> bool:
        """Leave shut-down; True if it was in it."""
        configuration = self._word(CONFIGURATION)
        if not configuration & SHUTDOWN:
            return False
        self._write_word(CONFIGURATION, configuration & ~SHUTDOWN)
        if self._word(CONFIGURATION) & SHUTDOWN:
            raise BadReading(f"{self.where}: does not leave shut-down (locked registers?)")
        self._wait(CONVERSION_S)
        return True

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        self._wake()
        flags = 0

        def read() -> int:
            nonlocal flags
            raw = self._data_word(AMBIENT)
            flags = raw >> 13
            return raw & 0x1FFF

        raw = self._converted(read, 0, CONVERSION_S)
        return self._celsius(raw), {"alert_flags": flags}

    def _celsius(self, raw: int) -> float:
        return signed(raw, 13) / 16.0
