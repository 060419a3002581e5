"""Thermometers on an I2C bus: TMP117, MCP9808, the LM75 family, SHT3x, BME280.

    thermometers:
      - {name: lens, driver: tmp117, bus: 1, address: 0x48}            # 0x48 … 0x4b
      - {name: air, driver: mcp9808, bus: 1, address: 0x18, channel: air}    # 0x18 … 0x1f
      - {name: board, driver: lm75, chip: tmp102, bus: 1, address: 0x49}     # 0x48 … 0x4f
      - {name: box, driver: sht3x, bus: 1, address: 0x44}              # 0x44, 0x45
      - {name: room, driver: bme280, bus: 1, address: 0x76}            # 0x76, 0x77

smbus2 opens /dev/i2c-N (Raspberry Pi: `dtparam=i2c_arm=on`, user in the group `i2c`). If the kernel
has a driver for the chip, prefer that (`hwmon`, `iio`): an address that a kernel driver holds is
denied here with EBUSY. The chip's identity is checked when it is opened; 0xFFFF means that nothing
drives the bus. `channel` names the temperature.

* TMP117 (±0.1 °C): one one-shot conversion of 8 averages per reading. The driver waits for
  Data_Ready, so that no value is read twice; −256 °C precedes the first conversion, and is out of
  range (SNOSD82D, 7.6).
* MCP9808 (±0.25 °C): bits 15–13 of the register are alert flags, bit 12 the sign (DS25095A, 5).
* LM75 family, `chip`: lm75 (also LM75A, LM75B, which use two more bits), lm75b, tmp75, tmp102. They
  have no identity: the driver checks the bits that a chip leaves at zero, in its limits as well
  (LM75B rev. 6.1, TMP75 SBOS288, TMP102 SBOS397H).
* SHT3x: a single shot with high repeatability; each word has a CRC (SHT3x-DIS v6, 4.3 … 4.13).
* BME280: a forced measurement without the filter; the chip warms itself and measures its board
  (BST-BME280-DS002 1.23, 4.2, 8.1).

MCP9808 and the LM75 family convert continuously. In shut-down they would repeat their last value
forever, so the driver wakes them, sets the finest resolution and the highest rate (a TMP75 starts
with 0.5 K, a TMP102 may convert every 4 s), and waits for a conversion. Their power-up value (see
`chips`) is read again after one conversion and then accepted only if a recent reading is within
5 K.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from thermocald.errors import BadReading, ConfigurationError, DeviceTimeout, WrongDevice
from thermocald.hal import DriverOptions, Found
from thermocald_drivers import chips, support

if TYPE_CHECKING:
    from thermocald.hal import Reading


class I2cThermometer(support.CheckedThermometer):
    """A thermometer at one address of a bus; a chip's class implements `_identify`, `_measure`."""

    device_classes = ("char-i2c",)

    class Options(DriverOptions):
        """A chip's place and its channel's name; address None: the chip's first address."""

        bus: Annotated[int, Field(ge=0, le=255)] = 1
        address: int | None = None
        channel: support.Text = "temperature"

    chip: ClassVar[str]
    addresses: ClassVar[range | tuple[int, ...]]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        chosen = self.options.address
        self.address = self.addresses[0] if chosen is None else chosen
        if self.address not in self.addresses:
            known = ", ".join(f"0x{a:02x}" for a in self.addresses)
            raise ConfigurationError(
                f"address: 0x{chosen:02x} is not an address of a {self.chip} ({known})"
            )
        self.where = f"{self.chip} at 0x{self.address:02x} on /dev/i2c-{self.options.bus}"

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:
        """List the buses that may have the chip; scanning addresses could upset other chips."""
        return [
            Found(
                {"bus": int(path.name.split("-")[1]), "address": cls.addresses[0]},
                f"/dev/{path.name}: if a {cls.chip} is wired to it",
                certain=False,
            )
            for path in sorted(Path(sysfs).glob("class/i2c-dev/i2c-*"))
        ]

    def open(self) -> None:
        smbus2 = support.library("smbus2")
        hint = "check dtparam=i2c_arm=on, the wiring and that the user is in group i2c"
        try:
            self.handle = smbus2.SMBus(self.options.bus)
            self._identify()
        except OSError as error:
            self.close()
            raise support.fault(error, self.where, seen=self.seen, hint=hint) from error
        self.seen = True

    def named_channels(self) -> list[str]:
        return [self.options.channel]

    def read(self) -> Reading:
        self.opened()
        channel, where = self.options.channel, self.where
        return self.reading({channel: (where, lambda: self.judge("", where, *self._measure()))})

    def _identify(self) -> None:
        """Check the chip's identity and make it convert; WrongDevice if it is another chip."""
        raise NotImplementedError

    def _measure(self) -> tuple[float, str]:
        """Return (a fresh value in °C, why it may not have been measured or "")."""
        raise NotImplementedError

    def _read(self, register: int, mask: int = 0xFFFF) -> int:
        """Read a register as wide as a mask, of 8 or 16 bits."""
        if mask <= 0xFF:
            return int(self.handle.read_byte_data(self.address, register))
        return swapped(int(self.handle.read_word_data(self.address, register)))

    def _write(self, register: int, value: int, mask: int = 0xFFFF) -> None:
        if mask <= 0xFF:
            self.handle.write_byte_data(self.address, register, value)
        else:
            self.handle.write_word_data(self.address, register, swapped(value))

    def _driven(self, word: int) -> int:
        """Return a measured word; BadReading for 0xFFFF, of a bus that nothing drives."""
        if word == 0xFFFF:
            raise BadReading(f"{self.where}: reads 0xFFFF, nothing drives the bus")
        return word

    def _expect(self, what: str, found: int, wanted: int) -> None:
        if found != wanted:
            raise WrongDevice(
                f"{self.where}: {what} reads 0x{found:04x} and a {self.chip} has 0x{wanted:04x}; "
                "another chip has this address"
            )

    def _wait(self, seconds: float) -> None:
        """Wait for a conversion, on the driver's clock."""
        self.clock.sleep_until(self.clock.monotonic() + seconds)

    def _await(self, register: int, mask: int, wanted: int, poll_s: float) -> None:
        """Poll a status register for the wanted bits; DeviceTimeout after 20 attempts."""
        for _ in range(20):
            if self._read(register, mask) & mask == wanted:
                return
            self._wait(poll_s)
        raise DeviceTimeout(f"{self.where}: the conversion did not end in {20 * poll_s:g} s")


class Tmp117Thermometer(I2cThermometer):
    """A TMP117, with one conversion per reading."""

    chip = "TMP117"
    addresses = range(0x48, 0x4C)
    range_c = (-55.0, 150.0)
    TEMPERATURE, CONFIGURATION, DEVICE = 0x00, 0x01, 0x0F
    ONE_SHOT_8_AVERAGES, DATA_READY = 0b11 << 10 | 0b01 << 5, 1 << 13

    def _identify(self) -> None:
        self._expect("the device identity", self._read(self.DEVICE) & 0x0FFF, 0x0117)

    def _measure(self) -> tuple[float, str]:
        self._read(self.CONFIGURATION)  # reading clears the Data_Ready of an earlier conversion
        self._write(self.CONFIGURATION, self.ONE_SHOT_8_AVERAGES)
        self._wait(0.1245)
        self._await(self.CONFIGURATION, self.DATA_READY, self.DATA_READY, 0.01)
        return signed(self._driven(self._read(self.TEMPERATURE)), 16) / 128.0, ""


class _ConvertingThermometer(I2cThermometer):
    """A chip without a data-ready flag that converts continuously unless it is shut down."""

    conversion_s: float
    TEMPERATURE, CONFIGURATION = 0x00, 0x01
    shutdown, finest = 1, 0
    """Bits of the configuration: shut-down; the finest resolution and the highest rate."""

    def _wake(self) -> None:
        """End a shut-down or a coarser or slower mode, and wait for a conversion."""
        old = self._read(self.CONFIGURATION, self.shutdown)
        new = old & ~self.shutdown | self.finest
        if old == new:
            return
        for value in (new | self.shutdown, new):  # leaving shut-down starts a conversion
            self._write(self.CONFIGURATION, value, self.shutdown)
        got = self._read(self.CONFIGURATION, self.shutdown)
        if (got ^ new) & (self.shutdown | self.finest):
            raise BadReading(
                f"{self.where}: does not leave shut-down or a coarse mode (locked registers?)"
            )
        self._wait(self.conversion_s)

    def _measure(self) -> tuple[float, str]:
        self._wake()
        value = self._temperature()
        if value == 0.0:
            self._wait(self.conversion_s)
            value = self._temperature()
        idle = "its power-up value: it lost its supply or does not convert"
        return value, "" if value else idle

    def _temperature(self) -> float:
        return self._decode(self._driven(self._read(self.TEMPERATURE)))

    def _decode(self, word: int) -> float:
        """Convert a temperature word to °C."""
        raise NotImplementedError


class Mcp9808Thermometer(_ConvertingThermometer):
    """An MCP9808 in continuous conversion."""

    chip = "MCP9808"
    addresses = range(0x18, 0x20)
    range_c = (-40.0, 125.0)
    conversion_s = 0.25
    TEMPERATURE, MANUFACTURER, DEVICE, RESOLUTION = 0x05, 0x06, 0x07, 0x08
    shutdown = 1 << 8

    def _identify(self) -> None:
        self._expect("the manufacturer", self._read(self.MANUFACTURER), 0x0054)
        self._expect("the device register", self._read(self.DEVICE) >> 8, 0x04)
        self._write(self.RESOLUTION, 0b11, 0xFF)  # 0.0625 K, as at power-up
        self._wake()

    def _decode(self, word: int) -> float:
        return signed(word, 13) / 16.0


class Lm75Thermometer(_ConvertingThermometer):
    """A chip of the LM75 family in continuous conversion."""

    class Options(I2cThermometer.Options):
        """The options of `lm75`, of which chip is the member of the family."""

        chip: Literal["lm75", "lm75b", "tmp75", "tmp102"] = "lm75"

    chip = "LM75"
    addresses = range(0x48, 0x50)
    range_c = (-55.0, 127.9375)
    LIMITS: ClassVar = {0x02: "the hysteresis", 0x03: "the limit"}
    # bits of the temperature, bits of the limits, s per conversion, shut-down, finest
    VARIANTS: ClassVar = {
        "lm75": (11, 9, 0.3, 1, 0),  # 9 bits; an LM75A or LM75B has 11, and 9 in its limits
        "lm75b": (11, 11, 0.1, 1, 0),
        "tmp75": (12, 12, 0.3, 1, 0b11 << 5),  # 9 bits at power-up
        "tmp102": (12, 12, 0.035, 1 << 8, 0b11 << 6),  # 8 Hz; 0.25 Hz would be 4 s old
    }

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        variant = self.VARIANTS[self.options.chip]
        self.bits, self.limit_bits, self.conversion_s, self.shutdown, self.finest = variant

    def _identify(self) -> None:
        unused = (1 << (16 - self.limit_bits)) - 1
        # a TMP102 in extended mode has 13 bits, to 150 °C
        extended = self.options.chip == "tmp102" and self._read(self.CONFIGURATION) & 1 << 4
        for register, what in self.LIMITS.items():
            limit = self._read(register)
            if limit == 0xFFFF or (limit & unused and not extended):
                raise WrongDevice(
                    f"{self.where}: {what} reads 0x{limit:04x}, which a {self.options.chip} "
                    "cannot; another chip has this address"
                )
        self._wake()

    def _decode(self, word: int) -> float:
        if self.options.chip == "tmp102" and word & 1:
            return signed(word >> 3, 13) / 16.0
        unused = 16 - self.bits
        if word & ((1 << unused) - 1):
            raise BadReading(
                f"{self.where}: 0x{word:04x} has bits set that a {self.options.chip} leaves zero"
            )
        return signed(word >> unused, self.bits) / (1 << (self.bits - 8))


class Sht3xThermometer(I2cThermometer):
    """An SHT3x, with one conversion per reading."""

    chip = "SHT3x"
    addresses = (0x44, 0x45)
    range_c = (-40.0, 125.0)
    SINGLE_SHOT_HIGH, SERIAL_NUMBER, BREAK, SOFT_RESET = 0x2400, 0x3780, 0x3093, 0x30A2

    def _identify(self) -> None:
        self._command(self.BREAK, 0.001)  # in the periodic mode of an earlier program, before any
        self._command(self.SOFT_RESET, 0.002)
        self._command(self.SERIAL_NUMBER, 0.001)
        self._words()

    def _measure(self) -> tuple[float, str]:
        self._command(self.SINGLE_SHOT_HIGH, 0.0155)
        temperature, humidity = self._words()
        self._driven(temperature & humidity)
        return -45.0 + 175.0 * temperature / 65535.0, ""

    def _command(self, command: int, wait_s: float) -> None:
        self.handle.write_i2c_block_data(self.address, command >> 8, [command & 0xFF])
        self._wait(wait_s)

    def _words(self) -> tuple[int, int]:
        """Read two words, each followed by its CRC, without a register address."""
        message = support.library("smbus2").i2c_msg.read(self.address, 6)
        self.handle.i2c_rdwr(message)
        data = bytes(message)
        if crc8(data[:2]) != data[2] or crc8(data[3:5]) != data[5]:
            raise BadReading(f"{self.where}: CRC error in {data.hex(' ')}; check the wiring")
        return int.from_bytes(data[:2], "big"), int.from_bytes(data[3:5], "big")


class Bme280Thermometer(I2cThermometer):
    """A BME280, with one forced measurement per reading."""

    chip = "BME280"
    addresses = (0x76, 0x77)
    range_c = (-40.0, 85.0)
    CALIBRATION, IDENTITY, RESET = 0x88, 0xD0, 0xE0
    CONTROL_HUMIDITY, STATUS, CONTROL, DATA = 0xF2, 0xF3, 0xF4, 0xF7
    FORCED_X2_X1, MEASURING = 0b010 << 5 | 0b001 << 2 | 0b01, 1 << 3

    def _identify(self) -> None:
        self._expect("the identity", self._read(self.IDENTITY, 0xFF), 0x60)
        self._write(self.RESET, 0xB6, 0xFF)  # an earlier program may have left the filter on
        self._wait(0.01)
        self._calibration()

    def _calibration(self) -> tuple[int, ...]:
        """Return dig_T1 … dig_T3."""
        table = bytes(self.handle.read_i2c_block_data(self.address, self.CALIBRATION, 6))
        if table in (bytes(6), b"\xff" * 6):
            raise BadReading(f"{self.where}: the calibration registers are empty")
        return struct.unpack("<Hhh", table)

    def _measure(self) -> tuple[float, str]:
        self._write(self.CONTROL_HUMIDITY, 0b001, 0xFF)
        self._write(self.CONTROL, self.FORCED_X2_X1, 0xFF)
        self._wait(0.012)
        self._await(self.STATUS, self.MEASURING, 0, 0.005)
        data = self.handle.read_i2c_block_data(self.address, self.DATA, 8)
        self._driven(data[6] << 8 | data[7])
        raw = data[3] << 12 | data[4] << 4 | data[5] >> 4
        if chips.is_idle_word("bme280", raw):
            raise BadReading(f"{self.where}: 0x{raw:05x}, the temperature was not measured")
        # read each time: the chip may have been exchanged between two readings
        t1, t2, t3 = self._calibration()
        first = (raw / 16384.0 - t1 / 1024.0) * t2  # data sheet 8.1
        return (first + (raw / 131072.0 - t1 / 8192.0) ** 2 * t3) / 5120.0, ""


def crc8(data: bytes) -> int:
    """Return the SHT3x's CRC: polynomial 0x31, initial value 0xFF; BE EF has 0x92 (table 20)."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x31) & 0xFF if crc & 0x80 else crc << 1
    return crc


def swapped(word: int) -> int:
    """Return a word as on the wire, high byte first, unlike an SMBus word."""
    return (word & 0xFF) << 8 | word >> 8


def signed(value: int, bits: int) -> int:
    """Return the lowest `bits` bits as a two's complement number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value
