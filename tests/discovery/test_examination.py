"""Names, no false names, and alternatives in a few blind recordings; tests/blind has many."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from tests.marks import mostly_slow
from thermocald.discovery.entries import estimate_term
from thermocald.discovery.evidence import find_displaced_targets
from thermocald.discovery.result import build_model, discover_series, estimate_first
from thermocald.discovery.search import Search
from thermocald.discovery.validation import compare_with_surrogates
from thermocald.output.discovery import report_html
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.noise import calibrate_thermometers, weight_slow_noise
from thermocald.thermal.reduce import reduce_series, reduce_together
from thermocald.thermal.series import in_blocks

KEYS = {
    "effect",
    "statement",
    "where",
    "estimates",
    "evidence",
    "alternatives",
    "gap_before",
    "gap_after",
}


NAMED = ("thermal_lag", "softening", "housing_tilt", "target_displacement", "defocus")


@pytest.mark.parametrize("effect", mostly_slow(NAMED, "target_displacement", "defocus"))
def test_a_hidden_effect_is_named(evidence_of, effect):
    evidence, _ = evidence_of(effect, px=0.1, seed=21, epochs=90)

    found = discover_series(evidence)

    assert found.verdict == "effects_found"
    assert [e.effect for e in found.effects] == [effect]


def test_no_effect_no_name(evidence_of):
    evidence, _ = evidence_of(seed=23, epochs=90)
    found = discover_series(evidence)
    assert (found.verdict, found.effects) == ("adequate", ())


def test_recordings_of_two_cameras_contradict_each_other():
    """M2 is of another camera of the same type; M1 alone lacks no effect."""
    cases = (Case((), seed=n, epochs=50, camera="rpi-v2.1", with_m2=False) for n in (3, 5))

    found = discover_series(reduce_together([series_input(generate(c)[0][0]) for c in cases]))

    assert found.headline == "unexplained: unnamed"
    assert found.effects[0].statement.startswith("the recordings contradict each other: the model")
    assert "bridge" not in found.effects[0].evidence
    assert found.stages[-1].fit.chi2_reduced == pytest.approx(1.0, abs=0.06)


def test_epochs_with_few_targets_have_no_weight(evidence_of):
    """Three epochs show eight targets; the image moves so far that the projection is curved."""
    (series,), _ = evidence_of("permanent_set", px=8.0, seed=1, epochs=60, with_m2=False)
    hidden = np.zeros(series.source.grid.observed.shape, dtype=bool)
    hidden[30:33, 8:] = True
    source = replace(series.source, grid=series.source.grid.reject(hidden))

    found = discover_series([reduce_series(source)])

    assert [e.effect for e in found.effects] == ["permanent_set"]
    assert found.stages[-1].fit.chi2_reduced == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [24, 26])
def test_an_outside_influence_gets_no_name(evidence_of, seed):
    """Its size is the image's movement, its parameters are those that moved."""
    evidence, truth = evidence_of("outside", px=0.3, seed=seed, with_m2=False)
    found = discover_series(evidence)
    size = found.effects[0].estimates["size"]["value"]
    assert size == pytest.approx(0.3, rel=0.05)
    moved = {k.removeprefix("a_") for k in truth["effects"][0][0] if k.startswith("a_")}
    assert found.effects[0].where["parameters"]
    assert set(found.effects[0].where["parameters"]) <= moved
    assert found.verdict == "unexplained"
    assert [e.effect for e in found.effects] == ["unnamed"]
    assert found.effects[0].evidence["bridge"]["transferable"] is False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "px", "seed"),
    [("thermal_lag", 0.03, 0), ("time_offset", 0.3, 321)],  # small; under a steady ramp
)
def test_a_lag_and_a_delay_that_do_the_same_stay_alternatives(evidence_of, effect, px, seed):
    evidence, truth = evidence_of(effect, px=px, seed=seed)
    assert truth["effects"][0][0].get("tau", 0.0) < 3
    found = discover_series(evidence)
    names = {found.effects[0].effect, *found.effects[0].alternative_names}
    assert {"thermal_lag", "time_offset"} <= names
    assert "experiment" in found.effects[0].alternatives[0]


@pytest.mark.slow
def test_a_delay_is_no_lag_because_the_temperature_was_smooth(evidence_of):
    """A lag smooths the thermometer's noise, so that a smooth image would favour it: d is 10 s."""
    evidence, _ = evidence_of("time_offset", px=0.3, seed=330)
    found = discover_series(evidence)
    assert [e.effect for e in found.effects] == ["time_offset"]


@pytest.mark.slow
def test_a_play_shorter_than_an_interval_is_named(evidence_of):
    """The extreme is not read; taking the largest reading for it would exclude every play."""
    evidence, truth = evidence_of("hysteresis", px=0.1, seed=360)
    found = discover_series(evidence)
    assert [e.effect for e in found.effects] == ["hysteresis"]
    said = found.effects[0].estimates["half_width"]
    assert abs(said["value"] - truth["effects"][0][0]["half_width"]) < 3 * said["sd"]


def test_a_lag_as_long_as_the_series_has_no_delay_beside_it(evidence_of):
    """A time offset of so many seconds leaves one temperature, whose rates are not determined."""
    evidence, _ = evidence_of("thermal_lag", seed=31, epochs=90)
    search = Search(HypothesisFitter(evidence))
    lag = next(c for c in search.candidates if c.effect == "thermal_lag")
    found = search.refine((*search.base().terms, lag.term(904.0, 2)), (0.0, 0.0))
    assert dict(found.terms[-1].nonlinear)["tau"] > 800.0

    assert search.with_other_delay(found) is None


def test_document(evidence_of):
    evidence, truth = evidence_of("thermal_lag", seed=31, epochs=60)
    said: list[str] = []
    found = discover_series(evidence, said.append)
    document = found.as_dict()
    # the progress: each stage once, in order
    stages = ("targets that moved", "measuring noise", "base model", "effect 1")
    first = [next(i for i, line in enumerate(said) if line.startswith(s)) for s in stages]
    assert first == sorted(first)
    assert said.count("targets that moved") == 1
    assert list(document) == ["format", "verdict", "effects", "gap", "model", "doubts"]
    assert document["format"] == "thermocald-discovery/1"
    entry = document["effects"][0]
    assert set(entry) == KEYS
    assert set(entry["where"]) >= {"parameters", "epochs", "image_region"}
    tau = entry["estimates"]["tau"]
    assert abs(tau["value"] - truth["effects"][0][0]["tau"]) < 4 * tau["sd"]
    assert tau["unit"] == "s"
    for gap in (document["gap"]["fit"]["before"], document["gap"]["verify"]["after"]):
        assert set(gap) == {"rms_px", "chi2_reduced", "object_mm_at_10m"}
    page = report_html(found, "M1")  # the name, compared with noise
    assert "Could noise do this?" in page
    assert page.count("<figure") == 6
    assert "≤ 1/120" in page
    assert f"UTC, {len(evidence[0].source.frame_times)} epochs." in page
    assert "&lt;" not in page  # no object's repr in place of its text


@pytest.mark.slow
def test_a_drift_of_a_few_targets_is_not_the_camera(evidence_of):
    evidence, truth = evidence_of("target_displacement", px=0.05, seed=26)
    found = discover_series(evidence)
    true = truth["effects"][0][0]
    said = found.effects[0].estimates
    assert sorted(int(v) for v in said["targets"]["value"]) == [t + 1 for t in true["targets"]]
    assert said["time"]["value"] == pytest.approx(true["time"], abs=10)


def test_a_gross_error_near_the_end_is_no_target_that_moved(evidence_of):
    evidence = evidence_of(seed=26)[0][0]
    for epochs, moved in ((slice(-3, -2), 0), (slice(-4, None), 1)):
        residuals = evidence.residuals.copy()
        residuals[epochs, 30] += 1.0
        groups, _ = find_displaced_targets(replace(evidence, residuals=residuals))
        assert [g.rows.tolist() for g in groups] == [[30]] * moved


@pytest.mark.slow
def test_surrogates_tried_at_once_give_the_same_bits(evidence_of):
    evidence, _ = evidence_of("permanent_set", px=0.3, seed=22)
    search = Search(HypothesisFitter([in_blocks(e) for e in evidence]))
    base = search.base()
    best = search.expand(base, 3, -np.inf)[0]
    one, two = (
        compare_with_surrogates(search, best.fit, base, base.score - best.score, 20, jobs=jobs)
        for jobs in (1, 3)
    )
    np.testing.assert_array_equal(two.surrogates, one.surrogates)


@pytest.mark.parametrize("effect", mostly_slow(("defocus", "target_displacement"), "defocus"))
def test_an_effect_in_image_space_is_not_named_again(evidence_of, effect):
    """The model that a discovery wrote has it, and keeps it."""
    evidence, _ = evidence_of(effect, px=0.1, seed=21, epochs=60, with_m2=False)
    first = discover_series(evidence)
    model = build_model(first)
    assert [e.name for e in model.effects] == [effect]

    again = discover_series(evidence, given=model.effects)

    assert again.headline == "adequate"
    assert again.stages[0].fit.chi2_reduced == pytest.approx(1.0, abs=0.05)
    (kept,), (was,) = build_model(again, model).effects, model.effects
    assert list(kept.values) == list(was.values)
    for name, sd in was.sds.items():
        assert kept.values[name] == pytest.approx(was.values[name])
        assert kept.sds[name] == pytest.approx(sd)


@pytest.mark.slow
def test_a_poor_thermometer_does_not_lengthen_a_lag(evidence_of):
    """Its noise is 1 K; what smoothing leaves of it added a standard deviation to a lag."""
    off = []
    for seed in range(100, 105):
        more = {"thermometer_k": 1.0, "camera": "rpi-v2.1", "with_m2": False}
        evidence, truth = evidence_of("thermal_lag", seed=seed, **more)
        tau = truth["effects"][0][0]["tau"]
        fitter = HypothesisFitter(list(map(weight_slow_noise, calibrate_thermometers(evidence))))
        term = Term("thermal_lag", nonlinear=(("tau", tau),))
        _, fit = estimate_first(SimpleNamespace(fitter=fitter), [term])
        found = estimate_term(fit, 0, fitter.series[0])["tau"]
        off.append((found["value"] - tau) / found["sd"])
    assert abs(np.mean(off)) < 2 / np.sqrt(len(off))
    assert np.std(off) < 2
