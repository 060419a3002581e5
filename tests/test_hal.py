"""The hardware abstraction layer: its data, clocks and entry points."""

from __future__ import annotations

import inspect
import threading
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from thermocald import errors, hal
from thermocald.errors import BadReading, ConfigurationError, DriverMissing, ThermocaldError
from thermocald.hal import Frame, Reading, SystemClock, VirtualClock, load_driver

IMAGE = np.zeros((4, 5), dtype=np.uint8)


def test_a_frame_cannot_be_changed_and_holds_something():
    frame = Frame(IMAGE.copy(), 1.0, 2.0)
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 1
    with pytest.raises(ValueError, match="needs an image"):
        Frame(None, 1.0, 2.0)
    assert Frame(None, 1.0, 2.0, encoded=b"\xff\xd8").image is None
    assert Frame(None, 1.0, 2.0, observations={}).image is None


@pytest.mark.parametrize("value", ["21.5", None, np.nan, np.inf, 1e300, -400.0, [21.0], np.ones(2)])
def test_what_is_no_temperature_is_no_reading(value):
    """A text as a temperature ended the daemon with a traceback."""
    with pytest.raises(BadReading, match="is not a temperature"):
        Reading({"temperature": value}, 1.0, 2.0)
    reading = Reading({"lens": np.float32(21.5), "air": value}, 1.0, 2.0)
    assert reading.values == {"lens": 21.5}
    assert "is not a temperature" in reading.missing["air"]


@pytest.mark.parametrize("wrong", ["12", None, np.nan, np.inf])
def test_times_and_settings_of_a_driver_are_numbers(wrong):
    for make in (
        lambda: Reading({"temperature": 20.0}, wrong, 2.0),
        lambda: Reading({"temperature": 20.0}, 1.0, wrong),
        lambda: Reading({}, 1.0, 2.0),
        lambda: Frame(IMAGE, wrong, 2.0),
        lambda: Frame(IMAGE, 1.0, wrong),
        lambda: Frame(None, 1.0, 2.0, encoded="text"),
        lambda: Frame(IMAGE, 1.0, 2.0, settings={"focus": wrong}),
    ):
        with pytest.raises(BadReading, match="its driver gives"):
            make()


@pytest.mark.parametrize("utc", [1.7e12, 1e300, -1e11])
def test_a_time_in_ms_is_no_utc(utc):
    """It was stored as the year 55841, or the epoch as an error of the program."""
    with pytest.raises(BadReading, match="as utc"):
        Frame(IMAGE, 1.0, utc)
    with pytest.raises(BadReading, match="as utc"):
        Reading({"temperature": 20.0}, 1.0, utc)


@pytest.mark.parametrize("image", [
    IMAGE[:0], IMAGE[:, :0], IMAGE[0], np.dstack([IMAGE] * 3), IMAGE / 2.0, [[0, 1]],
])  # fmt: skip
def test_what_is_no_grey_image_is_no_frame(image):
    """With `keep: all`, an empty one lost the epoch."""
    with pytest.raises(BadReading, match="its driver gives an image of"):
        Frame(image, 1.0, 2.0)


def test_clocks_are_read_at_the_middle_of_an_attempt():
    first = iter([10.0, 10.00004])
    both = hal.read_together(lambda: next(first), lambda: 5.0)
    assert both == pytest.approx((10.00002, 5.0), abs=1e-9, rel=0.0)


@pytest.mark.parametrize("clock", [VirtualClock(), SystemClock()], ids=["virtual", "system"])
def test_clocks_keep_one_contract(clock):
    assert isinstance(clock, hal.Clock)
    begin, utc = clock.monotonic(), clock.utc()
    assert clock.sleep_until(begin + 0.02)
    assert clock.monotonic() >= begin + 0.02
    assert clock.utc() - utc == pytest.approx(clock.monotonic() - begin, abs=0.01)
    assert clock.sleep_until(begin)  # a time in the past needs no waiting, and time never goes back
    assert clock.monotonic() >= begin + 0.02
    wake = threading.Event()
    wake.set()
    assert not clock.sleep_until(clock.monotonic() + 60.0, wake)


def test_a_driver_is_looked_up_among_what_there_is(monkeypatch):
    for kind in ("camera", "thermometer", "output"):
        assert load_driver(kind, "mock").__name__.startswith("Mock")
        with pytest.raises(ConfigurationError, match=f"no {kind} driver 'none'; .*are: .*mock"):
            load_driver(kind, "none")
    for place, why in (
        ("no_such_module:Lost", "cannot be imported: ModuleNotFoundError: "),
        ("mock:Lost", "cannot be imported: AttributeError: "),  # `devices` ended by it
        ("mock:MockThermometer", "is no class derived from thermocald.hal.Camera"),
    ):
        point = EntryPoint("lost", f"thermocald_drivers.{place}", "thermocald.cameras")
        monkeypatch.setattr(hal, "entry_points", lambda group, point=point: [point])
        with pytest.raises(DriverMissing, match=f"^camera driver 'lost' {why}"):
            load_driver("camera", "lost")


def test_a_devices_name_cannot_leave_its_comment():
    found = hal.Found({"serial": "x"}, "Cam\n- {driver: evil}\x1b[31m °")
    assert found.about == "Cam?- {driver: evil}?[31m °"


def test_errors_are_one_tree_as_it_is_drawn():
    tree = [c for _, c in inspect.getmembers(errors, inspect.isclass)]
    assert all(f" {leaf.__name__}" in errors.__doc__ for leaf in tree)
    assert all(issubclass(leaf, ThermocaldError) for leaf in tree)
    devices = {leaf for leaf in tree if issubclass(leaf, errors.DeviceError)} - {errors.DeviceError}
    transient, permanent = errors.TransientDeviceError, errors.PermanentDeviceError
    assert all(issubclass(leaf, transient) != issubclass(leaf, permanent) for leaf in devices)
