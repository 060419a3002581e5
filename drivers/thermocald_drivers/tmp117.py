"""Texas Instruments TMP117, ±0.1 °C, 0.0078125 K, I2C 0x48–0x4b.

    thermometers:
      - {name: lens, driver: tmp117, bus: 1, address: 0x48, channel: lens}

The device identity 0x117 is checked. Every read starts a one-shot conversion (8 averages, 0.125 s)
and waits for its Data_Ready flag, so that no value is read twice; 0x8000 (−256 °C), the register's
value before the first conversion, is refused. Source: data sheet SNOSD82D, 7.6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, DeviceTimeout
from thermocald_drivers.i2c import I2cThermometer, signed

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Tmp117Thermometer"]

TEMPERATURE, CONFIGURATION, DEVICE = 0x00, 0x01, 0x0F
ONE_SHOT_8_AVERAGES = 0b11 << 10 | 0b01 << 5
DATA_READY = 1 << 13
CONVERSION_S = 0.1245
POLLS = 20


class Tmp117Thermometer(I2cThermometer):
    """One TMP117, a conversion per reading."""

    chip = "TMP117"
    addresses = range(0x48, 0x4C)
    range_c = (-55.0, 150.0)

    def _identify(self) -> Mapping[str, str]:
        found = self._word(DEVICE)
        self._expect("the device identity", found & 0x0FFF, 0x0117)
        return {"revision": str(found >> 12)}

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        self._word(CONFIGURATION)  # reading it clears a Data_Ready left over from before
        self._write_word(CONFIGURATION, ONE_SHOT_8_AVERAGES)
        self._wait(CONVERSION_S)
        for _ in range(POLLS):
            if self._word(CONFIGURATION) & DATA_READY:
                break
            self._wait(0.01)
        else:
            raise DeviceTimeout(f"{self.where}: the conversion did not end in 0.3 s")
        raw = self._data_word(TEMPERATURE)
        if raw == 0x8000:
            raise BadReading(f"{self.where}: 0x8000, the power-on value; no conversion took place")
        return signed(raw, 16) / 128.0, {}
