"""The tick without threads: mock devices on a virtual clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from thermocald.acquisition.calibrator import Calibrator
from thermocald.acquisition.pipeline import Pipeline
from thermocald.hal import Frame, VirtualClock, open_device


@pytest.fixture
def build():
    """Options of camera and thermometer → (clock, camera, pipeline), devices open."""
    opened = []

    def make(camera=None, thermometer=None, calibrate=False):
        clock = VirtualClock()
        c = open_device("camera", "mock", {"seed": 1, **(camera or {})}, clock)
        t = open_device("thermometer", "mock", {"seed": 2, **(thermometer or {})}, clock)
        for device in (c, t):
            device.open()
            opened.append(device)
        calibrator = Calibrator(c.model.sensor, c.field, nominal_c=3.04) if calibrate else None
        return clock, c, Pipeline(c, {"temperature": t}, calibrator, clock, period_s=10.0)

    yield make
    for device in opened:
        device.close()


def test_three_epochs_follow_the_drift_that_was_put_in(build):
    _, camera, pipeline = build(calibrate=True)
    given = []
    pipeline._sinks.append(lambda calibrated, frame: given.append(frame.sequence))
    results = list(pipeline.run(3))
    assert given == [1, 2, 3]
    for calibrated, frame in results:
        truth = camera.truth(frame.monotonic).iop[0]
        found = calibrated.adjustment
        assert found.status == "ok"
        off = (found.values[:3] - truth[:3]) / found.sd[:3]
        assert np.abs(off).max() < 5
        assert 0 < calibrated.extra["skew_s"] < 1
    assert results[0][1].monotonic == pytest.approx(0.29, abs=1e-6)
    assert results[2][1].monotonic == pytest.approx(20.29, abs=1e-6)


def test_a_camera_that_is_away_loses_its_epochs_and_nothing_else(build):
    gone = {"faults": [{"kind": "unplugged", "at_s": 15, "for_s": 20}]}
    _, _, pipeline = build(camera=gone)
    times = [frame.monotonic for _, frame in pipeline.run(4)]
    assert [round(t) for t in times] == [0, 10, 40, 50]
    assert pipeline.lost == 2


def test_a_thermometer_that_is_away_leaves_the_temperature_empty(build):
    gone = {"faults": [{"kind": "unplugged", "at_s": 5, "for_s": 10}]}
    _, _, pipeline = build(thermometer=gone)
    epochs = [calibrated.epoch for calibrated, _ in pipeline.run(3)]
    assert [bool(epoch.temperatures) for epoch in epochs] == [True, False, True]
    assert math.isnan(epochs[1].temperature_time)


def test_garbage_is_an_epoch_with_a_reason(build):
    clock, camera, pipeline = build(calibrate=True)
    garbage = [b"\xff\xd8 half a picture", b"\x00" * 100, b"\x89PNG\r\n\x1a\n"]
    camera.capture = lambda: Frame(None, clock.monotonic(), clock.utc(), encoded=garbage.pop())
    results = [calibrated.adjustment for calibrated, _ in pipeline.run(3)]
    assert [r.status for r in results] == ["bad_frame"] * 3
    assert "cut off" in results[2].reason
