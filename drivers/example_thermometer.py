"""Microchip TC74 thermometer, ±2 °C, resolution 1 K, on SMBus: the example of drivers/README.md.

    thermometers:
      - {name: box, driver: tc74, bus: 1, address: 0x4d}

Source: data sheet DS21462D, 3.2: register 0 is °C in two's complement, register 1 bit 6 DATA_RDY.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from thermocald.errors import BadReading, DeviceGone, DeviceNotFound
from thermocald.hal import DriverOptions, Reading, Thermometer


class Tc74Thermometer(Thermometer):
    """A TC74 chip."""

    device_classes = ("char-i2c",)
    where = "TC74"

    class Options(DriverOptions):  # one field per key of the stanza, except name and driver
        bus: Annotated[int, Field(ge=0, le=255)] = 1
        address: Annotated[int, Field(ge=0x48, le=0x4F)] = 0x4D

    def open(self) -> None:
        import smbus2  # a device's library is imported when the device is opened

        try:
            self.handle = smbus2.SMBus(self.options.bus)  # `Device.close` closes it
            self.handle.read_byte_data(self.options.address, 1)
        except OSError as error:
            self.close()
            raise DeviceNotFound(f"TC74 at {self.options.address:#x}: {error.strerror}") from error

    def read(self) -> Reading:
        smbus = self.opened()
        try:
            ready = smbus.read_byte_data(self.options.address, 1) & 0x40
            raw = smbus.read_byte_data(self.options.address, 0)
        except OSError as error:
            raise DeviceGone(f"TC74 at {self.options.address:#x}: {error.strerror}") from error
        if not ready:
            raise BadReading("TC74: no conversion since power-on")
        celsius = float(raw - 256 if raw > 127 else raw)
        if not -65.0 <= celsius <= 127.0:
            raise BadReading(f"TC74: {celsius:g} °C is outside its range")
        return Reading({"temperature": celsius}, self.clock.monotonic(), self.clock.utc())
