"""Points on the object plane and the Monte-Carlo, against differences, OpenCV, and draws."""

import tracemalloc

import numpy as np
import pytest

from benchmarks.montecarlo import CORRELATION, IOP, SDS, SENSOR, opencv_loop
from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.montecarlo import (
    draw_root,
    mean_and_largest,
    on_plane,
    plane_errors,
    shares_within,
    simulate_errors,
)

POINTS = image_grid(SENSOR)
EXPECTED = on_plane(SENSOR, IOP, POINTS, 1e4)


def test_errors_equal_opencvs_and_with_an_affinity_those_of_the_camera_model():
    """Distances to a millionth of a millimetre."""
    rng = np.random.default_rng(1)
    sets = IOP + rng.standard_normal((5000, 8)) @ draw_root(SDS, CORRELATION)
    found = plane_errors(SENSOR, sets, POINTS, EXPECTED, 1e4)
    theirs = opencv_loop(sets, POINTS) * [1e4, -1e4] - EXPECTED
    np.testing.assert_allclose(np.hypot(*found).T, np.linalg.norm(theirs, axis=2), atol=1e-6)
    sets = IOP + rng.standard_normal((50, 10)) * [*SDS[:8], 1e-4, 1e-4]
    found = plane_errors(SENSOR, sets, POINTS, EXPECTED, 1e4)
    ours = [on_plane(SENSOR, one, POINTS, 1e4) - EXPECTED for one in sets]
    np.testing.assert_allclose(found.T, ours, atol=1e-5)


@pytest.mark.parametrize("sets", [50_000, pytest.param(5_000_000, marks=pytest.mark.slow)])
def test_any_number_of_sets_needs_less_than_20_mb_and_reports_progress(sets):
    simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=2000))
    done = []
    tracemalloc.start()
    try:
        settings = StudySettings(sets=sets)
        result = simulate_errors(SENSOR, IOP, SDS, CORRELATION, settings, done.append)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20e6
    assert sum(done) == sets
    assert len(done) > sets / 50_000
    assert result.counts.sum() == 9 * sets


@pytest.mark.parametrize("axes", [(3.0, 3.0), (3.0, 1.0), (3.0, 0.0)])
def test_the_distribution_of_distances_is_that_of_a_million_draws(axes):
    draws = np.random.default_rng(1).standard_normal((1_000_000, 2))
    distance = np.linalg.norm(draws * axes, axis=1)
    mean, expected = mean_and_largest(np.array([axes]), 5000)
    assert mean[0] == pytest.approx(distance.mean(), rel=3e-3)
    shares = [(distance < limit).mean() for limit in (1.0, 3.0, 6.0)]
    found = shares_within(np.array([axes]), np.array([1.0, 3.0, 6.0]))
    np.testing.assert_allclose(found[0], shares, atol=2e-3)
    largest = distance.reshape(200, 5000).max(axis=1).mean()
    assert expected[0] == pytest.approx(largest, rel=0.02)
