"""I2C thermometers against chips on a fake SMBus adapter, register by register."""

from __future__ import annotations

import errno

import pytest
import smbus2
from thermocald_drivers.i2c import Compensation, crc8

from tests.drivers.fakes.chips import (
    ADC_P,
    ADC_T,
    CALIBRATION,
    CHIPS,
    HUMIDITY,
    bme280,
    lm75,
    mcp9808,
    sht3x,
    tmp117,
)
from tests.drivers.fakes.smbus import Bus, Chip
from thermocald import errors
from thermocald.hal import VirtualClock, open_device


@pytest.fixture
def bus(monkeypatch):
    adapter = Bus()
    monkeypatch.setattr(smbus2, "SMBus", adapter)
    yield adapter
    assert adapter.opened == 0  # every driver gives the bus back


def thermometer(name, **options):
    return open_device("thermometer", name, options, VirtualClock())


@pytest.mark.parametrize("name", CHIPS)
def test_a_good_reading(bus, name):
    address, chip, value = CHIPS[name]
    bus.chips[address] = chip()
    with thermometer(name) as device:
        assert device.read().values == {"temperature": pytest.approx(value, abs=0.005)}


@pytest.mark.parametrize("name", CHIPS)
@pytest.mark.parametrize(
    ("number", "error"),
    [
        (errno.EREMOTEIO, errors.DeviceGone),
        (errno.ENXIO, errors.DeviceGone),
        (errno.ETIMEDOUT, errors.DeviceTimeout),
        (errno.EIO, errors.BadReading),
        (errno.EBUSY, errors.TransientDeviceError),
        (errno.EACCES, errors.TransientDeviceError),
    ],
)
def test_a_bus_error_while_reading(bus, name, number, error):
    address, chip, _ = CHIPS[name]
    bus.chips[address] = chip()
    with thermometer(name) as device:
        bus.chips[address].error = number
        with pytest.raises(error, match=f"0x{address:02x} on /dev/i2c-1"):
            device.read()


@pytest.mark.parametrize("name", CHIPS)
def test_nobody_at_the_address(bus, name):
    device = thermometer(name)
    with pytest.raises(errors.DeviceNotFound, match="dtparam=i2c_arm=on"):
        device.open()
    address, chip, _ = CHIPS[name]
    bus.chips[address] = chip()
    device.open()
    device.close()
    del bus.chips[address]
    with pytest.raises(errors.DeviceGone):  # it was there once: worth another try
        device.open()


@pytest.mark.parametrize("name", CHIPS)
def test_an_address_that_the_kernel_holds(bus, name):
    address, chip, _ = CHIPS[name]
    bus.chips[address] = chip()
    bus.chips[address].error = errno.EBUSY
    with pytest.raises(errors.DeviceDenied, match="a kernel driver"):
        thermometer(name).open()


@pytest.mark.parametrize("name", CHIPS)
@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES])
def test_no_bus(bus, name, number):
    bus.open_error = number
    with pytest.raises(errors.DeviceNotFound if number == errno.ENOENT else errors.DeviceDenied):
        thermometer(name).open()


@pytest.mark.parametrize("name", CHIPS)
def test_another_chip_at_the_address(bus, name):
    address = CHIPS[name][0]
    bus.chips[address] = Chip()  # every register reads 0xFF
    with pytest.raises((errors.WrongDevice, errors.BadReading)):
        thermometer(name).open()


@pytest.mark.parametrize("name", ["mcp9808", "tmp117", "lm75", "bme280"])
def test_0xffff_is_a_line_that_nobody_drives(bus, name):
    address, chip, _ = CHIPS[name]
    bus.chips[address] = chip()
    with thermometer(name) as device:
        bus.chips[address].registers.update(dict.fromkeys((0, 5), b"\xff\xff"))
        bus.chips[address].registers.update({0xF7 + k: b"\xff" for k in range(8)})
        if name in ("tmp117", "bme280"):
            state = {0x01: b"\x20\x00"} if name == "tmp117" else {}
            bus.chips[address].on_write = lambda chip, r, d: chip.registers.update(state)
        with pytest.raises(errors.BadReading, match="0xFFFF"):
            device.read()


@pytest.mark.parametrize("name", CHIPS)
def test_an_address_that_the_chip_cannot_have(name):
    with pytest.raises(errors.ConfigurationError, match="0x"):
        thermometer(name, address=0x50)


# MCP9808, DS25095A: flags in bits 15–13, sign in bit 12
@pytest.mark.parametrize(
    ("raw", "value"),
    [(0x0194, 25.25), (0xC194, 25.25), (0x1FFF, -0.0625), (0xFE70, -25.0), (0x1D80, -40.0)],
)
def test_mcp9808_sign_and_flags(bus, raw, value):
    bus.chips[0x18] = mcp9808(raw)
    with thermometer("mcp9808") as device:
        assert device.read().values == {"temperature": value}


def test_mcp9808_out_of_range(bus):
    bus.chips[0x18] = mcp9808(0x0FF0)  # 255 °C
    with (
        thermometer("mcp9808") as device,
        pytest.raises(errors.BadReading, match="255 °C is outside"),
    ):
        device.read()


def test_mcp9808_in_shut_down_is_woken_and_a_conversion_awaited(bus):
    bus.chips[0x18] = chip = mcp9808(configuration=0x0100)
    with thermometer("mcp9808") as device:
        assert chip.registers[1] == b"\x00\x00"
        assert device.clock.monotonic() >= 0.25


def test_mcp9808_that_stays_in_shut_down(bus):
    bus.chips[0x18] = mcp9808(configuration=0x0140)
    bus.chips[0x18].on_write = lambda *_: None
    with pytest.raises(errors.BadReading, match="shut-down"):
        thermometer("mcp9808").open()


# TMP117, SNOSD82D table 7-1
@pytest.mark.parametrize(
    ("raw", "value"),
    [(0x0001, 0.0078125), (0x0C80, 25.0), (0xF380, -25.0), (0x3200, 100.0), (0xE480, -55.0)],
)
def test_tmp117_table_of_the_data_sheet(bus, raw, value):
    bus.chips[0x48] = tmp117(raw)
    with thermometer("tmp117") as device:
        assert device.read().values == {"temperature": value}


def test_tmp117_that_never_converted(bus):
    bus.chips[0x48] = tmp117(0x8000)
    with thermometer("tmp117") as device, pytest.raises(errors.BadReading, match="0x8000"):
        device.read()


def test_tmp117_that_hangs(bus):
    bus.chips[0x48] = tmp117(ready=False)
    with thermometer("tmp117") as device, pytest.raises(errors.DeviceTimeout):
        device.read()


# LM75B rev. 6.1 table 10; TMP102 SBOS397H table 6-2 and 6-3
@pytest.mark.parametrize(
    ("chip", "raw", "value"),
    [
        ("lm75", 0x1900, 25.0),
        ("lm75", 0xE700, -25.0),
        ("lm75", 0x7D80, 125.5),
        ("lm75b", 0x7EC0, 126.75),
        ("lm75b", 0xE6E0, -25.125),
        ("tmp75", 0x1910, 25.0625),
        ("tmp102", 0x7FF0, 127.9375),
        ("tmp102", 0xE700, -25.0),
        ("tmp102", 0x0C81, 25.0),  # extended mode: bit 0 set, 13 bits
    ],
)
def test_lm75_family_words(bus, chip, raw, value):
    bus.chips[0x48] = lm75(raw)
    with thermometer("lm75", chip=chip) as device:
        assert device.read().values == {"temperature": value}


def test_lm75_with_bits_that_it_cannot_set(bus):
    bus.chips[0x48] = lm75(0x1910)
    with thermometer("lm75") as device, pytest.raises(errors.BadReading, match="0x1910 has bits"):
        device.read()


def test_lm75_in_shut_down_is_woken(bus):
    bus.chips[0x48] = chip = lm75(configuration=0x19)
    with thermometer("lm75") as device:
        chip.registers[1] = b"\x19"  # and again after a glitch on its supply
        before = device.clock.monotonic()
        device.read()
        assert chip.registers[1] == b"\x18"
        assert device.clock.monotonic() - before >= 0.3


def test_lm75_with_limits_of_another_chip(bus):
    bus.chips[0x48] = lm75()
    bus.chips[0x48].word(2, 0x4B37)
    with pytest.raises(errors.WrongDevice, match="hysteresis reads 0x4b37"):
        thermometer("lm75").open()


@pytest.mark.parametrize(
    ("chip", "raw", "value"), [("lm75", 0x1920, 25.125), ("lm75", 0x1960, 25.375)]
)
def test_lm75a_and_b_under_lm75(bus, chip, raw, value):
    bus.chips[0x48] = lm75(raw)
    with thermometer("lm75", chip=chip) as device:
        assert device.read().values == {"temperature": value}


POWER_UP = [
    ("mcp9808", {}, 0x18, mcp9808, 5, 0x0000, 0x0010),
    ("mcp9808", {}, 0x18, mcp9808, 5, 0xC000, 0xC010),
    *(
        ("lm75", {"chip": name}, 0x48, lm75, 0, 0x0000, 0x0100)
        for name in ("lm75", "lm75b", "tmp75", "tmp102")
    ),
]


@pytest.mark.parametrize("case", POWER_UP)
def test_the_power_up_register_is_not_zero_degrees(bus, case):
    name, options, address, chip, register, zero, one = case
    bus.chips[address] = chip(zero)
    with thermometer(name, **options) as device:
        with pytest.raises(errors.BadReading, match="0 °C is its power-up value"):
            device.read()
        bus.chips[address].word(register, one)  # 1 °C, then 0 °C: a cold night
        assert device.read().values == {"temperature": 1.0}
        bus.chips[address].word(register, zero)
        assert device.read().values == {"temperature": 0.0}
        device.clock.advance(61.0)
        with pytest.raises(errors.BadReading, match="power-up"):
            device.read()


def test_a_chip_that_has_just_been_powered_is_read_again(bus):
    bus.chips[0x18] = chip = mcp9808(0x0000)
    reads = []

    def convert(self, register):
        reads.append(register)
        if reads.count(5) == 2:
            self.word(5, 0xC190)

    chip.on_read = convert
    with thermometer("mcp9808") as device:
        assert device.read().values == {"temperature": 25.0}
        assert device.clock.monotonic() >= 0.25


def test_sht3x_crc_of_the_data_sheet():
    assert crc8(b"\xbe\xef") == 0x92


@pytest.mark.parametrize("raw", [0x0000, 0xFFFE])
def test_sht3x_ends_of_the_scale(bus, raw):
    bus.chips[0x44] = sht3x(raw)
    with thermometer("sht3x") as device, pytest.raises(errors.BadReading, match="outside"):
        device.read()


def test_sht3x_crc_error(bus):
    bus.chips[0x44] = sht3x()
    with thermometer("sht3x") as device:
        bus.chips[0x44] = sht3x(damage=0x10)
        with pytest.raises(errors.BadReading, match="CRC"):
            device.read()


def test_sht3x_humidity_is_metadata(bus):
    bus.chips[0x44] = sht3x(humidity=0x8000)
    with thermometer("sht3x") as device:
        assert device.read().metadata["humidity_percent"] == pytest.approx(50.0, abs=0.01)


def test_bme280_compensation_of_the_data_sheet():
    table = Compensation.from_registers(CALIBRATION, HUMIDITY)
    fine = table.fine(ADC_T)
    assert round(fine) == 128422
    assert round(fine / 5120.0, 2) == 25.08
    assert table.pressure(ADC_P, fine) == pytest.approx(100653.27, abs=0.3)


def test_bme280_calibration_bytes():
    # 0xE4 = 0x14, 0xE5 = 0x53, 0xE6 = 0x03: H4 = 0x143, H5 = 0x035
    assert Compensation.from_registers(CALIBRATION, HUMIDITY).h == (75, 361, 0, 0x143, 0x035, 30)


def test_bme280_humidity_agrees_with_the_integer_formula():
    """The data sheet's 32-bit integer formula (4.2.3), an independent form of the same law."""
    table = Compensation.from_registers(CALIBRATION, HUMIDITY)
    fine = table.fine(ADC_T)
    h1, h2, h3, h4, h5, h6 = table.h
    for adc in (22000, 26000, 30000, 34000):
        v = round(fine) - 76800
        v = ((((adc << 14) - (h4 << 20) - (h5 * v)) + 16384) >> 15) * (
            (((((v * h6) >> 10) * (((v * h3) >> 11) + 32768)) >> 10) + 2097152) * h2 + 8192 >> 14
        )
        v -= ((((v >> 15) * (v >> 15)) >> 7) * h1) >> 4
        integer = min(max(v, 0), 419430400) / 4096 / 1024
        assert table.humidity(adc, fine) == pytest.approx(integer, abs=0.02)


def test_bme280_that_is_a_bmp280(bus):
    bus.chips[0x76] = bme280(identity=0x58)
    with pytest.raises(errors.WrongDevice, match="0x0058"):
        thermometer("bme280").open()


def test_bme280_not_measured(bus):
    bus.chips[0x76] = bme280(adc_t=0x80000)
    with thermometer("bme280") as device, pytest.raises(errors.BadReading, match="0x80000"):
        device.read()


def test_bme280_that_hangs(bus):
    bus.chips[0x76] = bme280(status=0x08)
    with thermometer("bme280") as device, pytest.raises(errors.DeviceTimeout):
        device.read()
