"""The LM75 family without an identity register: LM75, LM75B, TMP75, TMP102; I2C 0x48–0x4f.

    thermometers:
      - {name: lens, driver: lm75, chip: tmp102, bus: 1, address: 0x48, channel: lens}

These chips have no identity register. What can be checked is: the bits of the temperature register
that the chip leaves at zero, and that its limit registers hold values of the same grid. `chip:
lm75` also reads LM75A and LM75B, which use two more bits. A chip in shut-down would repeat its last
value for ever: it is woken and one conversion awaited. The register is 0 at power-up; see `i2c`.
Linux's driver lm75 knows the whole family: where it is bound, use `hwmon`.
Source: data sheets LM75B (NXP rev. 6.1), TMP75 (SBOS288), TMP102 (SBOS397H).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, WrongDevice
from thermocald_drivers import support
from thermocald_drivers.i2c import I2cThermometer, signed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock

__all__ = ["Lm75Thermometer"]

TEMPERATURE, CONFIGURATION, HYSTERESIS, OVER = 0x00, 0x01, 0x02, 0x03


@dataclass(frozen=True)
class Variant:
    """Bits of the temperature word and of the limits; how long one conversion takes."""

    bits: int
    limit_bits: int
    conversion_s: float


VARIANTS = {
    "lm75": Variant(11, 9, 0.3),  # 9 bits; an LM75A or LM75B has 11, and 9 in its limits
    "lm75b": Variant(11, 11, 0.1),
    "tmp75": Variant(12, 12, 0.3),
    "tmp102": Variant(12, 12, 0.035),
}


class Lm75Thermometer(I2cThermometer):
    """One chip of the family in continuous conversion."""

    chip = "LM75"
    addresses = range(0x48, 0x50)
    range_c = (-55.0, 127.9375)

    def __init__(
        self,
        *,
        clock: Clock,
        chip: str = "lm75",
        bus: int = 1,
        address: int | None = None,
        channel: str = "temperature",
    ) -> None:
        super().__init__(clock=clock, bus=bus, address=address, channel=channel)
        self.variant = VARIANTS[support.choice("chip", chip, sorted(VARIANTS))]
        self.name = chip

    def _identify(self) -> Mapping[str, str]:
        unused = (1 << (16 - self.variant.limit_bits)) - 1
        for what, register in (("the hysteresis", HYSTERESIS), ("the limit", OVER)):
            limit = self._word(register)
            if limit == 0xFFFF or (limit & unused and not self._extended()):
                raise WrongDevice(
                    f"{self.where}: {what} reads 0x{limit:04x}, which a {self.name} cannot; "
                    "another chip sits at this address"
                )
        self._wake()
        return {}

    def _extended(self) -> bool:
        """TMP102 only: 13 bits, to 150 °C."""
        return self.name == "tmp102" and bool(self._word(CONFIGURATION) & 1 << 4)

    def _wake(self) -> None:
        configuration = int(self._smbus.read_byte_data(self.address, CONFIGURATION))
        if configuration & 1:
            self._smbus.write_byte_data(self.address, CONFIGURATION, configuration & ~1)
            if int(self._smbus.read_byte_data(self.address, CONFIGURATION)) & 1:
                raise BadReading(f"{self.where}: does not leave shut-down")
            self._wait(self.variant.conversion_s)

    def _measure(self) -> tuple[float, Mapping[str, Any]]:
        self._wake()
        raw = self._converted(lambda: self._data_word(TEMPERATURE), 0, self.variant.conversion_s)
        extended = self._is_extended(raw)
        if not extended and raw & ((1 << (16 - self.variant.bits)) - 1):
            raise BadReading(
                f"{self.where}: 0x{raw:04x} has bits set that a {self.name} leaves zero"
            )
        return self._celsius(raw), {"extended": True} if extended else {}

    def _is_extended(self, raw: int) -> bool:
        """Whether a TMP102 marks its word as one of 13 bits, to 150 °C."""
        return self.name == "tmp102" and bool(raw & 1)

    def _celsius(self, raw: int) -> float:
        if self._is_extended(raw):
            return signed(raw >> 3, 13) / 16.0
        return signed(raw >> (16 - self.variant.bits), self.variant.bits) / (
            1 << (self.variant.bits - 8)
        )
