"""The loop of a device: its rhythm, and faults that are retried, told once, or given up."""

from __future__ import annotations

import time
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import pytest

from thermocald.acquisition.device_loop import DeviceLoop, Link, OutputLoop, Schedule
from thermocald.errors import DeviceDenied, DeviceGone, DeviceNotFound, WrongDevice
from thermocald.hal import SystemClock, VirtualClock, open_device


def test_ticks_do_not_drift_and_a_late_one_is_skipped_and_counted():
    clock = VirtualClock(monotonic=1234.567)
    schedule = Schedule(clock, 10.0, clock.monotonic())
    ticks, skipped = [], []
    for work_s in (1.0, 27.0, 1.0, 10.5, 1.0, 11.5, 0.0):
        ticks.append((schedule.wait(), clock.monotonic()))
        skipped.append(schedule.stats()["skipped"])
        clock.sleep_until(clock.monotonic() + work_s)
    # 27 s of work end 7 s after the next tick was due; 10.5 s are within the tolerance of a tenth
    assert ticks == [(k, 1234.567 + 10.0 * k + 0.5 * (k == 6)) for k in (0, 1, 4, 5, 6, 7, 9)]
    assert skipped == [0, 0, 2, 2, 2, 2, 3]
    late = Schedule(clock, 10.0, begin=1234.567)  # a device that joins late has missed nothing
    assert (late.wait(), late.stats()["skipped"]) == (9, 0)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def link_of(clock):
    """device, fault → the link to a mock, with the events that it told."""

    def make(what="thermometer", period_s=10.0, **fault):
        device = open_device(what, "mock", {"faults": [fault] if fault else []}, clock)
        link = Link(what, "t", device, clock, period_s)
        link.events = []
        link.on_event = lambda utc, kind, text: link.events.append(kind)
        return link

    return make


def fail(error):
    raise error


def poll(link: Link, times: int, every_s: float) -> None:
    for _ in range(times):
        link.do(link.device.read)
        link.clock.sleep_until(link.clock.monotonic() + every_s)


def test_fast_ticks_back_off(clock, link_of):
    link = link_of(period_s=0.05, kind="unplugged", at_s=0.0, for_s=60.0)
    attempts = []
    link.device.open = lambda: attempts.append(clock.monotonic()) or fail(DeviceGone("gone"))
    poll(link, 600, 0.05)
    assert 10 < len(attempts) < 40  # not 600: the pauses grow to 2 s
    assert max(b - a for a, b in pairwise(attempts)) <= 2.1


def test_a_slow_logger_does_not_hang_within_its_time_out(clock, link_of):
    loop = DeviceLoop(link_of(), lambda: None, begin=0.0)
    loop.link.device.timeout_s, loop._busy_since = 300.0, clock.monotonic()
    for busy_s in (0.0, 100.0):
        clock.sleep_until(clock.monotonic() + 200.0)
        assert loop.busy_s() == busy_s


@pytest.mark.parametrize(
    ("kind", "error"),
    [("thermometer", WrongDevice),
     # a broker or a mail server may lock out who repeats a wrong password
     ("output", DeviceDenied)],
)  # fmt: skip
def test_what_no_retry_mends_is_given_up_and_told(link_of, kind, error):
    link = link_of(kind)
    link.device.warnings = lambda: ["focus: auto"]
    assert link.status(0.0, 60.0)["warnings"] == ["focus: auto"]
    assert not link.do(partial(fail, error("no")))
    assert not link.do(lambda: None)
    assert link.ended
    assert link.events == ["device_failed"]


@pytest.mark.parametrize("error", [DeviceNotFound, DeviceDenied])
def test_a_device_that_is_not_there_at_boot_is_looked_for(link_of, error):
    """Regression: one that udev had not handled yet, or a phone to be unlocked, was given up."""
    link = link_of()
    opens, missing = link.device.open, [True] * 3
    link.device.open = lambda: fail(error("not there")) if missing and missing.pop() else opens()
    poll(link, 10, 9.9)
    assert link.state == "open"
    assert link.events == ["device_out", "device_back"]


def test_whatever_a_driver_raises_it_is_retried_and_logged_once(clock, link_of, caplog):
    """A `close` that failed, or a driver's sys.exit(), ended the device's thread for good."""
    link = link_of()
    for error in (SystemExit(3), KeyError("x"), OSError("x")):
        fails = partial(fail, error)
        link.device.close = link.device.warnings = link.device.identity = fails
        for _ in range(5):
            assert not link.do(fails)
            assert link.identity() == {}
            assert link.status(0.0, 60.0)["warnings"] == []
            clock.sleep_until(clock.monotonic() + 60.0)
    assert link.do(link.device.read)
    link.close()
    assert link.events == ["device_out", "device_back"]
    assert caplog.text.count("Traceback") == 4  # one of each method, and one of the action


def test_a_device_that_comes_and_goes_all_day_is_not_reported_each_time(clock, link_of, caplog):
    link = link_of(kind="unplugged", at_s=50_000.0, for_s=5_000.0)
    for _ in range(2000):
        link.do(partial(fail, DeviceGone("gone")))
        clock.sleep_until(clock.monotonic() + 10.0)
        poll(link, 1, 10.0)
    assert link.faults == 2000
    assert len(link.events) == 19
    assert "10 times within an hour" in caplog.text
    poll(link, 3000, 9.9)  # calm, then out for long
    assert link.events[19:] == ["device_out", "device_back"]


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
