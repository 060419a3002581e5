"""LED and relay on gpiozero's mock pins: the pin's state is read below the driver."""

from __future__ import annotations

import errno
import time

import gpiozero
import pytest
from gpiozero.pins.mock import MockFactory

from thermocald.errors import DeviceDenied, DeviceTimeout, PermanentDeviceError
from thermocald.hal import VirtualClock, open_device

PROGRAMME = [
    {"seconds": 100, "hold_c": None},
    {"seconds": 1000, "hold_c": 45.0},
    {"seconds": 100, "hold_c": None},
]


@pytest.fixture
def pins(monkeypatch):
    factory = MockFactory()
    monkeypatch.setattr(gpiozero.Device, "pin_factory", factory)
    yield factory
    factory.close()


@pytest.fixture
def clock():
    return VirtualClock()


def relay(clock, **options):
    options = {"pin": 27, "limit_c": 60, "programme": PROGRAMME, "hysteresis_k": 1.0, **options}
    return open_device("output", "relay", options, clock)


def test_the_led_tells_whether_there_are_results(pins):
    good = iter(("ok", "resected"))  # regression: it blinked at a gauge's results
    with open_device("output", "led", {"pin": 17, "blink_s": 0.05}, VirtualClock()) as led:
        pin = pins.pin(17)
        led.emit({"status": next(good)})
        assert pin.state
        led.emit({"status": "too few targets"})
        states = set()
        deadline = time.monotonic() + 2.0
        while len(states) < 2 and time.monotonic() < deadline:
            states.add(pin.state)
        assert states == {True, False}
        led.emit({"status": next(good)})
        assert pin.state
    assert not pins.pin(17).state


# (s, °C, whether the lamp is on after it)
HEATED = {
    # off above the hysteresis, on below it; off before and after the programme
    "the programme": ({}, [(10, 20.0, 0), (110, 20.0, 1), (200, 44.9, 1), (300, 45.5, 0),
                           (310, 45.0, 0), (320, 44.5, 1), (1150, 20.0, 0), (5000, 20.0, 0)]),
    "the limit is for good": ({}, [(200, 20.0, 1), (200, 60.0, "60.00 °C reached the limit 60 °C"),
                                   (200, 20.0, 0)]),
    "no temperature": ({}, [(200, None, 0)]),
    "not a number": ({}, [(200, float("nan"), 0)]),
    "a word": ({}, [(200, "hot", 0)]),
    "no temperature for long": ({"unknown_s": 30}, [(200, 20.0, 1), (210, None, 1),
                                                    (231, None, 0)]),
    "a board that switches at low": ({"active_high": False}, [(200, 20.0, 0)]),
}  # fmt: skip


@pytest.mark.parametrize("case", HEATED)
def test_when_the_lamp_is_on(pins, clock, case):
    options, steps = HEATED[case]
    pin, off = pins.pin(27), options.get("active_high") is False
    with relay(clock, **options) as lamp:
        assert pin.state == off
        for seconds, temperature, expected in steps:
            clock.sleep_until(seconds)
            if isinstance(expected, str):
                with pytest.raises(PermanentDeviceError, match=expected):
                    lamp.emit({"temperature": temperature})
                expected = 0
            else:
                lamp.emit({"temperature": temperature})
            assert bool(pin.state) == bool(expected), seconds
    assert pin.state == off  # closed


def test_no_result_for_long_stops_the_lamp(pins, clock):
    with relay(clock, watchdog_s=0.1) as lamp:
        clock.sleep_until(200)
        lamp.emit({"temperature": 20.0})
        assert pins.pin(27).state
        deadline = time.monotonic() + 2.0
        while pins.pin(27).state and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not pins.pin(27).state
        lamp.emit({"temperature": 20.0})  # and heats again with the next result
        assert pins.pin(27).state


def test_opening_again_neither_restarts_the_programme_nor_resets_the_limit(pins, clock):
    lamp, pin = relay(clock), pins.pin(27)
    for seconds, heating in ((200, 1), (1150, 0)):  # the programme ends at 1100
        with lamp:
            clock.sleep_until(seconds)
            lamp.emit({"temperature": 20.0})
            assert pin.state == heating
    lamp = relay(clock, programme=[{"seconds": 5000, "hold_c": 45.0}])
    switch = lamp.switch

    def fail(heat: bool) -> None:
        raise DeviceTimeout("no answer")

    lamp.switch = fail
    with lamp, pytest.raises(DeviceTimeout):
        lamp.emit({"temperature": 60.0})
    lamp.switch = switch
    with lamp, pytest.raises(PermanentDeviceError, match="reached the limit"):
        lamp.emit({"temperature": 20.0})


def test_a_channel_that_no_result_has_is_a_warning(pins, clock):
    """Regression: spelt wrongly, the lamp stayed off and nothing said so."""
    with relay(clock, channel="housng", programme=[{"seconds": 5000, "hold_c": 45.0}]) as lamp:
        for _ in range(20):
            assert lamp.warnings() == []
            lamp.emit({"housing": 20.0})
        assert lamp.warnings() == ["housng is unknown in the last 20 results; it does not heat"]
        assert not pins.pin(27).state


def test_a_pin_in_use(pins, clock):
    with relay(clock), pytest.raises(DeviceDenied, match="in use"):
        relay(clock).open()


def test_permission_denied(pins, monkeypatch, clock):
    """The kernel denies /dev/gpiochip0 to a user outside the group."""

    def refused(*_args):
        raise PermissionError(errno.EACCES, "Permission denied", "/dev/gpiochip0")

    monkeypatch.setattr(pins, "pin", refused)
    for device in (relay(clock), open_device("output", "led", {"pin": 17}, clock)):
        with pytest.raises(DeviceDenied, match=r"GPIO .*group gpio"):
            device.open()
