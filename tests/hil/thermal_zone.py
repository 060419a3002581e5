"""A thermal zone of the guest's firmware: an ACPI table that QEMU adds to its own.

    ThermalZone (\\_TZ.LAB0) { Method (_TMP) { Return (3102) }  Name (_CRT, 3782) }

Source: ACPI 6.4, 5.2.6 (header), 11.4 (thermal objects, tenths of a kelvin), 20.2 (byte code).
"""

from __future__ import annotations

import struct

CELSIUS = 37.0  # the kernel's value: 310.2 K − 273.2 K
NOW, CRITICAL = 3102, 3782


def table() -> bytes:
    """Return a secondary system description table (SSDT)."""
    method = _package(b"\x14", b"_TMP\x00\xa4" + _word(NOW))
    name = b"\x08_CRT" + _word(CRITICAL)
    code = _package(b"\x5b\x85", b"\\\x2e_TZ_LAB0" + method + name)
    head = struct.pack(
        "<4sIBB6s8sI4sI", b"SSDT", 36 + len(code), 2, 0, b"LAB   ", b"LABORATO", 1, b"LAB ", 1
    )
    whole = bytearray(head + code)
    whole[9] = -sum(whole) & 0xFF
    return bytes(whole)


def _word(value: int) -> bytes:
    return b"\x0b" + struct.pack("<H", value)


def _package(opcode: bytes, content: bytes) -> bytes:
    """Return a package with its length, which includes the length byte and is less than 64."""
    length = len(content) + 1
    assert length < 64
    return opcode + bytes([length]) + content
