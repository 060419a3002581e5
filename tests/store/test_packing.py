"""Observations as bytes: the stated rounding; read in bulk, they are those read epoch by epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.database.epochs import (
    POINT_QUANTUM_PX,
    pack_observations,
    unpack_covariance,
    unpack_observations,
)
from thermocald.store.database.store import Store
from thermocald.store.series import EpochResult
from thermocald.store.sources import StoredRecording, open_source


def observations(n: int, seed: int = 1) -> Observations:
    rng = np.random.default_rng(seed)
    return Observations(
        np.arange(n), rng.uniform(-50, 9000, (n, 2)), rng.uniform(0.001, 2.0, (n, 2))
    )


def test_rounding_is_as_stated_and_five_decimals_are_exact():
    """The numbers of observations.csv are returned digit by digit."""
    seen = observations(5000)
    kept = unpack_observations(pack_observations(seen))
    error = kept.points - seen.points
    assert np.abs(error).max() <= 0.5 * POINT_QUANTUM_PX * (1 + 1e-6)
    assert error.std() == pytest.approx(POINT_QUANTUM_PX / np.sqrt(12), rel=0.05)
    assert kept.sigmas == pytest.approx(seen.sigmas, rel=6e-8)
    assert np.array_equal(kept.targets, seen.targets)
    points = np.array([[float(f"{v:.5f}") for v in p] for p in seen.points[:500]])
    short = replace(observations(500), points=points)
    assert np.array_equal(unpack_observations(pack_observations(short)).points, points)


def test_an_epoch_of_too_many_numbers_is_refused_and_the_next_is_stored(
    store, series, make_epoch, make_result
):
    """Its details would take the place of the next epoch's."""
    quality = {f"q{i}": np.zeros(100) for i in range(3000)}
    large = replace(make_epoch(2), observations=replace(observations(100), quality=quality))
    with pytest.raises(StoreError, match="observations are too many to store"):
        store.append(series, large, make_result(2))
    store.append(series, make_epoch(3), make_result(3))
    assert [one.epoch.number for one in store.epochs(series)] == [3]
    assert not store.examine().damaged


def test_what_does_not_fit_is_kept_otherwise():
    seen = Observations(
        np.array([3, 3999]),
        np.array([[1e6, np.nan], [-3e5, 0.1]]),
        np.ones((2, 2)),
        np.array([0.1, -0.2]),
        {"blur": np.array([0.5, np.nan]), "größe": np.array([1.0, 2.0])},
    )
    kept = unpack_observations(pack_observations(seen))
    assert kept.targets.tolist() == [3, 3999]
    assert np.array_equal(kept.points, seen.points, equal_nan=True)
    assert kept.covariances == pytest.approx(seen.covariances)
    assert list(kept.quality) == ["blur", "größe"]
    assert np.array_equal(kept.quality["blur"], [0.5, np.nan], equal_nan=True)


@pytest.mark.parametrize(
    "data", [b"", b"\x01", b"\x02" * 40, pack_observations(observations(9))[:-1]]
)
def test_broken_bytes_are_an_error(data):
    with pytest.raises(StoreError):
        unpack_observations(data)
    with pytest.raises(StoreError):
        unpack_covariance(data)


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
def path(store_path, head):
    rng = np.random.default_rng(2)
    names = [str(i) for i in range(TARGETS)]
    field = TestField.build(names, rng.uniform(0, 2000, (TARGETS, 3)), 0.02, 20.0)
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for number in range(1, EPOCHS):
            there = None if number in (4, 5) else seen(rng, number)
            epoch = Epoch(2 * number, 10.0 * number, 10.0 * number, {}, observations=there)
            covariance = np.eye(16) if number % 2 else None
            store.append(series, epoch, EpochResult("ok", covariance=covariance))
        # calibrated again: once with the same observations, once with others
        store.amend(series, 20, EpochResult("ok", "again"))
        store.amend(series, 30, EpochResult("ok", "again"), observations=seen(rng, 15))
    return store_path


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
