"""A small recording that looks like a user's, and a store with some epochs."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.store.small import write_recording
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult, StoredSeries

if TYPE_CHECKING:
    from pathlib import Path

N_TARGETS = 12


@pytest.fixture(scope="session")
def field() -> TestField:
    rng = np.random.default_rng(1)
    names = [f"t{i}" for i in range(N_TARGETS)]
    diameters = np.where(np.arange(N_TARGETS) % 3 == 0, np.nan, 20.0)
    return TestField.build(names, rng.uniform(0, 2000, (N_TARGETS, 3)), 0.02, diameters)


@pytest.fixture(scope="session")
def head() -> Head:
    camera = CameraSpec("rpi", Sensor(3280, 2464, 0.00112), 3.04)
    channels = {"temperature": Channel(0.0625), "board_temperature": Channel()}
    return Head("small", "M1", 10.0, camera, channels)


@pytest.fixture(scope="session")
def make_epoch():
    """Epoch number → epoch, whose values are functions of the number."""

    def make(number: int, targets: int = N_TARGETS) -> Epoch:
        rng = np.random.default_rng([7, number])
        rows = np.sort(rng.permutation(N_TARGETS)[:targets])
        points = np.round(rng.uniform(0, 2400, (targets, 2)), 5)
        sigmas = np.round(rng.uniform(0.01, 0.1, (targets, 2)), 4)
        time = 1.6e9 + 10.0 * number
        temperatures = {"temperature": 20.0 + 0.0625 * number, "board_temperature": 40.5}
        seen = Observations(rows, points, sigmas)
        return Epoch(number, time, time + 0.75, temperatures, observations=seen)

    return make


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory, field: TestField, head: Head, make_epoch) -> Path:
    path = tmp_path_factory.mktemp("recording") / "small"
    write_recording(path, head, field, [make_epoch(i) for i in range(1, 6)])
    return path


@pytest.fixture
def recording_path(tmp_path: Path, small_recording: Path) -> Path:
    """A recording of five epochs, to be changed."""
    return shutil.copytree(small_recording, tmp_path / "small")


@pytest.fixture(scope="session")
def make_result():
    """Epoch number → result with a full covariance."""

    def make(number: int, status: str = "ok") -> EpochResult:
        rng = np.random.default_rng([8, number])
        a = rng.normal(size=(40, 16))
        return EpochResult(
            status, "", rng.normal(size=16), a.T @ a * 1e-6, 1.0 + number * 1e-3, 200, 300, (1, 5)
        )

    return make


@pytest.fixture
def store_path(tmp_path: Path) -> Path:
    return tmp_path / "small.db"


@pytest.fixture
def store(store_path: Path):
    """An open, empty store."""
    with Store.open(store_path, "append", durable=False) as opened:
        yield opened


@pytest.fixture
def series(store: Store, field: TestField, head: Head) -> StoredSeries:
    """The store's first series, without epochs."""
    return store.create_series(head, field, start="cold", identity={"serial": "x1"})


@pytest.fixture(scope="session")
def small_store(tmp_path_factory, field: TestField, head: Head, make_epoch, make_result) -> Path:
    path = tmp_path_factory.mktemp("store") / "small.db"
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(head, field, start="cold", identity={"serial": "x1"})
        for i in range(1, 21):
            store.append(series, make_epoch(i), make_result(i), extra={"blur": 0.5 * i})
    return path


@pytest.fixture
def filled(store_path: Path, small_store: Path):
    """An open store with epochs 1 to 20 of one series."""
    shutil.copy(small_store, store_path)
    with Store.open(store_path, "append", durable=False) as opened:
        yield opened, opened.find_series()
