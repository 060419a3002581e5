"""Observations and covariances as bytes: the stated rounding, the stated size."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.errors import StoreError
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.store.database.epochs import (
    POINT_QUANTUM_PX,
    pack_observations,
    unpack_covariance,
    unpack_observations,
)


def observations(n: int, seed: int = 1) -> Observations:
    rng = np.random.default_rng(seed)
    return Observations(
        np.arange(n), rng.uniform(-50, 9000, (n, 2)), rng.uniform(0.001, 2.0, (n, 2))
    )


def test_rounding_is_as_stated():
    seen = observations(5000)
    kept = unpack_observations(pack_observations(seen))
    error = kept.points - seen.points
    assert np.abs(error).max() <= 0.5 * POINT_QUANTUM_PX * (1 + 1e-6)
    assert error.std() == pytest.approx(POINT_QUANTUM_PX / np.sqrt(12), rel=0.05)
    assert kept.sigmas == pytest.approx(seen.sigmas, rel=6e-8)
    assert np.array_equal(kept.targets, seen.targets)


def test_points_of_five_decimals_are_exact():
    """The numbers of observations.csv are returned digit by digit."""
    seen = observations(5000)
    rounded = Observations(
        seen.targets, np.array([[float(f"{v:.5f}") for v in p] for p in seen.points]), seen.sigmas
    )
    assert np.array_equal(unpack_observations(pack_observations(rounded)).points, rounded.points)


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
