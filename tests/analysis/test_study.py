"""Studies of series and cameras: results, and notes where there is no result."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.conftest import INTERIOR, NEXUS, SDS
from thermocald.analysis.camera.undistortion import directions, image_grid
from thermocald.analysis.study.measured import StudySettings, Thermometer
from thermocald.analysis.study.montecarlo import correlations_over_time, trajectories
from thermocald.analysis.study.study import (
    depth_of_field,
    deviation,
    image_displacement,
    study,
    study_camera,
    study_series,
)
from thermocald.output.study.report import answer_sentences
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, project

SETTINGS = StudySettings(sets=2000)
CLUSTERS = (15.0, 50.0, 100.0)


def test_a_warm_up_is_found_in_its_parameters_only(warm_up):
    found = study_series(warm_up()(), SETTINGS)
    change = found.deviations["x0"]
    expected = 0.0194 * (1 - np.exp(-1490 / 300))
    assert abs(change.change - expected) < 4 * change.sd_change
    channel = found.channels[0]
    assert min(abs(channel.dependences[n].r) for n in ("c", "x0", "y0")) > 0.99
    assert max(channel.dependences[n].p_holm for n in ("c", "x0", "y0")) < 1e-6
    assert min(channel.dependences[n].p_holm for n in ("A1", "A2", "B1", "B2", "sigma0")) > 0.01
    assert found.significance["x0"].success_ratio == 1.0
    assert found.significance["x0"].drift.p_value <= 0.001
    assert found.significance["B2"].drift.p_value > 0.01
    slope = channel.dependences["x0"]
    assert abs(slope.slope - 0.0194 / 12) < 4 * slope.sd_slope
    # parameters held fixed are named, and absent
    assert "A3, C1, C2 were held fixed" in " ".join(found.notes)
    for part in (found.deviations, found.significance, found.channels[0].dependences):
        assert not {"A3", "C1", "C2"} & set(part)


def test_a_series_that_holds_a_parameter_does_not_reduce_its_sd(warm_up):
    one, other = warm_up()("M1"), warm_up()("M2")
    k = IOP_NAMES.index("B1")
    values, sds = other.values.copy(), other.sds.copy()
    values[:, k], sds[:, k] = values[0, k], np.nan
    held = replace(other, values=values, sds=sds)
    both = study_camera("camera", [one, held], SETTINGS)
    assert both.sds[k] == pytest.approx(np.std(one.values[:, k], ddof=1))


def test_a_single_epoch_has_notes_and_no_results(warm_up):
    series = warm_up(epochs=1)()
    values = series.values.copy()
    result = study([series], SETTINGS).cameras[0]
    np.testing.assert_array_equal(series.values, values)
    (one,) = result.series
    assert "a single epoch: nothing can be said about change" in " ".join(one.notes)
    assert "The F-test needs 31 consecutive epochs; the series has 1" in " ".join(one.notes)
    assert one.deviations == one.significance == {}
    assert result.montecarlo is None
    assert "No Monte-Carlo" in " ".join(result.notes)


@pytest.mark.parametrize(
    ("temperature", "words"),
    [
        (np.full(150, 25.0), "stayed at 25.00 °C"),
        (25 + 0.05 * np.random.default_rng(1).standard_normal(150), "which its noise of 0.050 K"),
        (np.full(150, np.nan), "is known in 0 of 150 epochs"),
    ],
    ids=["constant", "noise only", "never read"],
)
def test_a_temperature_without_information(warm_up, temperature, words):
    series = warm_up()(thermometers=(Thermometer("temperature", temperature, 0.05),))
    found = study_series(series, SETTINGS)
    assert words in " ".join(found.notes)
    assert not found.channels[0].dependences
    column = found.columns.index("temperature")
    if words.startswith(("stayed", "was")):
        assert np.isnan(found.matrix[column]).all()


def test_gaps_are_reported_and_not_tested_across(warm_up):
    series, rows = warm_up()(), np.r_[0:60, 100:150]
    names = ("time_s", "values", "sds", "sigma0", "redundancy", "correlations")
    t = series.thermometers[0]
    kept = {"thermometers": (replace(t, values=t.values[rows]),)}
    kept |= {name: getattr(series, name)[rows] for name in names}
    found = study_series(replace(series, **kept), SETTINGS)
    assert "1 gap, the longest of 410 s at an interval of 10 s" in " ".join(found.notes)
    assert found.significance["c"].tests == 30 + 20


def test_only_epochs_with_missing_temperatures_are_left_out(warm_up):
    series = warm_up()(without_result={"too few targets": 7})
    values = series.thermometers[0].values.copy()
    values[40:50] = np.nan
    series.values[:, 3] = series.values[0, 3]
    found = study_series(
        replace(series, thermometers=(Thermometer("temperature", values, 0.05),)), SETTINGS
    )
    assert "7 of 157 epochs have no result (7 × too few targets)." in found.notes
    text = " ".join(answer_sentences(study_camera("c", [found.series], SETTINGS)))
    assert "while temperature (known in 140 of 150 epochs) changed by" in text
    # a constant parameter has no dependence
    assert "A1" not in found.channels[0].dependences
    assert found.deviations["A1"].change == 0
    assert found.channels[0].dependences["x0"].n == 140
    assert abs(found.channels[0].dependences["x0"].r) > 0.99


def test_series_of_a_label_are_pooled_as_one_camera(warm_up):
    pair = [warm_up(seed=k)("M1", "cold", source=f"/data/day{k}/M1") for k in (1, 2)]
    drift = {"c": 0.003, "x0": 0.0097, "y0": -0.0056}
    warm_one = warm_up(seed=3, drift=drift)("M1", "warm")
    cold, warm = study([*pair, warm_one], StudySettings(sets=5000)).cameras
    assert (cold.label, warm.label) == ("cold", "warm")
    # series of one name are named by their places
    assert [one.series.name for one in cold.series] == ["M1 in day1", "M1 in day2"]
    assert [one.series.name for one in warm.series] == ["M1"]
    assert cold.correlations.epochs == 300
    assert cold.sds[1] == pytest.approx(0.0194 * 0.2527, rel=0.01)
    assert warm.montecarlo.overall_mean < 0.6 * cold.montecarlo.overall_mean


def test_first_order_agrees_where_errors_are_small(warm_up):
    camera = study([warm_up()()], StudySettings(sets=50_000)).cameras[0]
    first, drawn = camera.montecarlo.first_order, camera.montecarlo
    np.testing.assert_allclose(first.mean, drawn.mean, rtol=0.02)
    np.testing.assert_allclose(first.fractions, drawn.fractions, atol=0.01)
    # maxima of 50,000 draws scatter by several per cent
    np.testing.assert_allclose(first.expected_largest, drawn.largest, rtol=0.2)
    # the draws give a variance to 0.6 %, a mean to 0.0045 sd
    variance = first.covariance[:, 0, 0]
    np.testing.assert_allclose(drawn.covariance[:, 0, 0], variance, rtol=0.03)
    assert np.linalg.norm(drawn.mean_error, axis=1).max() < 0.02 * np.sqrt(variance[0])


def test_a_shift_of_the_principal_point_moves_all_points_equally(warm_up):
    """A change of x0 alone moves every image point by D Δx0 / c, with little distortion."""
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
    # a warm-up leaves its start quickly and stays near its end
    assert first.fractions[0] < last.fractions[0]


def test_correlations_over_time_refer_to_each_series_mean(warm_up):
    made = warm_up(drift={"x0": 0.02, "y0": -0.02})
    r = correlations_over_time([made("M1"), made("M2")])
    assert r[1, 2] == pytest.approx(-1.0, abs=1e-3)
    assert np.isnan(r[IOP_NAMES.index("A3"), 1])  # held
    # a difference of levels between two series is no correlation
    still = warm_up(drift={})
    one, other = still("M1"), still("M2")
    other.values[:, 1:3] += 1.0
    assert abs(correlations_over_time([one, other])[1, 2]) < 0.3


def test_a_camera_that_heats_and_cools_is_described_by_its_range(warm_up):
    """The text does not claim that nothing changed, though last equals first."""
    warm = warm_up()()
    up_and_down = np.concatenate([np.arange(75), np.arange(75)[::-1]])
    thermometer = Thermometer("temperature", warm.thermometers[0].values[up_and_down], 0.05)
    cycle = replace(warm, values=warm.values[up_and_down], thermometers=(thermometer,))
    camera = study_camera("rpi", [cycle], StudySettings(sets=500))
    assert camera.series[0].deviations["c"].range > 0.006
    sentences = answer_sentences(camera)
    text = " ".join(sentences)
    assert "drawn normally about the series' mean with the correlations of an epoch's" in text
    assert "along its own path" in text
    assert "did not change" not in sentences[1]
    for words in ("the principal distance grew by up to", "ended where it started",
                  "temperature rose by up to 1"):  # fmt: skip
        assert words in sentences[1]


def test_a_nearly_steady_camera_is_described_by_numbers_that_hold(warm_up):
    """It moves by 4.5 standard deviations and back, and errs by less than 0.1 mm on the plane."""
    steady = warm_up(drift={}, kelvin=0.05, sds=SDS / 10)()
    steady.values[:, 1] += 6.3e-6 * (1 - np.abs(np.linspace(-1, 1, len(steady))))
    text = " ".join(answer_sentences(study_camera("rpi", [steady], StudySettings(sets=500))))
    farthest = np.hypot(*steady.path_px.T).max()
    assert float(re.search(r"stayed within (\S+) px", text)[1]) == pytest.approx(farthest, rel=0.05)
    assert re.search(r"errors of 0\.00\d\d+ cm on average and up to 0\.0\d\d+ cm", text)
    assert re.search(r"while temperature stayed within 0\.\d\d K\.", text)


def test_last_minus_first_ignores_missing_epochs():
    values = np.array([np.nan, 1.0, 5.0, 2.5, np.nan])
    found = deviation(values, np.array([9.0, 0.3, 9.0, 0.4, 9.0]))
    assert found is not None
    assert (found.first, found.last, found.change) == (1.0, 2.5, 1.5)
    assert found.sd_change == pytest.approx(0.5)
    assert found.largest == 4.0
    # a single value has no change
    assert deviation(np.array([np.nan, 1.0]), np.ones(2)) is None


def displacement(series, first, later):
    """Return the displacement of the image grid between two interior orientations."""
    return image_displacement(replace(series, values=np.array([first, later])), image_grid(NEXUS))


def test_displacements_by_principal_point_and_principal_distance(warm_up):
    first = np.array([3.97, 0.01, -0.02, 5e-3, -4e-4, 0, 1e-4, -1e-4, 0, 0])
    later = first + np.array([0, 10.0, 5.0, *[0] * 7]) * 0.0014
    moved, _ = displacement(warm_up()(), first, later)
    np.testing.assert_allclose(moved, np.tile([10.0, -5.0], (9, 1)), atol=1e-6)
    first = np.array([3.97, 0, 0, 0, 0, 0, 0, 0, 0, 0.0])
    moved, _ = displacement(warm_up()(), first, 1.002 * first)
    np.testing.assert_allclose(moved, 0.002 * (image_grid(NEXUS) - NEXUS.centre), atol=1e-9)


def test_the_covariance_of_displacements_is_their_scatter(warm_up):
    series = warm_up(drift={}, epochs=2)()
    _, covariance = image_displacement(series, image_grid(NEXUS))

    rng = np.random.default_rng(9)
    sds = np.nan_to_num(series.sds[0])
    of_epoch = series.correlations[0] * np.outer(sds, sds)
    later = rng.multivariate_normal(INTERIOR, 2 * of_epoch, 2000)  # of two independent epochs
    grid = image_grid(NEXUS)
    scene = directions(NEXUS, INTERIOR, grid)
    moved = project(NEXUS, later, np.zeros((len(later), 6)), scene) - grid

    found = np.einsum("nki,nkj->kij", moved, moved) / len(moved)
    # 2000 draws give a variance to 3 %
    scale = np.sqrt(np.einsum("kii->ki", covariance))
    assert np.all(np.abs(found - covariance) < 0.15 * scale[:, :, None] * scale[:, None, :])


def test_without_covariances_there_is_a_note_instead_of_a_monte_carlo(warm_up):
    series = warm_up()(correlations=np.empty((0, 10, 10)))
    camera = study([series], StudySettings(sets=100)).cameras[0]
    assert camera.montecarlo is camera.series[0].displacement_covariance is None
    assert "No epoch has a covariance matrix" in " ".join(camera.notes)


@pytest.mark.parametrize("drift", [{}, {"x0": 1e-3}])
def test_errors_on_the_plane_that_are_the_epochs_noise_are_told(warm_up, drift):
    notes = " ".join(study([warm_up(drift)()], SETTINGS).cameras[0].notes)
    assert ("mostly the noise of an epoch's calibration" in notes) == (not drift)


def blur(f, f_number, focus, distance):
    """Return the diameter of the blur circle of a thin lens."""
    image, other = (f * s / (s - f) for s in (focus, distance))
    return f / f_number * abs(other - image) / other


def test_limits_of_the_depth_of_field_have_the_permitted_blur():
    near, far = depth_of_field(3.97, 1000.0, 2.4, 0.0029)
    assert blur(3.97, 2.4, 1000.0, near) == pytest.approx(0.0029, rel=1e-9)
    assert blur(3.97, 2.4, 1000.0, far) == pytest.approx(0.0029, rel=1e-9)
    # beyond the hyperfocal distance
    assert np.isinf(depth_of_field(3.04, 3000.0, 2.0, 0.003)[1])
    with pytest.raises(ValueError, match="no depth of field"):
        depth_of_field(3.97, 3.0, 2.0, 0.003)  # a focus inside the lens
