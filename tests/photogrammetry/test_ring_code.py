"""Ring codes: the published rule, and what a test field may write."""

from __future__ import annotations

import pytest

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.targets import ring_code


def _rule(bits: int) -> list[int]:
    """The patent's rule on strings of segments, written without a look at the module."""
    kept = []
    for number in range(1 << bits):
        ring = format(number, f"0{bits}b")
        turned = [ring[i:] + ring[:i] for i in range(bits)]
        opposite = any(ring[i] == ring[(i + bits // 2) % bits] == "1" for i in range(bits))
        if ring == min(turned) and ring.count("1") % 2 == 0 and opposite and "0" in ring:
            kept.append(number)
    return kept


@pytest.mark.parametrize(("bits", "count"), [(12, 147), (14, 516)])
def test_codes_follow_the_published_rule(bits, count):
    codes = ring_code.codes(bits)
    assert len(codes) == count
    assert list(codes) == _rule(bits)
    with pytest.raises(ValueError, match="12 or 14"):
        ring_code.codes(13)


@pytest.mark.parametrize("bits", ring_code.BITS)
def test_segments_draw_the_code_from_wherever_one_begins(bits):
    for number in ring_code.codes(bits):
        drawn = 0
        for begin, end in ring_code.segments(bits, number):
            for k in range(round(begin * bits), round(end * bits)):
                drawn |= 1 << (bits - 1 - k % bits)
        assert ring_code.smallest_rotation(drawn, bits) == number


@pytest.mark.parametrize("code", ["RING12:1", "RING13:65", "RING12:", "RING12:x", "RING14:65.0"])
def test_what_is_no_code_is_said(code):
    with pytest.raises(TestFieldError, match="ring code"):
        ring_code.parse(code)
