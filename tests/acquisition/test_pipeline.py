"""What belongs to an epoch; what is put off, kept or lost when calibration or the disk is slow."""

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

BUG = 666  # the number of an epoch of which neither the calibrator nor the keeper makes anything


class Lists:
    """A calibrator and a keeper: gates hold them up, and the keeper gives back what was put off."""

    testfield = None

    def __init__(self) -> None:
        self.calibrates, self.keeps = threading.Event(), threading.Event()
        self.keeps.set()
        self.kept: list[tuple[int, bool]] = []
        self.amended: list[int] = []
        self.lost: list[str] = []

    def calibrate(self, epoch: Epoch, image=None, fingerprint=None) -> CalibratedEpoch:
        self.calibrates.wait(10.0)
        if epoch.number == BUG:
            raise RuntimeError("a bug")
        return CalibratedEpoch(epoch, failed("ok", ""), {})

    def reset(self) -> None:
        pass

    def keep(self, acquired) -> None:
        self.keeps.wait(10.0)
        if acquired.number == BUG + 1:
            raise RuntimeError("a bug")
        self.kept.append((acquired.number, acquired.calibrated is not None))

    def observe(self, calibrated, in_order):
        return calibrated

    def lose(self, why) -> None:
        self.lost.append(why)

    def amend(self, calibrated) -> None:
        self.amended.append(calibrated.epoch.number)

    def backlog(self, below: int):
        later = [n for n, calibrated in self.kept if not calibrated and n not in self.amended]
        return Epoch(later[0], 0.0, 0.0) if later else None


@pytest.fixture
def pipeline():
    """A pipeline and its lists."""
    lists, clock = Lists(), SystemClock()
    none = Thermometers(SimpleNamespace(cameras=(), thermometers=()), clock)
    made = Pipeline("cam", lists, none, (), lists, clock)
    made.start()
    yield made, lists
    lists.calibrates.set()
    lists.keeps.set()
    assert made.stop(10.0)
    assert made.lost == len(lists.lost)
    assert all(text.startswith("camera cam: ") for text in lists.lost)


def frame(side: int = 20) -> Frame:
    return Frame(np.zeros((side, side), dtype=np.uint8), time.monotonic(), time.time())


def until(condition) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_too_slow_it_drops_calibration_never_acquisition_and_catches_up(pipeline):
    made, lists = pipeline
    for _ in range(20):
        made.submit(frame())
    until(lambda: len(lists.kept) == 17)  # three may wait
    assert lists.kept == [(n, False) for n in range(1, 18)]
    lists.calibrates.set()
    until(lambda: len(lists.amended) == 17)
    assert sorted(lists.amended) == list(range(1, 18))
    assert lists.kept[17:] == [(18, True), (19, True), (20, True)]
    assert (made.lost, made.dropped, made.caught_up) == (0, 17, 17)


def test_the_end_finishes_the_epoch_in_hand_and_keeps_the_others(pipeline):
    made, lists = pipeline
    for _ in range(3):
        made.submit(frame())
    time.sleep(0.05)
    threading.Timer(0.1, lists.calibrates.set).start()
    assert made.stop(10.0)
    assert lists.kept == [(1, True), (2, False), (3, False)]


@pytest.mark.parametrize(("side", "count", "kept"), [(4000, 12, 4), (20, 60, 60), (20, 300, 200)])
def test_a_disk_that_hangs_costs_frames_only_when_memory_is_used_up(pipeline, side, count, kept):
    """Found under load: at 4 Hz a stall of two seconds cost three frames of half a megabyte."""
    made, lists = pipeline
    lists.calibrates.set()
    lists.keeps.clear()
    for _ in range(count):
        made.submit(frame(side))
    lists.keeps.set()
    until(lambda: len(lists.kept) == count - made.lost)
    assert [n for n, _ in lists.kept] == list(range(1, count - made.lost + 1))
    assert kept <= len(lists.kept) < max(count, kept + 1)


def test_what_the_disk_has_not_taken_at_the_end_is_lost(pipeline):
    made, lists = pipeline
    lists.calibrates.set()
    lists.keeps.clear()
    for _ in range(3):
        made.submit(frame())
    assert not made.stop(0.2)
    assert made.lost == 2  # one is being stored


def test_a_bug_in_one_epoch_does_not_end_acquisition(pipeline, caplog):
    made, lists = pipeline
    made.next_number = BUG
    lists.calibrates.set()
    for _ in range(3):
        made.submit(frame())
    until(lambda: len(lists.kept) == 2)
    assert f"epoch {BUG} was not calibrated" in caplog.text
    assert lists.kept == [(BUG, True), (BUG + 2, True)]
    assert lists.lost == [f"camera cam: epoch {BUG + 1}: a bug"]


def reading(monotonic: float, **values: float) -> Reading:
    return Reading(values or {"temperature": monotonic}, monotonic, 1.6e9 + monotonic)


def thermometer(period_s: float = 10.0) -> Thermometers:
    """One thermometer, `housing`."""
    document = {"name": "housing", "driver": "mock", "period_s": period_s}
    return Thermometers(parse_config({"thermometers": [document]}, Path("c.yaml")), VirtualClock())


def test_readings_become_the_temperatures_of_a_frame():
    """Of several thermometers, the first that was read gives the time."""
    readings = {"housing": reading(9.0), "phone": reading(10.0, temperature=30.0, battery=33.0)}
    temperatures = {"housing": 9.0, "phone": 30.0, "phone_battery": 33.0}
    assert pair_readings(readings, 10.0) == (1.6e9 + 9.0, temperatures, -1.0)
    readings = {"housing": None, "air": reading(10.5)}
    assert pair_readings(readings, 10.0) == (1.6e9 + 10.5, {"air": 10.5}, 0.5)


def test_the_nearest_reading_is_taken_and_a_stale_one_is_not():
    housing, every_second = thermometer(), thermometer(1.0)
    for at in (0.0, 10.0, 20.0):
        housing.add("housing", reading(at))
    assert housing.nearest("housing", 14.0) == reading(10.0)
    assert housing.nearest("housing", 16.0) == reading(20.0)
    assert housing.nearest("housing", 35.1) is None
    # a frame that waited for minutes has the temperature of its time: once, it had none after 20 s
    for at in range(300):
        every_second.add("housing", reading(float(at)))
    assert every_second.nearest("housing", 30.2) == reading(30.0)


def test_a_channel_that_is_missing_is_logged_once_and_in_the_status(caplog):
    housing = thermometer()
    for k in range(3):
        housing.add("housing", Reading({"lens": 20.0}, k, k, {"air": "an open wire"}))
    assert caplog.text.count("an open wire") == 1
    assert housing.last("housing")[1] == ["an open wire"]
    housing.add("housing", Reading({"lens": 20.0, "air": 5.0}, 9.0, 9.0))
    assert housing.last("housing")[1] == []


def test_a_reading_that_is_being_taken_is_waited_for():
    housing = thermometer()
    housing.add("housing", reading(0.0))
    late = threading.Timer(0.05, lambda: housing.add("housing", reading(10.4)))
    late.start()
    _, _, skew_s = housing.around(["housing"], 10.0, patience_s=5.0)
    late.join()
    assert skew_s == reading(10.4).monotonic - 10.0
    _, temperatures, _ = housing.around(["housing"], 40.0, patience_s=0.0)
    assert temperatures == pytest.approx({"temperature": math.nan}, nan_ok=True)
