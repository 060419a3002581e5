"""The rhythm, in virtual time, where every figure is exact."""

from __future__ import annotations

import threading

from thermocald.acquisition.device_loop import Schedule
from thermocald.hal import VirtualClock


def test_a_day_of_ticks_has_no_drift():
    clock = VirtualClock(monotonic=1234.567)
    schedule = Schedule(clock, 10.0)
    rng_s = [0.013 * (k % 500) for k in range(8640)]  # work of up to 6.5 s
    starts = []
    for work_s in rng_s:
        assert schedule.wait() is not None
        starts.append(clock.monotonic())
        clock.advance(work_s)
    assert starts == [1234.567 + 10.0 * k for k in range(8640)]
    assert schedule.stats() == {
        "ticks": 8640, "skipped": 0, "late_p99_s": 0.0, "late_max_s": 0.0
    }  # fmt: skip


def test_a_late_tick_is_skipped_and_counted_and_the_rhythm_stays():
    clock = VirtualClock()
    schedule = Schedule(clock, 10.0)
    indices, skipped = [], []
    for work_s in (1.0, 27.0, 1.0, 10.5, 1.0, 11.5):
        indices.append(schedule.wait())
        skipped.append(schedule.stats()["skipped"])
        clock.advance(work_s)
    # 27 s of work end 7 s after the next tick was due; 10.5 s are within the tolerance of a tenth
    assert indices == [0, 1, 4, 5, 6, 7]
    assert skipped == [0, 0, 2, 2, 2, 2]
    assert schedule.wait() == 9
    assert schedule.stats()["skipped"] == 3


def test_a_device_that_joins_late_has_missed_nothing():
    clock = VirtualClock(monotonic=105.0)
    schedule = Schedule(clock, 10.0, begin=0.0)
    assert schedule.wait() == 11
    assert schedule.due(11) == 110.0
    assert schedule.stats()["skipped"] == 0


def test_waking_ends_the_wait():
    wake = threading.Event()
    wake.set()
    assert Schedule(VirtualClock(), 10.0).wait(wake) is None
