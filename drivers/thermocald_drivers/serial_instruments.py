"""Line protocols of serial thermometers: instruments by name, checksums, units.

Source: the instruments' manuals, named with each.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

__all__ = ["CHECKSUMS", "INSTRUMENTS", "NO_SENSOR_C", "UNITS", "Instrument"]

NUMBER = r"[-+]?\d+(?:\.\d+)?"
NO_SENSOR_C = (-127.0, -50.0, -46.85, -45.0, -40.0, 85.0, 125.0)
"""What firmware prints where its sensor does not answer, °C."""


@dataclass(frozen=True)
class Instrument:
    """A line protocol; `framing` is data bits, parity, stop bits."""

    pattern: str
    command: str = ""
    baud: int = 9600
    framing: str = "8N1"
    unit: str = "C"
    scale: float = 1.0
    offset: float = 0.0
    checksum: str = "none"
    timeout_s: float = 2.0
    range_c: tuple[float, float] = (-100.0, 300.0)
    refuse_c: tuple[float, ...] = ()


INSTRUMENTS = {
    # Papouch TM, TMU: sends by itself every 10 s, ends with CR alone.
    "papouch-tm": Instrument(r"(?P<temperature>[-+]\d{3}\.\d)C", timeout_s=22.0),
    # Vaisala HMP230/240/260 series, user's guides, appendix "Serial commands".
    "vaisala-hmp": Instrument(
        rf"(?:RH= *{NUMBER} *%RH +)?T= *(?P<temperature>{NUMBER}) *'C(?: .*)?",
        command="SEND\r",
        baud=4800,
        framing="7E1",
    ),
    # Lake Shore 218, user's manual 6.2: eight inputs in one line; kelvin keeps the sign simple.
    "lakeshore-218": Instrument(
        ",".join(rf"(?P<input{k}>[-+]\d+\.\d+)" for k in range(1, 9)),
        command="KRDG?\r\n",
        framing="7O1",
        unit="K",
    ),
    # Fluke 1522, user's guide 8.2.1; the unit is set at the instrument and must be C.
    "fluke-1522": Instrument(r"t: *(?P<temperature>[-+]?\d+\.\d+) C", command="read?\r", baud=2400),
}


def _xor(text: bytes) -> int:
    return functools.reduce(operator.xor, text, 0)


CHECKSUMS: Mapping[str, Callable[[bytes], int]] = {
    "none": len,  # not called
    "xor": _xor,
    "sum8": lambda text: sum(text) & 0xFF,
    "nmea": lambda text: _xor(text.strip(b"$*")),
}
UNITS: Mapping[str, Callable[[float], float]] = {
    "C": lambda value: value,
    "F": lambda value: (value - 32.0) / 1.8,
    "K": lambda value: value - 273.15,
}
