"""A recording is unplugged by moving its folder away."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np

from tests.drivers.laboratory.bench import Bench
from thermocald.epoch import Epoch
from thermocald.hal import VirtualClock
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import RecordingWriter


@contextmanager
def _replay(tmp_path, monkeypatch):
    path, away = tmp_path / "M1", tmp_path / "away"
    head = Head("M1", "M1", 10.0, CameraSpec("c", Sensor(64, 48, 0.001)), {"lens": Channel()})
    field = TestField.build(["a", "b"], [[0, 0, 0], [1000, 0, 0]])
    image = np.zeros((48, 64), dtype=np.uint8)
    with RecordingWriter(path, head, field) as writer:
        for i in range(1, 30):
            epoch = Epoch(i, 1.6e9 + 10 * i, 1.6e9 + 10 * i + 1, {"lens": 20.0 + 0.1 * i})
            writer.append(epoch, image=image)
    yield Bench(
        {"recording": str(path)},
        unplug=lambda: path.rename(away),
        plug=lambda: away.rename(path),
        clock=VirtualClock(utc=1.6e9 + 1000.0),  # it was recorded in the past
    )


camera = thermometer = _replay
