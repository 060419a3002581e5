"""The study of a camera: series together, drawn from, and propagated."""

from dataclasses import replace

import numpy as np
import pytest

from thermocald.analysis.study.series_study import StudySettings
from thermocald.analysis.study.study import study


def test_labels_make_cameras_and_series_are_pooled(warm_up):
    series = [
        warm_up(seed=1)("M1", "cold"),
        warm_up(seed=2)("M2", "cold"),
        warm_up(seed=3, drift={"c": 0.003, "x0": 0.0097, "y0": -0.0056})("M1", "warm"),
    ]
    result = study(series, StudySettings(sets=20_000))
    assert [c.label for c in result.cameras] == ["cold", "warm"]
    cold, warm = result.cameras
    assert [len(c.series) for c in result.cameras] == [2, 1]
    assert cold.correlations.epochs == 300
    assert cold.sds[1] == pytest.approx(0.0194 * 0.2527, rel=0.01)
    assert warm.montecarlo.overall_mean < 0.6 * cold.montecarlo.overall_mean


def test_series_of_one_name_are_told_apart_by_where_they_are(warm_up):
    pair = [replace(warm_up(seed=k)("M1", "cold"), source=f"/data/{k}") for k in (1, 2)]
    (camera,) = study(pair, StudySettings(sets=100)).cameras
    assert [one.series.name for one in camera.series] == ["M1 in 1", "M1 in 2"]


def test_first_order_agrees_where_errors_are_small(warm_up):
    camera = study([warm_up()()], StudySettings(sets=50_000)).cameras[0]
    np.testing.assert_allclose(camera.first_order.mean, camera.montecarlo.mean, rtol=0.02)
    np.testing.assert_allclose(camera.first_order.fractions, camera.montecarlo.fractions, atol=0.01)
    # Maxima of 50,000 draws scatter by some per cent.
    np.testing.assert_allclose(
        camera.first_order.expected_largest, camera.montecarlo.largest, rtol=0.2
    )


def test_without_covariances_there_is_no_monte_carlo_but_a_reason(warm_up):
    series = warm_up()(correlations=np.empty((0, 10, 10)))
    camera = study([series], StudySettings(sets=100)).cameras[0]
    assert camera.montecarlo is None
    assert "No epoch has a covariance matrix" in " ".join(camera.notes)


@pytest.mark.slow
def test_two_hundred_thousand_epochs_in_seconds(warm_up):
    """A sixteenth of a year; the year itself is in benchmarks/study.py."""
    import time

    series = warm_up(epochs=200_000)(correlations=np.tile(np.eye(10), (5000, 1, 1)))
    begin = time.process_time()  # other jobs may share the machine
    result = study([series], StudySettings())
    assert time.process_time() - begin < 12
    assert result.cameras[0].series[0].significance["x0"].tests == 200_000 - 30
