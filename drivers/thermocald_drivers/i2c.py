"""What the I2C thermometers share: the bus, the identity register, errno, refusal of 0xFFFF and 0.

    thermometers:
      - {name: lens, driver: tmp117, bus: 1, address: 0x48}

smbus2 opens /dev/i2c-N (Raspberry Pi: `dtparam=i2c_arm=on`, user in the group `i2c`). Where the
kernel has a driver for the chip, prefer it (`hwmon`, `iio`): an address that a kernel driver holds
is refused here with EBUSY. Word registers are sent high byte first, SMBus words low byte first:
`_word` swaps them.

0xFFFF is a bus that nothing drives. Chips without a data-ready flag hold a fixed value from
power-up to the end of their first conversion, mostly 0 °C: it is read again after one conversion,
and then accepted only if a recent reading lay within 5 K.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, WrongDevice
from thermocald.hal import Found, Thermometer
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.hal import Clock, Reading

__all__ = ["I2cThermometer", "signed"]


class I2cThermometer(Thermometer):
    """A thermometer at one address of one bus; a chip gives `_identify` and `_measure`."""

    device_classes = ("char-i2c",)
    chip: ClassVar[str]
    addresses: ClassVar[range | tuple[int, ...]]
    range_c: ClassVar[tuple[float, float]]

    def __init__(
        self,
        *,
        clock: Clock,
        bus: int = 1,
        address: int | None = None,
        channel: str = "temperature",
    ) -> None:
        self.clock = clock
        self.bus = int(support.number("bus", bus, 0, 255, whole=True))
        chosen = self.addresses[0] if address is None else address
        if chosen not in self.addresses:
            known = ", ".join(f"0x{a:02x}" for a in self.addresses)
            shown = f"0x{chosen:02x}" if isinstance(chosen, int) else repr(chosen)
            raise ConfigurationError(
                f"address: {shown} is not an address of a {self.chip} ({known})"
            )
        self.address = chosen
        self.channel = support.text("channel", channel)
        self._smbus: Any = None
        self._seen = False
        self._neighbour = support.Neighbour(clock)

    @property
    def where(self) -> str:
        """The device as the user knows it."""
        return f"{self.chip} at 0x{self.address:02x} on /dev/i2c-{self.bus}"

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:
        """Buses a chip could be on; scanning addresses could upset other chips."""
        buses = sorted(Path(sysfs).glob("class/i2c-dev/i2c-*"))
        return [
            Found(
                {"bus": int(path.name.split("-")[1]), "address": cls.addresses[0]},
                f"/dev/{path.name}: if a {cls.chip} is wired to it",
                certain=False,
            )
            for path in buses
        ]

    def open(self) -> None:
        smbus2 = support.library("smbus2")
        hint = "is I2C switched on (dtparam=i2c_arm=on), the chip wired, the user in group i2c?"
        try:
            self._smbus = smbus2.SMBus(self.bus)
            about = self._identify()
        except OSError as error:
            self.close()
            raise support.fault(error, self.where, seen=self._seen, hint=hint) from error
        self._about = dict(about)
        self._seen = True

    def close(self) -> None:
        smbus, self._smbus = self._smbus, None
        if smbus is not None:
            smbus.close()

    def identity(self) -> Mapping[str, str]:
        return {"chip": self.chip, "address": f"0x{self.address:02x}", "bus": str(self.bus)}

    def read(self) -> Reading:
        if self._smbus is None:
            raise DeviceGone(f"{self.where}: not open")
        start = self.clock.monotonic()
        try:
            value, about = self._measure()
        except OSError as error:
            raise support.fault(error, self.where, seen=True) from error
        support.believable(value, *self.range_c, self.where)
        return support.middle_reading(self.clock, {self.channel: value}, start, about)

    def _identify(self) -> Mapping[str, str]:
        """Check that it is this chip and make it convert; WrongDevice if it is another."""
        raise NotImplementedError

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        """One fresh value in °C and what else the chip reports."""
        raise NotImplementedError

    def _converted(self, read: Callable[[], int], power_up: int, conversion_s: float) -> int:
        """A temperature word of a chip that has no data-ready flag; BadReading at power-up."""
        raw = read()
        if raw != power_up:
            self._neighbour.measured(self._celsius(raw))
            return raw
        self._wait(conversion_s)
        raw = read()
        if raw == power_up and not self._neighbour.supports(self._celsius(raw)):
            raise BadReading(
                f"{self.where}: {self._celsius(raw):g} °C is its power-up value and no recent "
                "reading was near it; the chip lost its supply, or does not convert"
            )
        return raw

    def _celsius(self, raw: int) -> float:
        """°C of a temperature word, for chips that use `_converted`."""
        raise NotImplementedError

    def _word(self, register: int) -> int:
        """A 16-bit register, high byte first on the wire."""
        value = int(self._smbus.read_word_data(self.address, register))
        return (value & 0xFF) << 8 | value >> 8

    def _write_word(self, register: int, value: int) -> None:
        swapped = (value & 0xFF) << 8 | value >> 8
        self._smbus.write_word_data(self.address, register, swapped)

    def _data_word(self, register: int) -> int:
        """A measurement register; 0xFFFF is a bus that nothing drives, and is refused."""
        value = self._word(register)
        if value == 0xFFFF:
            raise BadReading(f"{self.where}: reads 0xFFFF, nothing drives the bus")
        return value

    def _expect(self, what: str, found: int, wanted: int) -> None:
        if found != wanted:
            raise WrongDevice(
                f"{self.where}: {what} reads 0x{found:04x} and a {self.chip} has 0x{wanted:04x}; "
                "another chip sits at this address"
            )

    def _wait(self, seconds: float) -> None:
        """Let a conversion finish on the driver's own clock."""
        self.clock.sleep_until(self.clock.monotonic() + seconds)


def signed(value: int, bits: int) -> int:
    """Two's complement of the lowest `bits` bits."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value
