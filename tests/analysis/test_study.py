"""Studies of series and cameras: input, results, and notes where there is no result."""

import re
from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from tests.analysis.conftest import INTERIOR, NEXUS, SDS
from thermocald.analysis.camera.undistortion import directions, image_grid
from thermocald.analysis.study.measured import StudySettings, Thermometer
from thermocald.analysis.study.montecarlo import trajectories
from thermocald.analysis.study.study import (
    depth_of_field,
    image_displacement,
    study,
    study_camera,
    study_series,
)
from thermocald.errors import DataError, UsageError
from thermocald.output.study.figures import study_figures
from thermocald.output.study.report import answer_sentences, detail_sentences, rate_in_px_and_mm
from thermocald.output.study.tables import object_space_tables
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor, project
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult

SETTINGS = StudySettings(sets=2000)
FREE = ("c", "x0", "y0", "A1", "A2", "B1", "B2")


@pytest.fixture
def recording(tmp_path):
    """Write ten epochs of a warm phone, of which two have too few or no observations."""
    tc.simulate("nexus5-warm", seed=1, epochs=10, out=tmp_path / "rec")
    file = tmp_path / "rec" / "observations.csv"
    lines = [line for line in file.read_text().splitlines() if not line.startswith("3,")]
    few = [line for line in lines if line.startswith("7,")][3:]
    file.write_text("\n".join([line for line in lines if line not in few]) + "\n")
    return tmp_path / "rec"


def test_epochs_without_a_result_are_counted(recording):
    series = tc.open(recording).measured(free=FREE, exterior="series")
    interval = tc.open(recording).head.interval
    assert np.rint(series.time_s / interval).tolist() == [0, 1, 3, 4, 5, 7, 8, 9]
    assert sum(series.without_result.values()) == 2
    assert (series.free, series.exterior) == (FREE, "series")
    # DESIGN idea 3: thousandths of a pixel with one exterior orientation
    assert series.sds[0, 1] / series.sensor.pixel_pitch < 0.01
    assert series.correlations.shape == (8, 10, 10)
    assert [t.name for t in series.thermometers] == ["temperature", "board_temperature"]
    assert 0.02 < series.thermometers[0].sd < 0.12
    given = tc.open(recording).measured(thermometer_sd=0.25, free=FREE)
    assert [t.sd for t in given.thermometers] == [0.25, 0.25]


def test_a_store_is_read_in_columns_without_broken_epochs(recording, tmp_path):
    opened = open_recording(recording)
    covariance = np.diag(np.append(np.full(8, 1e-8), np.zeros(8)))
    broken = covariance.copy()
    broken[1, 1] = -1e-12
    values = np.arange(16.0)
    with Store.open(tmp_path / "s.db", "append", durable=False) as store:
        stored = store.create_series(opened.head, opened.testfield, start="warm")
        for epoch in opened.epochs:
            result = EpochResult("ok", "", values + epoch.number, covariance, 1.0, 200, 100)
            if epoch.number == 5:
                result = replace(result, covariance=broken)
            if epoch.number == 6:
                result = EpochResult("too_few_targets", "3 targets")
            store.append(stored, epoch, result)
    series = tc.open(tmp_path / "s.db").measured(exterior="per_epoch")
    assert series.label == "nexus5-warm"
    assert series.without_result == {"too few targets": 1, "no standard deviation": 1}
    numbers = [1, 2, 3, 4, 7, 8, 9, 10]
    np.testing.assert_array_equal(series.values, values[:10] + np.array(numbers)[:, None])
    assert series.free == IOP_NAMES[:8]
    assert len(series.correlations) == 8
    assert series.redundancy.tolist() == [200] * 8


def test_a_store_without_any_result_is_refused(recording, tmp_path):
    opened = open_recording(recording)
    with Store.open(tmp_path / "s.db", "append", durable=False) as store:
        stored = store.create_series(opened.head, opened.testfield)
        store.append(stored, opened.epochs[0], EpochResult("weak_geometry", "one plane"))
    with pytest.raises(DataError, match=r"no epoch has a result \(1 × weak geometry\)"):
        tc.open(tmp_path / "s.db").measured(exterior="per_epoch")
    with Store.open(tmp_path / "empty.db", "append", durable=False):
        pass
    with pytest.raises(DataError, match="holds no series"):
        tc.open_all(tmp_path / "empty.db")


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
    half = 0.5 * NEXUS.width * NEXUS.pixel_pitch / INTERIOR[0]
    at_edge = rate_in_px_and_mm(found, "c", 1e-3, 1e4)[1]  # X = D x' / c
    assert at_edge == pytest.approx(1e-3 * 1e4 / INTERIOR[0] * half, rel=0.01)
    assert found.focus.confusion == pytest.approx(4080 * NEXUS.pixel_pitch / 2000)
    slope = channel.dependences["x0"]
    assert abs(slope.slope - 0.0194 / 12) < 4 * slope.sd_slope
    # parameters held fixed are named, and absent
    assert "A3, C1, C2 were held fixed" in " ".join(found.notes)
    for part in (found.deviations, found.significance, found.channels[0].dependences):
        assert not {"A3", "C1", "C2"} & set(part)


INDEFINITE = np.eye(10)
"""No correlation matrix: its smallest eigenvalue is negative."""
INDEFINITE[0, 1] = INDEFINITE[1, 0] = INDEFINITE[1, 2] = INDEFINITE[2, 1] = 0.95
INDEFINITE[0, 2] = INDEFINITE[2, 0] = 0.2


def with_temperature(series, temperature):
    """Return the series with other readings of its thermometer."""
    return replace(series, thermometers=(Thermometer("temperature", temperature, 0.05),))


def with_a_gap(series):
    rows = np.r_[0:60, 100:150]
    names = ("time_s", "values", "sds", "sigma0", "redundancy", "correlations")
    kept = replace(series, **{name: getattr(series, name)[rows] for name in names})
    return with_temperature(kept, series.thermometers[0].values[rows])


@pytest.mark.parametrize(
    ("options", "change", "words", "lacks"),
    [
        pytest.param({"epochs": 1}, lambda s: s, "a single epoch: nothing can be said about change"
                     ".*The F-test needs 31 consecutive epochs; the series has 1",
                     {"dependence", "drift", "Monte-Carlo"}, id="a single epoch"),
        pytest.param({}, lambda s: with_temperature(s, np.full(150, 25.0)), "stayed at 25.00 °C",
                     {"dependence"}, id="constant temperature"),
        pytest.param({}, lambda s: with_temperature(s, 25 + 0.05 * np.sin(np.arange(150.0))),
                     "which its noise of 0.050 K", {"dependence"}, id="only noise"),
        pytest.param({}, lambda s: with_temperature(s, np.full(150, np.nan)),
                     "is known in 0 epochs", {"dependence"}, id="never read"),
        pytest.param({}, with_a_gap, "1 gap, the longest of 410 s at an interval of 10 s", set(),
                     id="a gap"),
        pytest.param({}, lambda s: replace(s, correlations=np.empty((0, 10, 10))),
                     "No epoch has a covariance matrix", {"Monte-Carlo"}, id="no covariance"),
        pytest.param({}, lambda s: replace(s, correlations=np.tile(INDEFINITE, (150, 1, 1))),
                     "A3, C1, C2 were held fixed", set(), id="an indefinite matrix of medians"),
        pytest.param({"sds": SDS + 0.02 * np.eye(10)[3]}, lambda s: s,
                     r"\d of 2000 drawn interior orientations fold", set(), id="folded images"),
        pytest.param({}, lambda s: replace(s, values=s.values - 0.2 * np.eye(10)[3]),
                     "No Monte-Carlo: .*no ray", {"Monte-Carlo"}, id="a camera without rays"),
        pytest.param({"drift": {}}, lambda s: s, "mostly the noise of an epoch's calibration",
                     set(), id="nothing but noise"),
        pytest.param({}, lambda s: replace(s, c_known_to=0.03), r"The field determines c only to "
                     r"3.00 %, .* error: up to \d\d", set(), id="c hardly known"),
    ],
)  # fmt: skip
def test_what_the_data_do_not_allow_is_said(warm_up, options, change, words, lacks):
    camera = study([change(warm_up(**options)())], SETTINGS).cameras[0]
    (one,) = camera.series
    assert re.search(words, " ".join([*camera.notes, *one.notes]))
    absent = {
        "dependence": not one.channels[0].dependences, "drift": not one.significance,
        "Monte-Carlo": camera.montecarlo is None,
    }  # fmt: skip
    assert {part for part, missing in absent.items() if missing} == lacks
    if "gap" in words:
        assert one.significance["c"].tests == 30 + 20


@pytest.mark.parametrize(("epochs", "stated"), [(32, ""), (150, "scatter 1.60 ± 0.20 times")])
def test_only_a_scatter_beyond_chance_is_stated(warm_up, epochs, stated):
    """Of 32 epochs, a ratio of 1.18 by chance was."""
    series = warm_up(epochs=epochs, seed=2)()
    noisy = replace(series, sds=series.sds / 1.5) if stated else series
    text = " ".join(detail_sentences(study_camera("c", [noisy], SETTINGS)))
    assert stated in text if stated else "scatter" not in text


def test_only_epochs_with_missing_temperatures_are_left_out(warm_up):
    series = warm_up()(without_result={"too few targets": 7})
    temperature = series.thermometers[0].values.copy()
    temperature[40:50] = np.nan
    series.values[:, 3] = series.values[0, 3]
    found = study_series(with_temperature(series, temperature), SETTINGS)
    assert "7 of 157 epochs have no result (7 × too few targets)." in found.notes
    text = " ".join(answer_sentences(study_camera("c", [found.series], SETTINGS), 1e4))
    assert "while the temperature, known in 140 of 150 epochs, changed by" in text
    # a constant parameter has no dependence
    assert "A1" not in found.channels[0].dependences
    assert (found.deviations["A1"].change, found.significance["A1"].drift) == (0, None)
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
    variances = [np.var(one.values[:, 1], ddof=1) for one in pair]
    assert cold.sds[1] == pytest.approx(np.sqrt(np.mean(variances)))
    assert warm.montecarlo.overall_mean < 0.6 * cold.montecarlo.overall_mean
    with pytest.raises(UsageError, match=r"^cold: its series have different sensors"):
        study([pair[0], replace(pair[1], sensor=Sensor(640, 480, 0.006))], SETTINGS)
    # one that holds a parameter does not reduce its sd
    one, other = pair
    k = IOP_NAMES.index("B1")
    values, sds = other.values.copy(), other.sds.copy()
    values[:, k], sds[:, k] = values[0, k], np.nan
    both = study_camera("camera", [one, replace(other, values=values, sds=sds)], SETTINGS)
    assert both.sds[k] == pytest.approx(np.std(one.values[:, k], ddof=1))


def test_first_order_agrees_where_errors_are_small(warm_up):
    camera = study([warm_up()()], StudySettings(sets=50_000)).cameras[0]
    first, drawn = camera.montecarlo.first_order, camera.montecarlo
    assert "mostly the noise" not in " ".join(camera.notes)
    np.testing.assert_allclose(first.mean, drawn.mean, rtol=0.02)
    np.testing.assert_allclose(first.fractions, drawn.fractions, atol=0.01)
    outline = study_figures(camera)["object-space-errors"].panels[0].curves[-1]
    xy = 10 * np.array([outline.x, outline.y])
    inside = np.sum(xy * np.linalg.solve(first.covariance[0], xy), axis=0)
    np.testing.assert_allclose(1 - np.exp(-inside / 2), 0.95, rtol=1e-3)
    tall = replace(drawn, covariance=np.tile(np.diag([1.0, 4.0]), (9, 1, 1)))
    assert object_space_tables(replace(camera, montecarlo=tall))[1].rows[0][6] == "90°"
    # maxima of 50,000 draws scatter by several per cent
    np.testing.assert_allclose(first.expected_largest, drawn.largest, rtol=0.2)
    # the draws give a variance to 0.6 %, a mean to 0.0045 sd
    variance = first.covariance[:, 0, 0]
    np.testing.assert_allclose(drawn.covariance[:, 0, 0], variance, rtol=0.03)
    assert np.linalg.norm(drawn.mean_error, axis=1).max() < 0.02 * np.sqrt(variance[0])


def test_a_shift_of_the_principal_point_moves_all_points_equally(warm_up):
    """A change of x0 alone moves every image point by D Δx0 / c, with little distortion."""
    series = warm_up(drift={"x0": 0.0194}, sds=np.full(10, 1e-12))()
    first, mean, last = trajectories([series], 10_000.0, 3, (15.0, 50.0, 100.0))
    jump = replace(series, values=series.values[[0, 0, -1]], time_s=series.time_s[:3])
    of_first, _, of_last = trajectories([jump], 10_000.0, 3, (15.0,))
    assert of_last.mean == pytest.approx(2 * of_first.mean, rel=0.03)
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


def test_a_camera_that_heats_and_cools_is_described_by_its_range(warm_up):
    """The text does not claim that nothing changed, though last equals first."""
    warm = warm_up()()
    up_and_down = np.concatenate([np.arange(75), np.arange(75)[::-1]])
    cycle = replace(warm, values=warm.values[up_and_down])
    cycle = with_temperature(cycle, warm.thermometers[0].values[up_and_down])
    camera = study_camera("rpi", [cycle], StudySettings(sets=500))
    assert camera.series[0].deviations["c"].range > 0.006
    # regression: rates were those at 10 m where nothing was simulated
    assert "; at 2 m " in answer_sentences(replace(camera, montecarlo=None), 2e3)[0]
    sentences = answer_sentences(camera, 1e4)
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
    text = " ".join(answer_sentences(study_camera("rpi", [steady], StudySettings(sets=500)), 1e4))
    farthest = np.hypot(*steady.path_px.T).max()
    assert float(re.search(r"stayed within (\S+) px", text)[1]) == pytest.approx(farthest, rel=0.05)
    assert re.search(r"errors of 0\.00\d\d+ cm on average and up to 0\.0\d\d+ cm", text)
    assert re.search(r"while the temperature stayed within 0\.\d\d K\.", text)
    steady.values[:, 1] += np.linspace(0.0, 2.0 * SDS[1], len(steady))  # 14 of its sds
    (change,) = answer_sentences(study_camera("rpi", [steady], StudySettings(sets=500)), 1e4)[:1]
    assert "the principal point moved by" in change


def test_the_covariance_of_displacements_is_their_scatter(warm_up):
    series, grid = warm_up(drift={}, epochs=2)(), image_grid(NEXUS)
    _, covariance = image_displacement(series, grid)
    sds = np.nan_to_num(series.sds[0])
    of_epoch = series.correlations[0] * np.outer(sds, sds)
    # of two epochs, independent or with errors of opposite signs: these were left out
    _, opposed = image_displacement(replace(series, slow=2 * of_epoch), grid)
    np.testing.assert_allclose(opposed, 2 * covariance)
    later = np.random.default_rng(9).multivariate_normal(INTERIOR, 2 * of_epoch, 2000)
    scene = directions(NEXUS, INTERIOR, grid)
    moved = project(NEXUS, later, np.zeros((len(later), 6)), scene) - grid
    found = np.einsum("nki,nkj->kij", moved, moved) / len(moved)
    # 2000 draws give a variance to 3 %
    scale = np.sqrt(np.einsum("kii->ki", covariance))
    assert np.all(np.abs(found - covariance) < 0.15 * scale[:, :, None] * scale[:, None, :])


def test_limits_of_the_depth_of_field_have_the_permitted_blur():
    """Of a thin lens; there is no far one beyond the hyperfocal distance."""
    f, f_number, focus, permitted = 3.97, 2.4, 1000.0, 0.0029
    for limit in depth_of_field(f, focus, f_number, permitted):
        image, other = (f * s / (s - f) for s in (focus, limit))
        blur = f / f_number * abs(other - image) / other
        assert blur == pytest.approx(permitted, rel=1e-9)
    assert np.isinf(depth_of_field(3.04, 3000.0, 2.0, 0.003)[1])
    with pytest.raises(ValueError, match="no depth of field"):
        depth_of_field(3.97, 3.0, 2.0, 0.003)  # a focus inside the lens
