"""Replay: frames, observations and readings come with their recorded times."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.commands import answer
from thermocald.epoch import Epoch
from thermocald.errors import BadReading, DeviceFinished, TestFieldError
from thermocald.hal import VirtualClock, open_device
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import (
    Observations,
    TestField,
    observations_from_lists,
)
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

BEGIN = 1.6e9
IMAGE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


@pytest.fixture
def write(tmp_path):
    head = Head("M1", "M1", 10.0, CameraSpec("c", Sensor(64, 48, 0.001)), {"lens": Channel()})
    field = TestField.build(["a", "b", "c"], np.eye(3) * 1000)

    def write_epochs(images, lens=20.0, seen=None):
        """Write an epoch for each image."""
        with RecordingWriter(tmp_path / "M1", head, field) as writer:
            for k, image in enumerate(images, 1):
                time, values = BEGIN + 10 * k, {"lens": np.broadcast_to(lens, len(images))[k - 1]}
                one = Epoch(k, time, time + 1.5, values, observations=seen)
                writer.append(one, image=image)
        return str(tmp_path / "M1")

    return write_epochs


def replay(kind, path, **options):
    clock = VirtualClock(utc=BEGIN + 100.0, monotonic=7.0)
    return open_device(kind, "replay", {"recording": path, **options}, clock)


def test_frames_keep_their_instants_and_bytes(write, tmp_path):
    """Regression: an empty file was no epoch, and a JPEG that is cut off was a `bad_frame`."""
    jpeg = b"\xff\xd8 not decoded here"
    camera = replay("camera", write([IMAGE, jpeg, IMAGE, IMAGE, IMAGE, None]))
    (tmp_path / "M1/frames/000003.png").write_bytes(b"")
    (tmp_path / "M1/frames/000004.png").write_bytes(b"no picture")
    frames = []
    for _ in range(4):
        with camera:  # closed and opened, it goes on
            frames.append(camera.capture())
    assert np.array_equal(frames[0].image, IMAGE)
    assert [f.encoded for f in frames] == [None, jpeg, b"", b"no picture"]
    assert [f.utc - BEGIN for f in frames] == [10.0, 20.0, 30.0, 40.0]
    assert [f.monotonic for f in frames[:2]] == pytest.approx([7.0 - 90.0, 7.0 - 80.0])
    assert [f.sequence for f in frames] == [1, 2, 3, 4]
    (tmp_path / "M1/frames/000005.png").unlink()
    for error, message in (
        (BadReading, "000005.png: cannot be read: No such file"),
        (BadReading, "epoch 6 has no frame"),
        (DeviceFinished, "has ended"),
    ):
        with camera, pytest.raises(error, match=message):
            camera.capture()


def test_loop_goes_on_in_time(write):
    with replay("camera", write([IMAGE] * 2), loop=True) as camera:
        assert [camera.capture().utc - BEGIN for _ in range(5)] == [10, 20, 30, 40, 50]


def test_readings_keep_their_own_instants(write):
    with replay("thermometer", write([IMAGE] * 3, lens=[21.0, np.nan, 23.0])) as device:
        first = device.read()
        with pytest.raises(BadReading, match="epoch 2 has no temperature"):
            device.read()
        third = device.read()
    assert [dict(r.values) for r in (first, third)] == [{"lens": 21.0}, {"lens": 23.0}]
    assert [r.utc - BEGIN for r in (first, third)] == [11.5, 31.5]


def test_measurements_come_without_a_picture(write):
    targets, points = np.array([2, 0]), np.array([[1.5, 2.5], [3.25, 4.0]])
    seen = Observations(targets, points, np.full((2, 2), 0.04), np.array([1e-4, -1e-4]))
    with replay("camera", write([None], seen=seen)) as camera:
        frame = camera.capture()
    field = TestField.build(["c", "b", "a"], np.eye(3))  # another order: by name, not by row
    found = observations_from_lists(frame.observations, field)
    assert frame.image is None
    assert found.targets.tolist() == [0, 2]
    assert np.array_equal(found.points, seen.points)
    assert np.array_equal(found.covariances, seen.covariances)
    for changed in ({"target": None}, {"x": [1.0]}, {"sxy": [0.0]}, {"sy": ["a"] * 2}):
        with pytest.raises(TestFieldError, match="with an entry for each target"):
            observations_from_lists(frame.observations | changed, field)


@pytest.mark.parametrize(("driver", "size"), [("replay", (64, 48)), ("mock", (3280, 2464))])
def test_a_sensor_of_another_size_than_its_frames_is_an_error_before_the_start(
    write, tmp_path, driver, size
):
    """Regression: frames had no result, one by one; recorded image points had a wrong x0, y0."""
    path, config = write([IMAGE]), tmp_path / "config.yaml"
    options = {"recording": path} if driver == "replay" else {}
    camera = {"name": "c", "driver": driver, "testfield": f"{path}/testfield.csv", **options}
    said = []
    for width, height in (size, (65, 48)):
        camera["sensor"] = {"width_px": width, "height_px": height, "pixel_pitch_mm": 0.001}
        config.write_text(json.dumps({"cameras": [camera]}))
        said.append(answer("check", config))
    assert [result.exit_code for result in said] == [0, 1]
    assert f"sensor has 65×48 px, but the driver's frames have {size[0]}×{size[1]}" in str(said[1])
