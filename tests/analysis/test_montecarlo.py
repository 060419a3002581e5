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
from thermocald.errors import GeometryError


def test_distances_equal_opencvs_to_a_millionth_of_a_millimetre():
    sets = IOP + np.random.default_rng(1).standard_normal((5000, 8)) @ draw_root(SDS, CORRELATION)
    points = image_grid(SENSOR)
    ours = np.hypot(*plane_errors(SENSOR, sets, points, on_plane(SENSOR, IOP, points, 1e4), 1e4)).T
    plane = opencv_loop(sets, points) * [1e4, -1e4]
    theirs = np.linalg.norm(plane - on_plane(SENSOR, IOP, points, 1e4), axis=2)
    np.testing.assert_allclose(ours, theirs, atol=1e-6, rtol=0)


def test_affine_terms_are_inverted_like_in_the_camera_model():
    sets = IOP + np.random.default_rng(2).standard_normal((50, 10)) * [*SDS[:8], 1e-4, 1e-4]
    points = image_grid(SENSOR)
    expected = [
        on_plane(SENSOR, one, points, 1e4) - on_plane(SENSOR, IOP, points, 1e4) for one in sets
    ]
    found = plane_errors(SENSOR, sets, points, on_plane(SENSOR, IOP, points, 1e4), 1e4)
    np.testing.assert_allclose(found.T, expected, atol=1e-5)


def test_clusters_means_and_covariances_are_those_of_the_errors():
    result = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=3000, seed=3))
    rng = np.random.default_rng(3)
    root = draw_root(SDS, CORRELATION)
    sets = IOP + rng.standard_normal((3000, len(root))) @ root  # in chunks, or at once
    errors = plane_errors(
        SENSOR, sets, result.image_points, on_plane(SENSOR, IOP, result.image_points, 1e4), 1e4
    ).T
    distance = np.linalg.norm(errors, axis=2)
    edges = [0, 15, 50, 100, np.inf]
    counts = [np.histogram(column, edges)[0] for column in distance.T]
    np.testing.assert_array_equal(result.counts, counts)
    np.testing.assert_allclose(result.mean, distance.mean(axis=0))
    np.testing.assert_allclose(result.largest, distance.max(axis=0))
    scatter = [np.cov(errors[:, k].T, ddof=0) for k in range(9)]
    np.testing.assert_allclose(result.covariance, scatter, rtol=1e-9, atol=1e-9)


def test_the_bias_of_large_errors_is_of_second_order():
    """With an sd of c of 10 %, E(1/c) exceeds 1/c by 1 %."""
    sds = np.array([0.397, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    result = simulate_errors(SENSOR, IOP, sds, CORRELATION, StudySettings())
    np.testing.assert_allclose(
        result.mean_error[[0, 2, 6, 8]], 0.0103 * result.expected[[0, 2, 6, 8]], rtol=0.15
    )


def test_an_indefinite_matrix_of_medians_becomes_the_nearest_correlation_matrix():
    matrix = np.eye(10)
    matrix[0, 1] = matrix[1, 0] = matrix[1, 2] = matrix[2, 1] = 0.95
    matrix[0, 2] = matrix[2, 0] = 0.2
    assert np.linalg.eigvalsh(matrix).min() < 0
    root = draw_root(np.ones(10), matrix)
    repaired = root.T @ root
    np.testing.assert_allclose(np.diag(repaired), 1)
    assert np.linalg.eigvalsh(repaired).min() > -1e-12
    assert np.abs(repaired - matrix).max() < 0.3


def test_sets_that_fold_the_image_are_counted_and_left_out():
    wild = SDS.copy()
    wild[3] = 0.06
    result = simulate_errors(SENSOR, IOP, wild, CORRELATION, StudySettings(sets=2000))
    assert 0 < result.folded < 2000
    assert result.counts.sum() == 9 * (2000 - result.folded)
    assert np.isfinite(result.overall_mean)


def test_an_expected_point_without_a_ray_is_refused():
    folded = IOP.copy()
    folded[3] = -0.2
    with pytest.raises(GeometryError, match="no ray"):
        simulate_errors(SENSOR, folded, SDS, CORRELATION, StudySettings(sets=100))


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
    rng = np.random.default_rng(1)
    distance = np.linalg.norm(rng.standard_normal((1_000_000, 2)) * axes, axis=1)
    mean, expected = mean_and_largest(np.array([axes]), 5000)
    assert mean[0] == pytest.approx(distance.mean(), rel=3e-3)
    limits = np.array([1.0, 3.0, 6.0])
    shares = [(distance < limit).mean() for limit in limits]
    np.testing.assert_allclose(shares_within(np.array([axes]), limits)[0], shares, atol=2e-3)
    largest = distance[:1_000_000].reshape(200, 5000).max(axis=1).mean()
    assert expected[0] == pytest.approx(largest, rel=0.02)
