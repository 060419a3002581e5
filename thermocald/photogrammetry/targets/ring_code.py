"""Ring codes of 12 and 14 bit: circular coded targets as AICON, Metashape, and others print them.

A target is a disc of radius 1 and a concentric ring between radius 2 and 3 that is cut into N equal
segments. A segment in the disc's colour is a 1, one in the background's colour a 0. Read clockwise
(as seen by the viewer), the most significant bit first, every starting segment gives another
number: the code is the smallest of them. Of all N-bit numbers those are codes that have an even
number of ones, at least one pair of opposite segments that are both ones, and a gap; that leaves
147 codes of 12 bit and 516 of 14 bit. `number` in this module and in a test field's code
(`RING12:<code>`, `RING14:<code>`) is the code itself, not its place in somebody's list; the lists
that programs print are in increasing order of the code.

Source: Schneider, C. T. (1991): 3-D Vermessung von Oberflächen und Bauteilen durch Photogrammetrie
und Bildverarbeitung, IDENT/VISION '91; rule and geometry as the expired patent DE 197 33 466 A1,
read by M. Petroff, "Photogrammetry targets" (2018), who compared them with Scanreference's targets.
"""

from __future__ import annotations

from functools import cache

from thermocald.errors import TestFieldError

__all__ = [
    "BITS",
    "RING_INNER",
    "RING_OUTER",
    "codes",
    "is_ring",
    "parse",
    "segments",
    "smallest_rotation",
    "write",
]

BITS = (12, 14)
RING_INNER = 2.0
"""Inner radius of the ring, in radii of the disc."""
RING_OUTER = 3.0
"""Outer radius of the ring, in radii of the disc; outside, as much again must be background."""


def smallest_rotation(number: int, bits: int) -> int:
    """The smallest among the cyclic rotations of a number of so many bits."""
    mask = (1 << bits) - 1
    return min(((number << k) & mask) | (number >> (bits - k)) for k in range(bits))


@cache
def codes(bits: int) -> tuple[int, ...]:
    """All codes of so many bits (12 or 14), increasing; ValueError for other numbers of bits."""
    if bits not in BITS:
        raise ValueError(f"ring codes have {' or '.join(map(str, BITS))} bits, not {bits}")
    half = bits // 2
    return tuple(
        number
        for number in range(1, 1 << (bits - 1), 2)  # begins with a 0: the closed ring is not a code
        if number.bit_count() % 2 == 0
        and number & (number >> half) & ((1 << half) - 1)
        and number == smallest_rotation(number, bits)
    )


@cache
def _code_set(bits: int) -> frozenset[int]:
    return frozenset(codes(bits))


def is_ring(code: str) -> bool:
    """Whether a test field's code names a ring code."""
    return code.startswith("RING")


def parse(code: str) -> tuple[int, int]:
    """`RING12:47` → (12, 47); TestFieldError where no such code exists."""
    family, _, number = code.partition(":")
    bits = {f"RING{n}": n for n in BITS}.get(family)
    if bits is None or not number.isascii() or not number.isdigit():
        raise TestFieldError(
            f"{code!r} is not a ring code: write RING12:<code> or RING14:<code>, such as RING12:"
            f"{codes(12)[0]}"
        )
    value = int(number)
    if value not in _code_set(bits):
        raise TestFieldError(
            f"{code!r}: there is no {bits}-bit ring code {value}; a code is the smallest number "
            "among its rotations, has an even number of ones, and a pair of opposite ones"
        )
    return bits, value


def write(bits: int, number: int) -> str:
    """The inverse of `parse`."""
    return f"RING{bits}:{number}"


def segments(bits: int, number: int) -> tuple[tuple[float, float], ...]:
    """The arcs of a code as (begin, end) in turns, clockwise from +x as the viewer sees the target.

    Neighbouring ones are one arc; an arc may end beyond 1.0. Drawn with y down, the angle 2π·turns
    goes from x to y; with y up, negate it.
    """
    ones = [bool(number >> (bits - 1 - i) & 1) for i in range(bits)]
    arcs = []
    for begin in (i for i in range(bits) if ones[i] and not ones[i - 1]):
        end = begin
        while ones[end % bits]:
            end += 1
        arcs.append((begin / bits, end / bits))
    return tuple(arcs)
