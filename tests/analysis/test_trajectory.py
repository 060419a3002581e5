"""What the camera's own path does on the plane, against cameras whose path is known."""

import numpy as np
import pytest

from thermocald.analysis.study.montecarlo import correlations_over_time, trajectories
from thermocald.analysis.study.study import StudySettings, study_camera
from thermocald.output.study.summary import answer_sentences
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

CLUSTERS = (15.0, 50.0, 100.0)


def test_a_shift_of_the_principal_point_moves_all_points_alike(warm_up):
    """x0 alone, no distortion to speak of: D Δx0 / c at every image point."""
    series = warm_up(drift={"x0": 0.0194}, sds=np.full(10, 1e-12))()
    first, mean, last = trajectories([series], 10_000.0, 3, CLUSTERS)
    away = np.abs(series.values[:, 1] - series.values[0, 1]) * 10_000.0 / series.values[0, 0]
    assert first.reference == "first"
    assert first.mean == pytest.approx(away.mean(), rel=0.03)
    assert first.mean_largest == pytest.approx(away.max(), rel=0.03)
    assert first.fractions[0] == pytest.approx(np.mean(away < 15.0), abs=0.02)
    assert mean.mean < first.mean
    assert mean.mean_largest < first.mean_largest
    assert first.fractions.sum() == pytest.approx(1.0)
    # A warm-up leaves its start quickly and stays near its end.
    assert first.fractions[0] < last.fractions[0]


def test_correlations_over_time_are_about_each_series_mean(warm_up):
    made = warm_up(drift={"x0": 0.02, "y0": -0.02})
    r = correlations_over_time([made("M1"), made("M2")])
    assert r[1, 2] == pytest.approx(-1.0, abs=1e-3)
    assert np.isnan(r[IOP_NAMES.index("A3"), 1])  # held
    # Two series at different levels: what lies between them is no correlation.
    still = warm_up(drift={})
    one, other = still("M1"), still("M2")
    other.values[:, 1:3] += 1.0
    assert abs(correlations_over_time([one, other])[1, 2]) < 0.3


def test_the_summary_says_what_the_draws_are_and_what_the_camera_did(warm_up):
    camera = study_camera("nexus", [warm_up()()], StudySettings(sets=500))
    text = " ".join(answer_sentences(camera))
    assert "drawn from independent normal distributions about the series' mean" in text
    assert "along its own path" in text
    assert "x₀ and y₀ −0.999" in text or "x₀ and y₀ −1" in text


def test_a_camera_that_heats_and_cools_is_told_by_its_range(warm_up):
    """The change from first to last is nothing; the text must not say that nothing changed."""
    make = warm_up()
    warm = make()
    up_and_down = np.concatenate([np.arange(75), np.arange(75)[::-1]])
    thermometer = warm.thermometers[0]
    cycle = make(
        values=warm.values[up_and_down],
        thermometers=(type(thermometer)("temperature", thermometer.values[up_and_down], 0.05),),
    )
    camera = study_camera("rpi", [cycle], StudySettings(sets=500))
    change = camera.series[0].deviations
    assert change["c"].range > 0.006
    text = answer_sentences(camera)[1]
    assert "did not change" not in text
    assert "the principal distance grew by up to" in text
    assert "ended where it started" in text
    assert "temperature rose by up to 1" in text
