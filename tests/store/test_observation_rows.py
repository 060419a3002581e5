"""Observations read in bulk are those read epoch by epoch."""

import numpy as np
import pytest

from tests.store.test_damage import change
from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult
from thermocald.store.sources import StoredRecording, open_source

EPOCHS, TARGETS = 40, 75  # more than one row of details an epoch


def seen(rng, number):
    n = int(rng.integers(3, TARGETS))
    targets = np.sort(rng.choice(TARGETS, n, replace=False))
    points, sigmas = rng.uniform(0, 2400, (n, 2)), rng.uniform(0.01, 0.1, (n, 2))
    if number == 7:
        points[0, 0] = 1e6  # too far for quanta
    sxy = 0.2 * sigmas.prod(axis=1) if number % 3 == 0 else None
    return Observations(targets, points, sigmas, sxy, {"blur": rng.uniform(0.5, 2, n)})


@pytest.fixture
def path(tmp_path):
    rng = np.random.default_rng(2)
    names = [str(i) for i in range(TARGETS)]
    field = TestField.build(names, rng.uniform(0, 2000, (TARGETS, 3)), 0.02, 20.0)
    camera = CameraSpec("cam", Sensor(3280, 2464, 0.00112), 3.04)
    head = Head("r", "M1", 10.0, camera, {"temperature": Channel()})
    file = tmp_path / "a.db"
    with Store.open(file, "append", durable=False) as store:
        series = store.create_series(head, field)
        for number in range(1, EPOCHS):
            there = None if number in (4, 5) else seen(rng, number)
            epoch = Epoch(2 * number, 10.0 * number, 10.0 * number, {}, observations=there)
            covariance = np.eye(16) if number % 2 else None
            store.append(series, epoch, EpochResult("ok", covariance=covariance))
        # calibrated again: once with the same observations, once with others
        store.amend(series, 20, EpochResult("ok", "again"))
        store.amend(series, 30, EpochResult("ok", "again"), observations=seen(rng, 15))
    return file


def test_a_block_holds_what_its_epochs_hold(path):
    with open_source(path) as store:
        (series,) = store.all_series()
        epochs = {e.epoch.number: e.epoch.observations for e in store.epochs(series)}
        numbers = np.arange(2, 2 * EPOCHS, 2)
        want = ObservationGrid.from_observations(
            series.testfield, [epochs.get(int(n)) for n in numbers]
        )
        ((first, grid),) = StoredRecording(store, series).blocks()
        assert first == 0
        np.testing.assert_array_equal(grid.points, want.points)
        np.testing.assert_array_equal(grid.weights, want.weights)
        windows = [slice(5, 9), slice(20, 22)]
        (_, few), (_, more) = StoredRecording(store, series).blocks(windows)
        np.testing.assert_array_equal(few.points, want.points[5:9])
        np.testing.assert_array_equal(more.points, want.points[20:22])


def test_damage_is_found(path):
    last = "WHERE id = (SELECT max(id) FROM detail)"
    change(path, f"UPDATE detail SET data = zeroblob(length(data)) {last}")
    with Store.open(path) as store:
        (series,) = store.all_series()
        with pytest.raises(StoreError, match="is damaged"):
            store.observation_rows(series, 0, 2 * EPOCHS)
