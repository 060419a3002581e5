"""One series studied: what it finds, and that it says in words what it cannot."""

import numpy as np
import pytest

from thermocald.analysis.study.measured import Thermometer
from thermocald.analysis.study.series_study import StudySettings, study_series
from thermocald.analysis.study.study import study

SETTINGS = StudySettings(sets=2000)


def select(series, rows):
    """The series with only some epochs."""
    from dataclasses import replace

    return replace(
        series,
        number=series.number[rows],
        time_s=series.time_s[rows],
        values=series.values[rows],
        sds=series.sds[rows],
        sigma0=series.sigma0[rows],
        redundancy=series.redundancy[rows],
        correlations=series.correlations[rows],
        thermometers=tuple(Thermometer(t.name, t.values[rows], t.sd) for t in series.thermometers),
    )


def test_a_warm_up_is_found_where_it_was_put_and_only_there(warm_up):
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


def test_parameters_held_fixed_are_named_and_absent(warm_up):
    found = study_series(warm_up()(), SETTINGS)
    assert "A3, C1, C2 were held fixed" in " ".join(found.notes)
    for part in (found.deviations, found.significance, found.channels[0].dependences):
        assert not {"A3", "C1", "C2"} & set(part)


def test_a_single_epoch_says_so_and_computes_nothing(warm_up):
    result = study([warm_up(epochs=1)()], SETTINGS).cameras[0]
    one = result.series[0]
    assert "a single epoch: nothing can be said about change" in " ".join(one.notes)
    assert "The F-test needs 31 consecutive epochs; the series has 1" in " ".join(one.notes)
    assert not one.deviations
    assert not one.significance
    assert result.montecarlo is None
    assert "No Monte-Carlo" in " ".join(result.notes)


@pytest.mark.parametrize(
    ("temperature", "words"),
    [
        (np.full(150, 25.0), "stayed at 25.00 °C"),
        (25 + 0.05 * np.random.default_rng(1).standard_normal(150), "which its noise of 0.050 K"),
        (np.full(150, np.nan), "has too few readings (0)"),
    ],
    ids=["constant", "noise only", "never read"],
)
def test_a_temperature_that_says_nothing(warm_up, temperature, words):
    series = warm_up()(thermometers=(Thermometer("temperature", temperature, 0.05),))
    found = study_series(series, SETTINGS)
    assert words in " ".join(found.notes)
    assert not found.channels[0].dependences
    column = found.columns.index("temperature")
    if words.startswith(("stayed", "was")):
        assert np.isnan(found.matrix[column]).all()


def test_gaps_are_said_and_not_tested_across(warm_up):
    series = select(warm_up()(), np.r_[0:60, 100:150])
    found = study_series(series, SETTINGS)
    assert "1 gap, the longest of 410 s at an interval of 10 s" in " ".join(found.notes)
    assert found.significance["c"].tests == 30 + 20


def test_missing_temperatures_leave_out_their_epochs_only(warm_up):
    series = warm_up()()
    values = series.thermometers[0].values.copy()
    values[40:50] = np.nan
    from dataclasses import replace

    found = study_series(
        replace(series, thermometers=(Thermometer("temperature", values, 0.05),)), SETTINGS
    )
    assert found.channels[0].dependences["x0"].n == 140
    assert abs(found.channels[0].dependences["x0"].r) > 0.99


def test_lost_epochs_are_counted_by_reason(warm_up):
    found = study_series(warm_up()(without_result={"too few targets": 7}), SETTINGS)
    assert "7 of 157 epochs have no result (7 × too few targets)." in found.notes


def test_a_parameter_that_never_changed_is_no_dependence(warm_up):
    series = warm_up()()
    series.values[:, 3] = series.values[0, 3]
    found = study_series(series, SETTINGS)
    assert "A1" not in found.channels[0].dependences
    assert found.deviations["A1"].change == 0
