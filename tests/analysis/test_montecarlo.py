"""The Monte-Carlo against OpenCV set by set, and against what it says of its own distribution."""

import tracemalloc

import cv2
import numpy as np
import pytest

from benchmarks.montecarlo import CORRELATION, IOP, SDS, SENSOR
from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study import montecarlo
from thermocald.analysis.study.montecarlo import (
    draw_root,
    on_plane,
    plane_errors,
    plane_jacobian,
    simulate_errors,
)
from thermocald.analysis.study.series_study import StudySettings
from thermocald.errors import GeometryError


def opencv_distances(sets, points, distance_mm):
    """A loop over the sets with cv2.undistortPoints: distances (n, k) mm to the expected points."""
    pitch = SENSOR.pixel_pitch
    image = points.reshape(-1, 1, 2)
    expected = on_plane(SENSOR, IOP, points, distance_mm)
    result = np.empty((len(sets), len(points)))
    for i, (c, x0, y0, a1, a2, a3, b1, b2, _, _) in enumerate(sets):
        matrix = np.array(
            [
                [c / pitch, 0, (SENSOR.width - 1) / 2 + x0 / pitch],
                [0, c / pitch, (SENSOR.height - 1) / 2 - y0 / pitch],
                [0, 0, 1],
            ]
        )
        distortion = np.array([a1 * c**2, a2 * c**4, -b2 * c, b1 * c, a3 * c**6])
        ideal = cv2.undistortPoints(image, matrix, distortion)[:, 0] * [distance_mm, -distance_mm]
        result[i] = np.linalg.norm(ideal - expected, axis=1)
    return result


def test_distances_are_opencvs_to_a_millionth_of_a_millimetre():
    sets = IOP + np.random.default_rng(1).standard_normal((5000, 8)) @ draw_root(SDS, CORRELATION)
    points = image_grid(SENSOR)
    ours = np.linalg.norm(plane_errors(SENSOR, IOP, sets, points, 1e4), axis=2)
    np.testing.assert_allclose(ours, opencv_distances(sets, points, 1e4), atol=1e-6, rtol=0)


def test_affine_terms_are_inverted_as_the_camera_model_does():
    sets = IOP + np.random.default_rng(2).standard_normal((50, 10)) * [*SDS[:8], 1e-4, 1e-4]
    points = image_grid(SENSOR)
    expected = [
        on_plane(SENSOR, one, points, 1e4) - on_plane(SENSOR, IOP, points, 1e4) for one in sets
    ]
    np.testing.assert_allclose(plane_errors(SENSOR, IOP, sets, points, 1e4), expected, atol=1e-5)


def test_a_seed_gives_the_same_numbers_whatever_the_chunks(monkeypatch):
    first = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=5000, seed=7))
    monkeypatch.setattr(montecarlo, "_CHUNK", 300)
    second = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=5000, seed=7))
    np.testing.assert_array_equal(first.counts, second.counts)
    np.testing.assert_allclose(first.largest, second.largest, rtol=1e-12)
    other = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=5000, seed=8))
    assert not np.array_equal(first.counts, other.counts)


def test_clusters_means_and_ellipses_are_those_of_the_errors():
    result = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=3000, seed=3))
    rng = np.random.default_rng(3)
    root = draw_root(SDS, CORRELATION)
    sets = np.concatenate(
        [IOP + rng.standard_normal((n, len(root))) @ root for n in (1024, 1024, 952)]
    )
    errors = plane_errors(SENSOR, IOP, sets, result.image_points, 1e4)
    distance = np.linalg.norm(errors, axis=2)
    edges = [0, 15, 50, 100, np.inf]
    counts = [np.histogram(column, edges)[0] for column in distance.T]
    np.testing.assert_array_equal(result.counts, counts)
    np.testing.assert_allclose(result.mean, distance.mean(axis=0))
    np.testing.assert_allclose(result.largest, distance.max(axis=0))
    scatter = [np.cov(errors[:, k].T, ddof=0) for k in range(9)]
    np.testing.assert_allclose(result.covariance, scatter, rtol=1e-9, atol=1e-9)


def test_small_errors_are_those_of_first_order():
    root = draw_root(SDS, CORRELATION)
    result = simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings())
    jacobian = plane_jacobian(SENSOR, IOP, result.image_points, 1e4)
    first = jacobian @ (root.T @ root) @ np.swapaxes(jacobian, -1, -2)
    # 50,000 draws: a variance is known to 0.6 %, a mean to 0.0045 of the standard deviation.
    np.testing.assert_allclose(result.covariance[:, 0, 0], first[:, 0, 0], rtol=0.03)
    assert np.linalg.norm(result.mean_error, axis=1).max() < 0.02 * np.sqrt(first[0, 0, 0])


def test_large_errors_are_not_and_the_bias_is_that_of_second_order():
    """A principal distance uncertain by 10 %: E(1/c) exceeds 1/c by 1 %."""
    sds = np.array([0.397, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    result = simulate_errors(SENSOR, IOP, sds, CORRELATION, StudySettings())
    np.testing.assert_allclose(
        result.mean_error[[0, 2, 6, 8]], 0.0103 * result.expected[[0, 2, 6, 8]], rtol=0.15
    )


def test_draws_have_the_standard_deviations_and_correlations_asked_for():
    draws = np.random.default_rng(4).standard_normal((200_000, 8)) @ draw_root(SDS, CORRELATION)
    np.testing.assert_allclose(draws.std(axis=0)[:8], SDS[:8], rtol=0.01)
    np.testing.assert_allclose(np.corrcoef(draws[:, :8].T), CORRELATION[:8, :8], atol=0.01)
    assert not draws[:, 8:].any()


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


def test_fifty_thousand_sets_need_less_than_20_mb():
    simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=2000))
    tracemalloc.start()
    try:
        simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20e6


def test_sets_that_fold_the_image_are_counted_and_left_out():
    wild = SDS.copy()
    wild[3] = 0.06
    result = simulate_errors(SENSOR, IOP, wild, CORRELATION, StudySettings(sets=2000))
    assert 0 < result.folded < 2000
    assert result.counts.sum() == 9 * (2000 - result.folded)
    assert np.isfinite(result.overall_mean)


def test_an_expected_point_that_does_not_exist_is_an_error():
    folded = IOP.copy()
    folded[3] = -0.2
    with pytest.raises(GeometryError, match="no ray"):
        simulate_errors(SENSOR, folded, SDS, CORRELATION, StudySettings(sets=100))


@pytest.mark.slow
def test_five_million_sets_in_constant_memory_with_progress():
    done = []
    tracemalloc.start()
    try:
        settings = StudySettings(sets=5_000_000)
        result = simulate_errors(SENSOR, IOP, SDS, CORRELATION, settings, done.append)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20e6
    assert sum(done) == 5_000_000
    assert len(done) > 100
    assert result.counts.sum() == 45_000_000


def test_processes_do_not_matter():
    """Sets projected on two processes give the bits of one."""
    one, two = (
        simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=5000, seed=3, jobs=jobs))
        for jobs in (1, 2)
    )
    for name in ("counts", "mean", "largest", "mean_error", "covariance", "sample"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name))
