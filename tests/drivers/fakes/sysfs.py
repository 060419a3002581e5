"""A sysfs tree in a temporary folder, written as the kernel lays it out."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class Sysfs:
    """A tree; `root` is the drivers' option `sysfs`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, path: str, content: str) -> Path:
        target = self.root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(content + "\n")
        return target

    def device(self, folder: str, **files: str) -> Path:
        for file, content in files.items():
            self.write(f"{folder}/{file}", content)
        return self.root / folder

    def hwmon(self, number: int, name: str, address: str = "", **files: str) -> Path:
        folder = self.device(f"class/hwmon/hwmon{number}", name=name, **files)
        if address:
            device = self.root / "devices" / address
            device.mkdir(parents=True, exist_ok=True)
            (folder / "device").symlink_to(device)
        return folder

    def iio(self, number: int, name: str, **files: str) -> Path:
        return self.device(f"bus/iio/devices/iio:device{number}", name=name, **files)

    def zone(self, number: int, kind: str, milli: str) -> Path:
        return self.device(f"class/thermal/thermal_zone{number}", type=kind, temp=milli)

    def w1(self, rom: str, content: str) -> Path:
        return self.write(f"bus/w1/devices/{rom}/w1_slave", content.rstrip("\n"))


def w1_slave(celsius: float) -> str:
    """Return w1_therm's text for a DS18B20 at 12 bits."""
    raw = round(celsius * 16)
    pad = raw.to_bytes(2, "little", signed=True) + bytes.fromhex("4b467fff")
    return scratchpad((pad + bytes([0x10 - (raw & 0x0F), 0x10])).hex(), int(raw * 1000 / 16))


def scratchpad(pad: str, milli: int) -> str:
    """Return w1_therm's text for 8 bytes; the CRC is not by the driver's code."""
    data = bytes.fromhex(pad)
    text = f"{data.hex(' ')} {w1_crc(data):02x}"
    return f"{text} : crc={w1_crc(data):02x} YES\n{text} t={milli}"


def w1_crc(data: bytes) -> int:
    """Return the 1-wire CRC, bit by bit, by other code than the driver's."""
    crc = 0
    for byte in data:
        for bit in range(8):
            mix = (crc ^ (byte >> bit)) & 1
            crc = (crc >> 1) ^ (0x8C if mix else 0)
    return crc
