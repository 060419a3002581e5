"""A smallest store: a series of one target, with epochs that are functions of a number."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import numpy as np

from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter
from thermocald.store.series import EpochResult


def create_small_series(store, name: str = "M1", start: str = ""):
    """The series `name` of a camera `rpi` with a thermometer `t`."""
    camera = CameraSpec("rpi", Sensor(640, 480, 0.001))
    head = Head("a", name, 10.0, camera, {"t": Channel()})
    return store.create_series(head, TestField.build(["a"], np.zeros((1, 3))), start=start)


def write_recording(path, head, testfield, epochs) -> None:
    with RecordingWriter(path, head, testfield) as writer:
        for epoch in epochs:
            writer.append(epoch)


def assert_same_epochs(some, others, rtol: float = 1e-5) -> None:
    """Check epochs and their observations, whatever the order of targets; rtol: of sigmas."""
    for a, b in zip(some, others, strict=True):
        assert (a.number, a.temperatures.keys()) == (b.number, b.temperatures.keys())
        times = [[e.frame_time, e.temperature_time, *e.temperatures.values()] for e in (a, b)]
        np.testing.assert_allclose(*times, rtol=0, atol=1e-6)
        x, y = (e.observations.select(np.argsort(e.observations.targets)) for e in (a, b))
        np.testing.assert_array_equal(x.targets, y.targets)
        np.testing.assert_array_equal(x.points, y.points)
        np.testing.assert_allclose(x.sigmas, y.sigmas, rtol=rtol)
        assert x.quality.keys() == y.quality.keys()
        for name in x.quality:
            np.testing.assert_array_equal(x.quality[name], y.quality[name])


def small_epoch(number: int, begin_s: float = 1e9, interval_s: float = 1.0) -> Epoch:
    time_s = begin_s + interval_s * number
    return Epoch(number, time_s, time_s, {"t": 20.0})


def small_result(number: int) -> EpochResult:
    return EpochResult("ok", "", np.full(16, float(number)), np.eye(16), 1.0, 5, 9)


def change(path, *statements: str, values=()) -> None:
    """Change a store's file without the triggers that forbid it."""
    with closing(sqlite3.connect(path)) as database, database:
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'"):
            database.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            database.execute(statement, values)


def stored_numbers(path) -> list[int]:
    """Return the epochs' numbers of an undamaged store's one series, by rows and by columns."""
    with Store.open(path) as store:
        assert store.examine().damaged == ()
        series = store.find_series()
        numbers = [s.epoch.number for s in store.epochs(series)]
        assert store.series_columns(series, ["epoch"])["epoch"].tolist() == numbers
        return numbers
