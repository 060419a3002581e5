"""LED and relay on gpiozero's mock pins: the pin's state is read below the driver."""

from __future__ import annotations

import time

import pytest

from thermocald.errors import DeviceDenied, DeviceTimeout, PermanentDeviceError
from thermocald.hal import VirtualClock

DRIVER = ("output", "relay")
PROGRAMME = [{"seconds": s, "hold_c": c} for s, c in ((100, None), (1000, 45.0), (100, None))]
LONG = [{"seconds": 5000, "hold_c": 45.0}]


@pytest.fixture
def relay(bench):
    def make(**options):
        return bench.device(**{"programme": PROGRAMME, "hysteresis_k": 1.0, **options})

    bench.clock = VirtualClock()
    return make


@pytest.fixture
def pin(bench):
    return bench.fake.pin(27)


def await_state(pin, states):
    """Wait until the pin has had all states."""
    seen, deadline = set(), time.monotonic() + 2.0
    while not seen >= states and time.monotonic() < deadline:
        seen.add(bool(pin.state))
    assert seen >= states


@pytest.mark.parametrize("driver", [("output", "led")])
def test_the_led_tells_whether_there_are_results(bench):
    with bench.device(blink_s=0.05) as led:
        pin = bench.fake.pin(17)
        for good in ("ok", "resected"):  # regression: it blinked at a gauge's results
            led.emit({"status": good})
            assert pin.state
            led.emit({"status": "too few targets"})
            await_state(pin, {True, False})
    assert not pin.state


LIMIT = "60.00 °C reached the limit 60 °C"
# (options, [(s, °C, whether the lamp is on after it)])
HEATED = {
    # off above the hysteresis, on below it; off before and after the programme
    "the programme": ({}, [(10, 20.0, 0), (110, 20.0, 1), (200, 44.9, 1), (300, 45.5, 0),
                           (310, 45.0, 0), (320, 44.5, 1), (1150, 20.0, 0), (5000, 20.0, 0)]),
    "the limit is for good": ({}, [(200, 20.0, 1), (200, 60.0, LIMIT), (200, 20.0, 0)]),
    "no number": ({}, [(200, None, 0), (201, float("nan"), 0), (202, "hot", 0)]),
    "no temperature for long": ({"unknown_s": 30}, [(200, 20.0, 1), (210, None, 1),
                                                    (231, None, 0)]),
    "a board that switches at low": ({"active_high": False}, [(200, 20.0, 0)]),
}  # fmt: skip


@pytest.mark.parametrize("case", HEATED)
def test_when_the_lamp_is_on(relay, pin, case):
    options, steps = HEATED[case]
    off = options.get("active_high") is False
    with relay(**options) as lamp:
        assert pin.state == off
        with pytest.raises(DeviceDenied, match="in use"):
            relay().open()
        for seconds, temperature, expected in steps:
            lamp.clock.sleep_until(seconds)
            if isinstance(expected, str):
                with pytest.raises(PermanentDeviceError, match=expected):
                    lamp.emit({"temperature": temperature})
                expected = 0
            else:
                lamp.emit({"temperature": temperature})
            assert bool(pin.state) == bool(expected), seconds
    assert pin.state == off  # closed


def test_no_result_for_long_stops_the_lamp(relay, pin):
    with relay(watchdog_s=0.1) as lamp:
        lamp.clock.sleep_until(200)
        for _ in range(2):  # it heats again with the next result
            lamp.emit({"temperature": 20.0})
            assert pin.state
            await_state(pin, {False})


def test_opening_again_neither_restarts_the_programme_nor_resets_the_limit(relay, pin, monkeypatch):
    lamp = relay()
    for seconds, heating in ((200, 1), (1150, 0)):  # the programme ends at 1100
        with lamp:
            lamp.clock.sleep_until(seconds)
            lamp.emit({"temperature": 20.0})
            assert pin.state == heating

    def fail(heat: bool) -> None:
        raise DeviceTimeout("no answer")

    lamp = relay(programme=LONG)
    with monkeypatch.context() as broken, lamp:
        broken.setattr(lamp, "switch", fail)
        with pytest.raises(DeviceTimeout):
            lamp.emit({"temperature": 60.0})
    with lamp, pytest.raises(PermanentDeviceError, match="reached the limit"):
        lamp.emit({"temperature": 20.0})


def test_a_channel_that_no_result_has_is_a_warning(relay, pin):
    """Regression: spelt wrongly, the lamp stayed off and nothing said so."""
    with relay(channel="housng", programme=LONG) as lamp:
        for _ in range(20):
            assert lamp.warnings() == []
            lamp.emit({"housing": 20.0})
        assert lamp.warnings() == ["housng is unknown in the last 20 results; it does not heat"]
        assert not pin.state
