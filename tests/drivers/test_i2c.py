"""I2C thermometers against chips on a fake SMBus adapter, register by register."""

from __future__ import annotations

import pytest
from thermocald_drivers.i2c import Lm75Thermometer, crc8

from tests.drivers.fakes.chips import CHIPS, bme280, lm75, mcp9808, sht3x, tmp117
from thermocald import errors
from thermocald.hal import VirtualClock, open_device


def thermometer(name, **options):
    return open_device("thermometer", name, options, VirtualClock())


LOCKED, OTHER_LIMITS = mcp9808(configuration=0x0140), lm75()
LOCKED.on_write = lambda *_: None
OTHER_LIMITS.word(2, 0x4B37)
# a chip's word: °C, or the message; MCP9808 DS25095A: flags in bits 15–13, sign in 12;
# TMP117 SNOSD82D table 7-1; LM75B rev. 6.1 table 10; TMP102 SBOS397H tables 6-2 and 6-3
REFUSALS = errors.BadReading, errors.DeviceTimeout, errors.WrongDevice
HELD = [
    *((name, {}, chip(), pytest.approx(celsius, abs=0.005))
      for name, (_, chip, celsius) in CHIPS.items()),
    *(
        ("mcp9808", {}, mcp9808(raw), value)
        for raw, value in [(0x0194, 25.25), (0xC194, 25.25), (0x1FFF, -0.0625), (0xFE70, -25.0),
                           (0x1D80, -40.0), (0x0FF0, "255 °C is outside")]
    ),
    *(
        ("tmp117", {}, tmp117(raw), value)
        for raw, value in [(0x0001, 0.0078125), (0x0C80, 25.0), (0xF380, -25.0), (0x3200, 100.0),
                           (0xE480, -55.0), (0x8000, "-256 °C is outside")]
    ),
    ("tmp117", {}, tmp117(ready=False), "did not end"),
    *(
        ("lm75", {"chip": chip}, lm75(raw), value)
        for chip, raw, value in [
            ("lm75", 0x1900, 25.0), ("lm75", 0xE700, -25.0), ("lm75", 0x7D80, 125.5),
            ("lm75", 0x1920, 25.125), ("lm75", 0x1960, 25.375),  # an LM75A or LM75B
            ("lm75", 0x1910, "0x1910 has bits"), ("lm75b", 0x7EC0, 126.75),
            ("lm75b", 0xE6E0, -25.125), ("tmp75", 0x1910, 25.0625), ("tmp102", 0x7FF0, 127.9375),
            ("tmp102", 0xE700, -25.0), ("tmp102", 0x0C81, 25.0),  # extended: bit 0 set, 13 bits
        ]
    ),
    # a line that nobody drives
    *((name, {}, chip(0xFFFF), "0xFFFF") for name, chip in (
        ("mcp9808", mcp9808), ("tmp117", tmp117), ("lm75", lm75))),
    ("bme280", {}, bme280(adc_h=0xFFFF), "0xFFFF"),
    ("sht3x", {}, sht3x(periodic=True), pytest.approx(25.0, abs=0.005)),
    ("sht3x", {}, sht3x(0x0000), "outside"),
    ("sht3x", {}, sht3x(0xFFFE), "outside"),
    ("bme280", {}, bme280(adc_t=0x80000), "0x80000"),
    ("bme280", {}, bme280(status=0x08), "did not end"),
    # not used at all
    ("mcp9808", {}, LOCKED, "shut-down"), ("lm75", {}, OTHER_LIMITS, "hysteresis reads 0x4b37"),
    ("bme280", {}, bme280(identity=0x58), "0x0058"),  # a BMP280
    ("sht3x", {}, sht3x(damage=0x10), "CRC"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "options", "chip", "expected"), HELD)
def test_what_a_chip_holds_is_read_rightly_or_refused(bus, name, options, chip, expected):
    bus.chips[CHIPS[name][0]] = chip
    device = thermometer(name, **options)
    if isinstance(expected, str):
        with pytest.raises(REFUSALS, match=expected), device:
            device.read()
    else:
        with device:
            assert device.read().values == {"temperature": expected}


@pytest.mark.parametrize(
    ("chip", "before", "after"),
    [("lm75", b"\x19", b"\x18"),  # in shut-down
     ("tmp75", b"\x00", b"\x60"),  # SBOS288: 9 bits, as at power-up
     ("tmp102", b"\x60\x20", b"\x60\xe0"), ("tmp102", b"\x61\xa0", b"\x60\xe0")],  # 0.25 Hz
)  # fmt: skip
def test_a_mode_that_an_earlier_program_left_is_ended(bus, chip, before, after):
    bus.chips[0x48] = one = lm75(configuration=before)
    with thermometer("lm75", chip=chip) as device:
        one.registers[1] = before  # and again after a glitch on its supply
        begin = device.clock.monotonic()
        device.read()
        assert one.registers[1] == after
        assert device.clock.monotonic() - begin >= device.conversion_s >= 0.035


@pytest.mark.parametrize(
    ("name", "options", "chip", "zero", "one"),
    [
        ("mcp9808", {}, mcp9808, 0x0000, 0x0010),
        ("mcp9808", {}, mcp9808, 0xC000, 0xC010),
        *(("lm75", {"chip": kind}, lm75, 0x0000, 0x0100) for kind in Lm75Thermometer.VARIANTS),
    ],
)
def test_the_power_up_register_is_not_zero_degrees(bus, name, options, chip, zero, one):
    place = CHIPS[name][0]
    bus.chips[place] = chip(zero)
    with thermometer(name, **options) as device:
        for _ in range(2):
            with pytest.raises(errors.BadReading, match="0 °C is its power-up value"):
                device.read()
            for word, celsius in ((one, 1.0), (zero, 0.0)):  # a cold night
                bus.chips[place] = chip(word)
                assert device.read().values == {"temperature": celsius}
            device.clock.sleep_until(device.clock.monotonic() + 61.0)


def test_a_bme280_that_is_exchanged_between_two_readings_has_its_own_calibration(bus):
    bus.chips[0x76] = chip = bme280()
    with thermometer("bme280") as device:
        for k, byte in enumerate(bytes.fromhex("456f 6f68 3200")):  # dig_T1 … dig_T3
            chip.registers[0x88 + k] = bytes([byte])
        assert device.read().values == {"temperature": pytest.approx(20.440, abs=0.001)}


def test_a_chip_that_has_just_been_powered_is_read_again(bus, monkeypatch):
    bus.chips[0x18] = mcp9808(0x0000)
    with thermometer("mcp9808") as device:
        # its first conversion ends while the driver waits
        monkeypatch.setattr(device, "_wait", lambda _: bus.chips[0x18].word(5, 0xC190))
        assert device.read().values == {"temperature": 25.0}
    assert bus.chips[0x18].registers[8] == b"\x03"  # DS25095A 5.4: 0.0625 K


def test_the_crc_is_that_of_the_data_sheet():
    assert crc8(b"\xbe\xef") == 0x92
