"""Time stamps while the machine's UTC is stepped; glitches are in daemon/test_clock."""

from __future__ import annotations

import pytest

from thermocald.acquisition.steady_clock import SteadyClock
from thermocald.hal import VirtualClock


def watch(clock: SteadyClock, machine: VirtualClock, seconds: float, each: float = 0.25):
    """Look at the clock four times a second, as the daemon; return its steps (s, followed)."""
    steps = []
    for _ in range(int(seconds / each)):
        machine.sleep_until(machine.monotonic() + each)
        if (step := clock.check()) is not None:
            steps.append((round(step[0]), step[1]))
    return steps


@pytest.mark.parametrize("seconds", [7200.0, -7200.0, 5.0])
def test_a_time_that_stands_is_followed_in_both_directions(seconds):
    machine = VirtualClock(utc=1.75e9)
    clock = SteadyClock(machine, synchronised=lambda: True)
    assert clock.settled()
    machine.offset += seconds
    assert watch(clock, machine, 59.0) == [(seconds, False)]
    assert clock.utc() == 1.75e9 + 59.0
    assert not clock.trusted()
    assert watch(clock, machine, 3.0) == [(seconds, True)]
    assert clock.utc() == 1.75e9 + 62.0 + seconds
    assert clock.trusted()
    # ages are not judged for a day after a leap
    assert clock.settled() is (abs(seconds) < 3600.0)
    watch(clock, machine, 86400.0, each=10.0)
    assert clock.settled()


@pytest.mark.parametrize("start", [0.0, 1.74e9])  # no battery at all, or the time it was shut down
def test_a_pi_that_learns_the_time_after_boot_follows_at_once(start):
    known = []
    machine = VirtualClock(utc=start)
    clock = SteadyClock(machine, synchronised=lambda: bool(known))
    assert not clock.trusted()
    machine.offset += 1.75e9 - start
    known.append(True)
    assert watch(clock, machine, 1.0) == [(1.75e9 - start, True)]
    assert clock.utc() == 1.75e9 + 1.0
    assert clock.trusted()


def test_a_thread_that_had_to_wait_between_two_clocks_moves_no_time_stamp():
    """74 ms between UTC and monotonic time were in every time stamp of a daemon."""

    class Busy(VirtualClock):
        waits = 3

        def utc(self):
            now = super().utc()
            if self.waits:
                self.waits -= 1
                self.sleep_until(self.monotonic() + 0.074)
            return now

    machine = Busy(utc=1.75e9)
    clock = SteadyClock(machine, synchronised=lambda: True)
    assert clock.utc() == pytest.approx(1.75e9 + machine.monotonic(), abs=1e-6)
