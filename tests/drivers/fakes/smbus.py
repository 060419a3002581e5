"""An SMBus adapter with chips, in place of the kernel's, below smbus2's interface."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


def os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


@dataclass
class Chip:
    """Registers by number (bytes in the order on the wire), and the effect of a write."""

    registers: dict[int, bytes] = field(default_factory=dict)
    on_write: Callable[[Chip, int, bytes], None] | None = None
    reply: bytes = b""

    def word(self, register: int, value: int) -> None:
        self.registers[register] = value.to_bytes(2, "big")


class Bus:
    """Chips by address; opened as `smbus2.SMBus(number)`; open_error, error: of every call."""

    def __init__(self) -> None:
        self.chips: dict[int, Chip] = {}
        self.open_error = self.error = self.opened = 0

    def __call__(self, number: int) -> Bus:
        if self.open_error:
            raise os_error(self.open_error)
        self.opened += 1
        return self

    def close(self) -> None:
        self.opened -= 1

    def _chip(self, address: int) -> Chip:
        if self.error or address not in self.chips:
            raise os_error(self.error or errno.EREMOTEIO)
        return self.chips[address]

    def _read(self, address: int, register: int, count: int) -> bytes:
        chip = self._chip(address)
        data = b"".join(
            chip.registers.get(register + k, b"")
            for k in range(count)
            if k == 0 or len(chip.registers.get(register, b"")) == 1
        )
        return (data + b"\xff" * count)[:count]

    def _write(self, address: int, register: int, data: bytes) -> None:
        chip = self._chip(address)
        if chip.on_write:
            chip.on_write(chip, register, data)
        else:
            chip.registers[register] = data

    def read_byte_data(self, address: int, register: int) -> int:
        return self._read(address, register, 1)[0]

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        self._write(address, register, bytes([value]))

    def read_word_data(self, address: int, register: int) -> int:
        return int.from_bytes(self._read(address, register, 2), "little")

    def write_word_data(self, address: int, register: int, value: int) -> None:
        self._write(address, register, value.to_bytes(2, "little"))

    def read_i2c_block_data(self, address: int, register: int, count: int) -> list[int]:
        return list(self._read(address, register, count))

    def write_i2c_block_data(self, address: int, register: int, data: list[int]) -> None:
        self._write(address, register, bytes(data))

    def i2c_rdwr(self, message) -> None:
        chip = self._chip(message.addr)
        for k in range(message.len):
            message.buf[k] = chip.reply[k : k + 1] or b"\xff"
