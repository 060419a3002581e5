"""The loop of a device: its rhythm, and faults that are retried, told once, or given up."""

from __future__ import annotations

import time
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import pytest

from thermocald.acquisition.device_loop import Link, OutputLoop, Schedule
from thermocald.errors import DeviceDenied, DeviceGone, DeviceNotFound, WrongDevice
from thermocald.hal import SystemClock, VirtualClock, open_device


def test_a_day_of_ticks_has_no_drift():
    clock = VirtualClock(monotonic=1234.567)
    schedule = Schedule(clock, 10.0, clock.monotonic())
    rng_s = [0.013 * (k % 500) for k in range(8640)]  # work of up to 6.5 s
    starts = []
    for work_s in rng_s:
        assert schedule.wait() is not None
        starts.append(clock.monotonic())
        clock.advance(work_s)
    assert starts == [1234.567 + 10.0 * k for k in range(8640)]
    assert schedule.stats() == {"ticks": 8640, "skipped": 0, "late_p99_s": 0.0}


def test_a_late_tick_is_skipped_and_counted_and_the_rhythm_stays():
    clock = VirtualClock()
    schedule = Schedule(clock, 10.0, clock.monotonic())
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
    late = Schedule(clock, 10.0, begin=0.0)  # a device that joins late has missed nothing
    assert (late.wait(), late.stats()["skipped"]) == (9, 0)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def link_of(clock):
    """faults → (thermometer, link, events)."""

    def make(*faults, period_s=10.0):
        events = []
        device = open_device("thermometer", "mock", {"faults": list(faults)}, clock)
        link = Link(
            "thermometer", "t", device, clock, period_s=period_s,
            on_event=lambda utc, kind, text: events.append(kind),
        )  # fmt: skip
        return device, link, events

    return make


def poll(clock, link, device, times: int) -> None:
    for _ in range(times):
        link.do(device.read)
        clock.advance(9.9)


def test_fast_ticks_back_off(clock, link_of):
    device, link, _ = link_of({"kind": "unplugged", "at_s": 0.0, "for_s": 60.0}, period_s=0.05)
    attempts = []
    device.open = lambda: attempts.append(clock.monotonic()) or _raise(DeviceGone("gone"))
    for _ in range(600):
        link.do(device.read)
        clock.advance(0.05)
    assert 10 < len(attempts) < 40  # not 600: the pauses grow to 2 s
    assert max(b - a for a, b in pairwise(attempts)) <= 2.1


def test_what_no_retry_mends_is_given_up_and_told(clock, link_of):
    device, link, events = link_of()
    device.warnings = lambda: ["focus: auto"]
    assert link.status(0.0, 60.0)["warnings"] == ["focus: auto"]
    assert not link.do(lambda: _raise(WrongDevice("another camera")))
    assert link.ended
    assert events == ["device_failed"]
    assert not link.do(device.read)


def test_an_output_that_is_denied_is_not_tried_again(clock):
    """A broker or a mail server may lock out who repeats a wrong password."""
    link = Link("output", "home", open_device("output", "mock", {}, clock), clock)
    link.device.open = lambda: _raise(DeviceDenied("wrong password"))
    assert not link.do(lambda: None)
    assert link.ended


def _raise(error):
    raise error


@pytest.mark.parametrize("error", [DeviceNotFound, DeviceDenied])
def test_a_device_that_is_not_there_at_boot_is_looked_for(clock, link_of, error):
    """Regression: one that udev had not handled yet, or a phone to be unlocked, was given up."""
    device, link, events = link_of()
    there = device.open
    missing = [True] * 3

    def open_late():
        if missing:
            missing.pop()
            raise error("no such device")
        there()

    device.open = open_late
    poll(clock, link, device, 10)
    assert link.state == "open"
    assert events == ["device_out", "device_back"]


def test_whatever_a_driver_raises_it_is_retried_and_logged_once(clock, link_of, caplog):
    """A `close` that failed, or a driver's sys.exit(), ended the device's thread for good."""
    device, link, events = link_of()

    def fail(*_):
        raise failures[0]

    failures = [SystemExit(3), KeyError("x")]

    device.close = device.warnings = device.identity = fail
    while failures:
        for _ in range(5):
            assert not link.do(fail)
            assert link.identity() == {}
            assert link.status(0.0, 60.0)["warnings"] == []
            clock.advance(60.0)
        failures.pop(0)
    failures.append(OSError("x"))
    assert link.do(device.read)
    link.close()
    assert events == ["device_out", "device_back"]
    assert caplog.text.count("Traceback") == 4  # one of each method, and one of the action


def test_a_device_that_comes_and_goes_all_day_is_not_reported_each_time(clock, link_of, caplog):
    device, link, events = link_of({"kind": "unplugged", "at_s": 50_000.0, "for_s": 5_000.0})
    caplog.set_level("INFO")
    for k in range(4000):
        link.do(device.read if k % 2 else partial(_raise, DeviceGone("gone")))
        clock.advance(10.0)
    assert link.faults == 2000
    assert len(events) == 19
    assert "10 times within an hour" in caplog.text
    poll(clock, link, device, 3000)  # calm, then out for good
    assert events[19:] == ["device_out", "device_back"]


@pytest.mark.parametrize("back", [True, False])
def test_the_last_400_results_wait_for_an_output_that_is_away(back):
    """What is still waiting when the daemon stops is lost, and does not delay it."""
    away, got = [True], []

    def emit(result):
        if away:
            raise DeviceGone("away")
        got.append(result["epoch"])

    output = SimpleNamespace(open=lambda: None, close=lambda: None, emit=emit)
    loop = OutputLoop("log", output, SystemClock(), lambda *_: None)
    loop.start()
    for epoch in range(1000):
        loop.put({"epoch": epoch})
    end = time.monotonic() + 20.0
    if back:
        away.clear()
        while 999 not in got and time.monotonic() < end:
            time.sleep(0.02)
    assert loop.stop(5.0)
    assert got == (list(range(600, 1000)) if back else [])  # none of those before, out of order
    assert len(got) == loop.emitted
    assert loop.emitted + loop.lost == 1000
