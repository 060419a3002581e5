"""Formulas beyond the catalogue: only what follows a recorded quantity is described.

The influences are those of `tests.blind.outside`, which shares no code with the operators.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.analysis.test_thermal_model import for_fit, simulated
from tests.blind.bridge import generated
from tests.blind.case import OUTSIDE, Case
from tests.blind.outcome import excess_closed
from tests.blind.outside import HUMID
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.discovery.formulas import Library, condense
from thermocald.discovery.proposal import propose
from thermocald.discovery.result import discover_series
from thermocald.discovery.search import Search
from thermocald.physics.formula import Node
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Candidate, Term, parse_effect
from thermocald.thermal.noise import calibrate_thermometers, weight_slow_noise
from thermocald.thermal.reduce import reduce_together
from thermocald.thermal.scan import examine_all, scan_candidate
from thermocald.thermal.source import epochs_input

TEN = (
    "tanh", "sign_rate_square", "integral_above", "abs_rate", "two_lags", "product", "switch",
    "play_of_lag", "fading_peak", "time_times_T",
)  # fmt: skip


def reduced(kind: str, seed: int):
    case = Case((OUTSIDE,), 0.3, seed, influence=kind, record_humidity=kind in HUMID)
    return reduce_together(generated(case)[0])


def examined(kind: str, seed: int):
    """Return an examination of the base model's misfit without the catalogue's search."""
    ready = [weight_slow_noise(e) for e in calibrate_thermometers(reduced(kind, seed))]
    fitter = HypothesisFitter(ready)
    base = Search(fitter).base()
    adequacy = examine_all(fitter, base.fit)
    return SimpleNamespace(fitter=fitter, base=base, base_adequacy=adequacy)


@pytest.fixture(scope="module")
def above():
    return examined("integral_above", 41)


def test_an_integral_above_a_threshold_is_told_with_its_constant(above):
    found = propose(above, BASE)
    (term,) = found.best.terms
    assert term.effect == "integral(above(temperature, k))"
    assert dict(term.nonlinear)["k"] == pytest.approx(26.48, abs=0.2)
    assert min(found.closed) > 0.95
    assert found.surrogates.p < 0.01
    assert all(a.adequate for a in examine_all(found.best.fitter, found.best.fit))


def test_the_error_of_a_second_thermometer_is_part_of_the_noise(above):
    """Integrated out, it makes the coefficient less certain than the first one's error alone."""
    term = Term("product(temperature, board_temperature)", ("c",))
    fitter = HypothesisFitter(above.fitter.series)
    start = np.array([*above.base.fit.coefficients, 20.0])
    whole = fitter.fit((term,), start, 1)
    every = fitter.list_operators
    fitter.list_operators = lambda *given: (o for o in every(*given) if o[2] == "temperature")
    alone = fitter.fit((term,), start, 1)
    assert len(whole.weightings[0].errors) == len(alone.weightings[0].errors) + 1
    assert whole.covariance[-1, -1] > 1.05 * alone.covariance[-1, -1]


@pytest.mark.parametrize(
    ("text", "k"),
    [("above(temperature, k):k=90", 31.0), ("saturation(temperature, k, w):w=2", None)],
)
def test_a_formula_is_fitted_from_any_start(text, k):
    """Regression: k was searched between ±10⁹ °C, a second constant was forgotten."""
    s = simulated(1, listed=(ModelEffect("softening", {"T_k": 31.0, "x0": 4e-4}),))
    source = epochs_input(s.head, s.field, list(s.epochs()), s.programme.series)
    (effect,) = fit_thermal_model([for_fit(source)], [parse_effect(text)]).model.effects
    assert 20.0 < effect.values["k"] < 50.0
    if k:
        assert effect.values["k"] == pytest.approx(k, abs=3 * effect.sds["k"])
        assert effect.sds["k"] < 1.0


def test_one_recording_gets_no_formula(above):
    x = SimpleNamespace(**{**above.__dict__, "fitter": HypothesisFitter(above.fitter.series[:1])})
    assert propose(x, BASE) is None


def test_condensed_evidence_is_the_likelihood(above):
    """A trajectory gains the same in condensed rows as in the full normal equations."""
    few = condense(above.fitter, above.base.fit, BASE)
    library = Library(few.histories)
    node = library.offsets(library.reference)[0]
    whole = Node("integral", (Node("above", (library.reference,), (26.5,)),))
    gain = float(few.gains(library.values(whole)[:, None])[0])
    fit = above.fitter.fit(above.base.terms)
    structure, values = whole.named()
    candidate = Candidate(structure.text(), BASE, "k", np.array([values["k"]]))
    full = float(scan_candidate(above.fitter, candidate, fit).gains[0][0])
    assert gain == pytest.approx(full, rel=0.002)
    assert few.gains(library.values(node)[:, None])[0] < 1e-3 * gain  # T is in the base


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [*((kind, 52) for kind in TEN), ("lag_of_humidity", 31)])
def test_outside_effects_are_described(kind, seed):
    """A recorded humidity is a quantity, too."""
    found = propose(examined(kind, seed), BASE)
    assert found is not None
    assert found.closed[0] > 0.8
    if kind in HUMID:
        (term,) = found.best.terms
        assert term.effect == 'lag(column("humidity"), tau)'
        assert dict(term.nonlinear)["tau"] == pytest.approx(120.0, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smooth", "random_walk"])
def test_what_was_not_recorded_gets_no_formula(kind):
    assert propose(examined(kind, 33), BASE) is None


@pytest.mark.slow
def test_a_discovery_says_the_formula_and_the_gap_closes():
    found = discover_series(reduced("tanh", 52))
    (entry,) = found.effects
    assert (found.verdict, entry.effect) == ("unexplained", "unnamed")
    assert "tanh((T − " in entry.statement
    assert entry.evidence["proposal"]["transferable"] is True
    assert excess_closed(found) > 0.8
