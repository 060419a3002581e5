"""Functions shared by drivers."""

from __future__ import annotations

import time

import pytest
from thermocald_drivers import support

from thermocald.hal import SystemClock


class InterruptedClock(SystemClock):
    """A clock of a thread that is sometimes preempted between two readings."""

    def __init__(self, pauses):
        self.pauses = list(pauses)

    def utc(self):
        if self.pauses:
            time.sleep(self.pauses.pop())
        return super().utc()


@pytest.mark.parametrize("pauses", [[], [0.05], [0.05, 0.03, 0.02]])
def test_an_instant_on_the_clock_is_not_off_by_a_pause(pauses):
    begin, utc = time.monotonic(), time.time()
    monotonic, on_utc = support.on_clock(InterruptedClock(pauses), begin - 1.0)
    assert monotonic == pytest.approx(begin - 1.0, abs=0.002)
    assert on_utc == pytest.approx(utc - 1.0, abs=0.002)
