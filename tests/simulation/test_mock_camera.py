"""The rendering mock camera: its frames agree with its truth, and it fails like hardware."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.hal import VirtualClock, load_driver
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.targets.corner import measure_corners
from thermocald.photogrammetry.targets.markers import locate_markers
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import write_model

MockCamera = load_driver("camera", "mock")


@pytest.fixture
def camera():
    device = MockCamera(clock=VirtualClock())
    device.open()
    yield device
    device.close()


def test_frame_shows_the_known_drift(camera):
    first = camera.capture()
    camera.clock.advance(650.0)
    hot = camera.capture()
    assert hot.image.shape == (2464, 3280)
    assert hot.utc - first.utc == pytest.approx(hot.monotonic - first.monotonic)
    a, b = camera.truth(first.monotonic), camera.truth(hot.monotonic)
    moved = (b.iop[0] - a.iop[0]) / camera.model.sensor.pixel_pitch
    assert -12.0 < moved[1] < -9.0
    seen = measure_corners(hot.image, locate_markers(hot.image, camera.field))
    assert len(seen) >= 100
    expected = project(camera.model.sensor, b.iop[0], b.eop[0], camera.field.points)
    assert np.sqrt(np.mean((seen.points - expected[seen.targets]) ** 2)) < 0.04


def test_equal_instants_give_equal_frames():
    frames = []
    for _ in range(2):
        clock = VirtualClock()
        with MockCamera(clock=clock, testfield="circles", seed=4) as device:
            clock.advance(33.0)
            frames.append(device.capture().image)
    assert np.array_equal(frames[0], frames[1])


def test_own_model_and_field(tmp_path, camera):
    model = camera.model.with_effect(ModelEffect("slip", {"time": 100.0, "x0": 0.00112}))
    write_model(tmp_path / "m.yaml", model)
    clock = VirtualClock()
    with MockCamera(clock=clock, model=str(tmp_path / "m.yaml"),
                    programme=[[0, 25.0]], testfield="plain") as device:  # fmt: skip
        before, after = device.truth(clock.monotonic() + 99), device.truth(clock.monotonic() + 101)
    assert after.iop[0, 1] - before.iop[0, 1] == pytest.approx(0.00112)
