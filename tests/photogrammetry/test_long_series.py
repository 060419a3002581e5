"""A series adjusted in blocks: equal numbers for any blocks, true standard deviations."""

from __future__ import annotations

import corner_camera as scene
import numpy as np
import pytest

from tests.blocks import InBlocks
from tests.photogrammetry.exact_rendering import rms
from thermocald.photogrammetry.camera.camera_model import PRINCIPAL_POINT
from thermocald.photogrammetry.series.long_series import adjust_long_series
from thermocald.photogrammetry.series.normals import spread_windows
from thermocald.photogrammetry.series.result import SeriesSettings

OWN = np.arange(8)
EPOCHS = 480


@pytest.fixture(scope="module")
def case():
    """Return a drifting camera's field, truth and grid; a board is hidden at times."""
    rng, whole = np.random.default_rng(40), scene.corner_field(0.02)
    known = whole.subset(np.arange(0, len(whole), 3))
    truth = scene.warming_up(20 * np.sin(np.arange(EPOCHS) / EPOCHS * 9.0))
    grid = scene.observe_series(known, truth, rng, 0.02)
    hidden = np.zeros(grid.observed.shape, dtype=bool)
    hidden[EPOCHS // 3 : EPOCHS // 2, : len(known) // 5] = True
    grid.points[200, 20] += 40.0  # a gross error outside the sample
    return known, truth, grid.reject(hidden)


def blocked(case, size, exterior="series", jobs=1, together=120, **other):
    field, _, grid = case
    return adjust_long_series(
        scene.SENSOR, field, InBlocks(grid, size), scene.INTERIOR, scene.EXTERIOR,
        SeriesSettings(exterior=exterior, **other), together=together, jobs=jobs,
    )  # fmt: skip


@pytest.mark.parametrize("exterior", ["series", "mount"])
def test_the_blocks_do_not_matter(case, exterior):
    one, many = blocked(case, EPOCHS, exterior), blocked(case, 37, exterior)
    apart = (many.rows.values - one.rows.values)[:, OWN]
    assert np.abs(apart / one.rows.sd[:, OWN]).max() < 1e-5
    assert np.abs(apart[:, 0] / one.rows.values[:, 0]).max() < 1e-9
    # for rare sets of targets, the effect of offsets is the mean over a block
    np.testing.assert_allclose(many.rows.sd[:, OWN], one.rows.sd[:, OWN], rtol=2e-3)
    np.testing.assert_allclose(many.rows.sigma0, one.rows.sigma0, rtol=1e-7)
    np.testing.assert_allclose(many.level_sd, one.level_sd, rtol=1e-5)
    assert many.rows.status == one.rows.status


def test_processes_do_not_matter(case):
    """Blocks on two processes give the same bits as on one."""
    one, two = (blocked(case, 60, "mount", jobs) for jobs in (1, 2))
    for name in ("values", "sd", "sigma0", "status"):
        np.testing.assert_array_equal(getattr(two.rows, name), getattr(one.rows, name))
    assert np.array_equal([two.level_sd, two.trend_sd], [one.level_sd, one.trend_sd])


def test_blocks_equal_the_adjustment_of_all_at_once(case):
    """The noise differs a little: it is from a sample of 120 of the 480 epochs."""
    field, truth, grid = case
    whole = scene.adjusted_series(field, grid, exterior="series", target_noise=False)
    parts = blocked(case, 50, target_noise=False)
    apart = (parts.rows.values - whole.values)[:, OWN]
    level = apart.mean(axis=0)
    assert np.abs(level / whole.level_sd[OWN]).max() < 0.05
    # a borderline point that only one of them rejects changes its epoch by half an sd
    assert np.quantile(np.abs(apart - level) / whole.sd[:, OWN], 0.95) < 0.1
    assert np.quantile(np.abs(parts.rows.sd[:, OWN] / whole.sd[:, OWN] - 1), 0.95) < 0.05
    np.testing.assert_allclose(parts.level_sd[OWN], whole.level_sd[OWN], rtol=0.05)
    radial = [0, 3, 4, 5]  # the others' trend is also that of a mount, estimated from the epochs
    np.testing.assert_allclose(parts.trend_sd[radial], whole.trend_sd[radial], rtol=0.05)
    assert parts.rows.n_rejected[200] == 1
    ratio = rms(scene.ratios(parts.rows, truth, OWN), axis=0)
    # 480 epochs give a standard deviation to 3.2 %; the bound is four times that
    assert ratio.min() > 0.87
    assert ratio.max() < 1.13


def test_targets_outside_the_sample_are_adjusted(case):
    """The offsets of a board seen only between the sample's windows are from the sums."""
    field, truth, grid = case
    windows = spread_windows(EPOCHS, 120)
    hidden = np.zeros(grid.observed.shape, dtype=bool)
    for window in windows:
        hidden[window, :6] = True
    r = blocked((field, truth, grid.reject(hidden)), 60)
    seen = np.flatnonzero(~hidden[:, 0] & np.isfinite(r.rows.values[:, 0]))
    z = (r.rows.values - truth)[:, OWN]
    z = (z - z.mean(axis=0)) / r.rows.sd[:, OWN]
    assert rms(z[seen]) < 1.15


@pytest.mark.parametrize("exterior", ["auto", "series"])
def test_a_knock_between_the_sampled_epochs_is_the_mounts(exterior):
    """Regression: it was not examined, and errors of x0 were up to 26 sds."""
    rng, field, epochs = np.random.default_rng(1), scene.corner_field(per_side=4), 1200
    truth = np.tile(scene.TRUTH, (epochs, 1))
    truth[:, :3] += np.sin(np.arange(epochs) / 120)[:, None] * np.array([1e-4, 1e-3, -8e-4])
    truth[530:, 10:13] += np.array([2e-4, -1e-4, 1e-4])
    grid = scene.observe_series(field, truth, rng)
    found = blocked((field, truth, grid), 400, exterior, together=300)
    assert ("with jumps in a sample of the epochs" in found.sample.choice) is (exterior == "auto")
    assert rms(scene.ratios(found.rows, truth, PRINCIPAL_POINT)) < 1.3
