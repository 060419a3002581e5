"""A condensed long series: exact means without gross errors, short ones at fast changes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.blocks import InBlocks
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.thermal.series import SeriesInput
from thermocald.thermal.source import condensed

E, T = 7200, 9
SIGMA = 0.05


@pytest.fixture(scope="module")
def recorded():
    """A sine of 80 s for one of 30 hours; one point in epoch 4001 has a gross error."""
    rng = np.random.default_rng(1)
    places = rng.uniform(200, 2800, (T, 2))
    t = 15.0 * np.arange(E)
    fast = np.where((t > 20 * 3600) & (t < 21 * 3600), 0.5 * np.sin(2 * np.pi * t / 600), 0.0)
    points = places + fast[:, None, None] + rng.normal(0, SIGMA, (E, T, 2))
    points[4001, 3] += 30.0
    weights = np.zeros((E, T, 3))
    weights[..., :2] = 1 / SIGMA**2
    weights[100:150, 2] = 0.0
    points[100:150, 2] = np.nan
    T_read = 20 + 5 * np.sin(t / 40_000) + rng.normal(0, 0.03, E)
    names = [str(i) for i in range(T)]
    field = TestField.build(names, rng.uniform(0, 500, (T, 3)))
    empty = np.empty((0, T, 3))
    whole = SeriesInput(
        "long", "camera", Sensor(3280, 2464, 0.00112), field, 3.0, t, t, {"temperature": T_read},
        {"temperature": None}, ObservationGrid(empty[..., :2], empty), np.arange(E) + 1,
    )  # fmt: skip
    return whole, ObservationGrid(points, weights)


def test_rows_are_weighted_means(recorded):
    whole, grid = recorded
    out = condensed(whole, InBlocks(grid, 911), most=500)
    assert out.counts.sum() == E
    assert len(out.counts) <= 550
    first = out.numbers - 1
    row = int(np.searchsorted(first, 100, side="right")) - 1
    part = slice(int(first[row]), int(first[row] + out.counts[row]))
    w = grid.weights[part, :, 0]
    mean = np.nansum(w[..., None] * grid.points[part], axis=0) / w.sum(axis=0)[:, None]
    np.testing.assert_allclose(out.grid.points[row], mean, atol=1e-9)
    np.testing.assert_allclose(out.grid.weights[row, :, 0], w.sum(axis=0), rtol=1e-12)
    assert out.frame_times[row] == pytest.approx(whole.frame_times[part].mean())
    noise = out.noises["temperature"] * np.sqrt(out.counts)
    np.testing.assert_allclose(noise, 0.03, rtol=0.1)


def test_the_blocks_that_are_read_do_not_matter(recorded):
    whole, grid = recorded
    one, other = (condensed(whole, InBlocks(grid, size), most=500) for size in (E, 480))
    # except for points at the limit of gross errors
    assert np.mean(np.abs(one.grid.points - other.grid.points) > 1e-9) < 0.002
    np.testing.assert_array_equal(one.counts, other.counts)


def test_a_gross_error_is_left_out(recorded):
    whole, grid = recorded
    out = condensed(whole, InBlocks(grid, 911), most=300)
    row = int(np.searchsorted(out.numbers, 4002, side="right")) - 1
    fine = np.nanmedian(grid.points[4001 - 100 : 4001 + 100, 3], axis=0)
    np.testing.assert_allclose(out.grid.points[row, 3], fine, atol=0.1)


def test_what_is_fast_keeps_short_rows(recorded):
    whole, grid = recorded
    out = condensed(whole, InBlocks(grid, 911), most=500)
    fast = (out.frame_times > 20 * 3600) & (out.frame_times < 21 * 3600)
    assert np.mean(out.counts[fast]) * 2 < np.median(out.counts[~fast])
