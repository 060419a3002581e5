"""What belongs to an epoch; what is put off and kept when calibration or the disk is slow."""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.acquisition.pipeline import Pipeline
from thermocald.acquisition.thermometers import Thermometers, pair_readings
from thermocald.config import parse_config
from thermocald.epoch import Epoch
from thermocald.hal import Frame, Reading, SystemClock, VirtualClock
from thermocald.photogrammetry.epoch.adjustment import failed


class SlowCalibrator:
    """Takes its time; a gate holds it up."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.testfield = None
        self.seen: list[int] = []

    def calibrate(self, epoch: Epoch, image=None, fingerprint=None) -> CalibratedEpoch:
        self.gate.wait(10.0)
        self.seen.append(epoch.number)
        if epoch.number == 666:
            raise RuntimeError("a bug")
        return CalibratedEpoch(epoch, failed("ok", ""), {})

    def reset(self) -> None:
        pass


class ListKeeper:
    """Keeps in lists, and gives back what was put off."""

    def __init__(self) -> None:
        self.kept: list[tuple[int, bool]] = []
        self.amended: list[int] = []
        self.pause_s = 0.0

    def keep(self, acquired) -> None:
        time.sleep(self.pause_s)
        self.kept.append((acquired.number, acquired.calibrated is not None))

    def observe(self, calibrated, in_order):
        return calibrated

    def lose(self, why) -> None:
        pass

    def amend(self, calibrated) -> None:
        self.amended.append(calibrated.epoch.number)

    def backlog(self, below: int):
        for number, calibrated in self.kept:
            if not calibrated and number not in self.amended:
                return Epoch(number, 0.0, 0.0)
        return None


@pytest.fixture
def pipeline():
    keeper, calibrator = ListKeeper(), SlowCalibrator()
    clock = SystemClock()
    none = Thermometers(SimpleNamespace(cameras=(), thermometers=()), clock)
    made = Pipeline("cam", calibrator, none, (), keeper, clock)
    made.start()
    yield made, keeper, calibrator
    calibrator.gate.set()
    assert made.stop(10.0)


def frame(side: int = 20) -> Frame:
    return Frame(np.zeros((side, side), dtype=np.uint8), time.monotonic(), time.time())


def until(condition) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_too_slow_it_drops_calibration_never_acquisition_and_catches_up(pipeline):
    made, keeper, calibrator = pipeline
    for _ in range(20):
        made.submit(frame())
        time.sleep(0.005)
    until(lambda: len(keeper.kept) == 17)  # three may wait
    assert keeper.kept == [(n, False) for n in range(1, 18)]
    calibrator.gate.set()
    until(lambda: len(keeper.amended) == 17)
    assert sorted(keeper.amended) == list(range(1, 18))
    assert keeper.kept[17:] == [(18, True), (19, True), (20, True)]
    assert (made.lost, made.dropped, made.caught_up) == (0, 17, 17)


def test_the_end_finishes_the_epoch_in_hand_and_keeps_the_others(pipeline):
    made, keeper, calibrator = pipeline
    for _ in range(3):
        made.submit(frame())
    time.sleep(0.05)
    threading.Timer(0.1, calibrator.gate.set).start()
    assert made.stop(10.0)
    assert keeper.kept == [(1, True), (2, False), (3, False)]


@pytest.mark.parametrize(("side", "count", "kept"), [(4000, 12, 4), (20, 60, 60), (20, 300, 200)])
def test_a_disk_that_hangs_costs_frames_only_when_memory_is_used_up(pipeline, side, count, kept):
    """Found under load: at 4 Hz a stall of two seconds cost three frames of half a megabyte."""
    made, keeper, calibrator = pipeline
    calibrator.gate.set()
    keeper.pause_s = 0.3
    for _ in range(count):
        made.submit(frame(side))
    keeper.pause_s = 0.0
    until(lambda: len(keeper.kept) == count - made.lost)
    assert [n for n, _ in keeper.kept] == list(range(1, count - made.lost + 1))
    assert kept <= len(keeper.kept) < max(count, kept + 1)


def test_a_bug_in_one_epoch_does_not_end_acquisition(pipeline, caplog):
    made, keeper, calibrator = pipeline
    made.next_number = 666
    calibrator.gate.set()
    made.submit(frame())
    made.submit(frame())
    until(lambda: len(keeper.kept) == 2)
    assert "epoch 666 was not calibrated" in caplog.text


def reading(monotonic: float, **values: float) -> Reading:
    return Reading(values or {"temperature": monotonic}, monotonic, 1.6e9 + monotonic)


@pytest.fixture
def housing():
    """One thermometer that is read every 10 s."""
    document = {"thermometers": [{"name": "housing", "driver": "mock"}]}
    return Thermometers(parse_config(document, Path("config.yaml")), VirtualClock())


HOUSING = reading(9.0, temperature=21.5)
PAIRED = {
    "both keep their own times": (
        {"housing": reading(10.75, temperature=21.5)}, (10.75, {"temperature": 21.5}, 0.75)),
    "several have columns of their own, and the first gives the time": (
        {"housing": HOUSING, "phone": reading(10.0, temperature=30.0, battery=33.0)},
        (9.0, {"housing": 21.5, "phone": 30.0, "phone_battery": 33.0}, -1.0)),
    "without the reference the next one gives the time and nothing is filled in": (
        {"housing": None, "air": reading(10.5, temperature=5.0)}, (10.5, {"air": 5.0}, 0.5)),
    "none was read": ({"housing": None}, (math.nan, {}, math.nan)),
}  # fmt: skip


@pytest.mark.parametrize("case", PAIRED)
def test_readings_become_the_temperatures_of_a_frame(case):
    readings, expected = PAIRED[case]
    utc, temperatures, skew_s = pair_readings(readings, 10.0)
    assert (utc - 1.6e9, skew_s) == pytest.approx(expected[::2], nan_ok=True)
    assert temperatures == expected[1]


def test_the_nearest_reading_is_taken_and_a_stale_one_is_not(housing):
    for at in (0.0, 10.0, 20.0):
        housing.add("housing", reading(at))
    assert housing.nearest("housing", 14.0) == reading(10.0)
    assert housing.nearest("housing", 16.0) == reading(20.0)
    assert housing.nearest("housing", 35.1) is None


def test_a_frame_that_waited_has_the_temperature_of_its_time():
    """Regression: with readings every second, one that waited for 20 s had none."""
    document = {"thermometers": [{"name": "air", "driver": "mock", "period_s": 1.0}]}
    air = Thermometers(parse_config(document, Path("config.yaml")), VirtualClock())
    for at in range(300):
        air.add("air", reading(float(at)))
    assert air.nearest("air", 30.2) == reading(30.0)


def test_a_channel_that_is_missing_is_logged_once_and_in_the_status(housing, caplog):
    for k in range(3):
        housing.add("housing", Reading({"lens": 20.0}, k, k, {"air": "an open wire"}))
    assert caplog.text.count("an open wire") == 1
    assert housing.last("housing")[1] == ["an open wire"]
    housing.add("housing", Reading({"lens": 20.0, "air": 5.0}, 9.0, 9.0))
    assert housing.last("housing")[1] == []


def test_a_reading_that_is_being_taken_is_waited_for(housing):
    housing.add("housing", reading(0.0))
    late = threading.Timer(0.05, lambda: housing.add("housing", reading(10.4)))
    late.start()
    _, _, skew_s = housing.around(["housing"], 10.0, patience_s=5.0)
    late.join()
    assert skew_s == reading(10.4).monotonic - 10.0
    _, temperatures, _ = housing.around(["housing"], 40.0, patience_s=0.0)
    assert temperatures == pytest.approx({"temperature": math.nan}, nan_ok=True)
