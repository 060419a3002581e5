"""Microchip TC74, ±2 °C, 1 K, on SMBus: the worked example of drivers/README.md.

    thermometers:
      - {name: box, driver: tc74, bus: 1, address: 0x4d}

Source: data sheet DS21462D, 3.2: register 0 is °C in two's complement, register 1 bit 6 DATA_RDY.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceNotFound
from thermocald.hal import Reading, Thermometer

if TYPE_CHECKING:
    from thermocald.hal import Clock


class Tc74Thermometer(Thermometer):
    """One chip; each key of its stanza except name and driver is an argument."""

    device_classes = ("char-i2c",)

    def __init__(self, *, clock: Clock, bus: int = 1, address: int = 0x4D) -> None:
        if not 0x48 <= address <= 0x4F:
            raise ConfigurationError(f"address: 0x{address:02x} is not within 0x48 … 0x4f")
        self.clock, self.bus, self.address = clock, bus, address
        self._smbus: Any = None

    def open(self) -> None:
        import smbus2  # the library is imported when the device is opened

        try:
            self._smbus = smbus2.SMBus(self.bus)
            self._smbus.read_byte_data(self.address, 1)
        except OSError as error:
            self.close()
            raise DeviceNotFound(f"TC74 at 0x{self.address:02x}: {error.strerror}") from error

    def close(self) -> None:
        smbus, self._smbus = self._smbus, None
        if smbus is not None:
            smbus.close()

    def read(self) -> Reading:
        if self._smbus is None:
            raise DeviceGone("TC74: not open")
        try:
            ready = self._smbus.read_byte_data(self.address, 1) & 0x40
            raw = self._smbus.read_byte_data(self.address, 0)
        except OSError as error:
            raise DeviceGone(f"TC74 at 0x{self.address:02x}: {error.strerror}") from error
        if not ready:
            raise BadReading("TC74: no conversion since power-on")
        celsius = float(raw - 256 if raw > 127 else raw)
        if not -65.0 <= celsius <= 127.0:
            raise BadReading(f"TC74: {celsius:g} °C is outside its range")
        return Reading({"temperature": celsius}, self.clock.monotonic(), self.clock.utc())
