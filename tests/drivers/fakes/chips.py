"""Chips for the fake SMBus adapter, with the registers of their data sheets."""

from __future__ import annotations

import errno
import struct

from thermocald_drivers.i2c import crc8

from tests.drivers.fakes.smbus import Chip, os_error


def mcp9808(raw=0xC190, configuration=0x0000):
    chip = Chip()
    for register, value in ((1, configuration), (5, raw), (6, 0x0054), (7, 0x0400)):
        chip.word(register, value)
    return chip


def tmp117(raw=0x0C80, ready=True):
    chip = Chip()
    chip.word(0x0F, 0x0117)
    chip.word(0x01, 0x0220)
    chip.word(0x00, 0x8000)

    def convert(self, register, data):
        self.word(0x01, int.from_bytes(data, "big") | (0x2000 if ready else 0))
        self.word(0x00, raw)

    chip.on_write = convert
    return chip


def lm75(raw=0x1900, configuration=b"\x00\xa0"):
    chip = Chip({1: configuration})
    for register, value in ((0, raw), (2, 0x4B00), (3, 0x5000)):
        chip.word(register, value)
    return chip


def sht3x(temperature=0x6666, damage=0, periodic=False):
    chip = Chip()

    def words(*values):
        data = b"".join(v.to_bytes(2, "big") + bytes([crc8(v.to_bytes(2, "big"))]) for v in values)
        return bytes([data[0] ^ damage]) + data[1:]

    def answer(self, register, data):
        nonlocal periodic
        command = register << 8 | data[0]
        periodic &= command != 0x3093  # SHT3x-DIS v6, 4.8: break; 4.9: any other when idle
        if periodic:
            raise os_error(errno.EREMOTEIO)
        if command == 0x3780:
            self.reply = words(0x0BAD, 0xCAFE)
        elif command == 0x2400:
            self.reply = words(temperature, 0x8000)

    chip.on_write = answer
    return chip


# Calibration and raw values of the worked example of the BMP280 data sheet (BST-BMP280-DS001, 3.12)
# of the temperature: dig_T1 … dig_T3
CALIBRATION = struct.pack("<Hhh", 27504, 26435, -1000)
ADC_T, ADC_P, ADC_H = 519888, 415148, 30000


def bme280(adc_t=ADC_T, adc_h=ADC_H, identity=0x60, status=0):
    def block(first, data):
        chip.registers.update({first + k: bytes([byte]) for k, byte in enumerate(data)})

    # the filter, of 16 readings, is as an earlier program left it
    chip = Chip({0xD0: bytes([identity]), 0xF3: bytes([status]), 0xF5: b"\x10"})
    block(0x88, CALIBRATION)
    block(0xF7, bytes(8))

    def measure(self, register, data):
        if (register, data) == (0xE0, b"\xb6"):
            self.registers[0xF5] = b"\x00"
        if register == 0xF4 and data[0] & 3:
            found = adc_t - 1000 * self.registers[0xF5][0]
            raw = (ADC_P << 4).to_bytes(3, "big") + (found << 4).to_bytes(3, "big")
            block(0xF7, raw + adc_h.to_bytes(2, "big"))

    chip.on_write = measure
    return chip


CHIPS = {
    "mcp9808": (0x18, mcp9808, 25.0),
    "tmp117": (0x48, tmp117, 25.0),
    "lm75": (0x48, lm75, 25.0),
    "sht3x": (0x44, sht3x, -45.0 + 175.0 * 0x6666 / 0xFFFF),
    "bme280": (0x76, bme280, 25.08),
}
