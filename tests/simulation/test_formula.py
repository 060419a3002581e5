"""Formulas: parsed from text, never executed; values as by numpy, errors propagated."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from tests.blind.world import backlash
from thermocald.errors import ConfigurationError, DataError
from thermocald.physics import catalogue
from thermocald.physics.effect import Effect
from thermocald.physics.formula import known_together, parse
from thermocald.physics.history import History
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import read_effects, write_effects
from thermocald.physics.operators import OPERATORS, averaged_lag_matrix, lag_matrix
from thermocald.physics.presets import preset_simulation

SECONDS = np.arange(1200.0)
T = 25.0 + 8.0 * np.sin(SECONDS / 190.0) + 3.0 * np.sin(SECONDS / 47.0)
B = 31.0 + 6.0 * np.cos(SECONDS / 120.0)


@pytest.fixture
def history():
    """Return a history read every second, evaluated every 10 s, with a column of humidity."""
    frames = SECONDS[::10]
    return History(
        frames, SECONDS, {"temperature": T, "board": B}, "temperature", 25.0,
        {"humidity": (frames, 50.0 + frames / 100.0)},
    )  # fmt: skip


def stepped(x, tau, fading=False):
    """Compute a lag, or a fading peak, second by second."""
    out, state = [], x[0]
    for v in x:
        state = v if fading and v > state else v + (state - v) * np.exp(-1.0 / tau)
        out.append(state)
    return np.array(out)


CASES = {
    "integral(above(temperature, k))": ({"k": 27.0}, np.cumsum(np.clip(T - 27.0, 0, None))),
    "signed_square(rate(temperature))": ({}, np.gradient(T) * np.abs(np.gradient(T))),
    "magnitude(rate(temperature))": ({}, np.abs(np.gradient(T))),
    "lag(lag(temperature, tau), tau_2)": (
        {"tau": 40.0, "tau_2": 90.0}, stepped(stepped(T, 40.0), 90.0)),
    "product(offset(temperature, a), board)": ({"a": 20.0}, (T - 20.0) * B),
    "product(time, temperature)": ({}, SECONDS * T),
    "saturation(temperature, k, w)": ({"k": 26.0, "w": 3.0}, np.tanh((T - 26.0) / 3.0)),
    "power(above(temperature, k), p)": ({"k": 22.0, "p": 0.5}, np.clip(T - 22.0, 0, None) ** 0.5),
    "peak(temperature, tau)": ({"tau": 150.0}, stepped(T, 150.0, fading=True)),
    "maximum(lag(board, tau))": ({"tau": 30.0}, np.maximum.accumulate(stepped(B, 30.0))),
    "square(change(board))": ({}, (B - B[0]) ** 2),
    "minimum(temperature)": ({}, np.minimum.accumulate(T)),
    "cube(offset(temperature, a))": ({"a": 25.0}, (T - 25.0) ** 3),
    "square(wave(temperature, P, phase))": (
        {"P": 7.0, "phase": 0.4}, np.sin(2 * np.pi * T / 7.0 + 0.4) ** 2),
    "exponential(temperature, w)": ({"w": 9.0}, np.exp(T / 9.0)),
    'product(column("humidity"), temperature)': ({}, (50.0 + SECONDS / 100.0) * T),
    "play(temperature, r)": ({"r": 1.5}, backlash(T, 1.5)),  # of the blind generator
}  # fmt: skip


@pytest.mark.parametrize("text", CASES)
def test_a_formula_equals_numpy_and_its_sensitivity_differences(history, text):
    values, expected = CASES[text]
    effect = catalogue.get(text)
    found = effect.signal(history, **values)[:, 0]
    # rates are from parabolas, one-sided at the ends
    assert found[1:-1] == pytest.approx(expected[::10][1:-1], abs=0.012 * np.ptp(expected))
    short = History(
        history.times[:20], SECONDS[:190:10] + 3.0,
        {n: r[:190:10] for n, r in history.readings.items()}, "temperature", 25.0, history.columns,
    )  # fmt: skip
    mine = effect.sensitivity(short, **values).toarray()
    by_differences = Effect.sensitivity(effect, short, **values).toarray()
    assert mine == pytest.approx(by_differences, abs=0.07 * np.abs(by_differences).max())
    assert parse(text).text() == text
    bound = parse(text).bound(values)
    assert parse(bound.text()) == bound


def test_a_product_of_two_thermometers_propagates_the_errors_of_both(history):
    """The variance from both matrices is the scatter with noisy readings."""
    effect = catalogue.get("product(offset(temperature, a), board)")
    sd = {"temperature": 0.05, "board": 0.15}
    rng = np.random.default_rng(3)
    drawn = [
        effect.signal(replace(history, readings={
            n: r + rng.normal(0, sd[n], len(r)) for n, r in history.readings.items()
        }), a=20.0)[:, 0]
        for _ in range(400)
    ]  # fmt: skip
    matrices = effect.sensitivities(history, a=20.0)
    first, further = ((matrices[n] ** 2).sum(axis=1) * sd[n] ** 2 for n in sd)
    both = first + further
    scatter = float(np.mean(np.var(drawn, axis=0)))
    assert scatter == pytest.approx(float(np.mean(both)), rel=0.1)
    assert np.mean(first) < 0.9 * scatter


def test_averages_of_a_long_lag_are_those_of_its_whole_matrix():
    """They are made from few times: the whole matrix of a week needs gigabytes."""
    rng = np.random.default_rng(2)
    knots = np.cumsum(rng.uniform(8, 12, 2000)) + np.repeat([0.0, 9000.0], 1000)  # a night between
    at = knots[:-1] + 3.0
    averages = csr_array(np.repeat(np.eye(20) / 100, 100, axis=1)[:, :-1])
    for tau in (20.0, 300.0, 3000.0):
        whole = (averages @ lag_matrix(knots, knots, tau, at)).toarray()
        found = averaged_lag_matrix(averages, knots, knots, tau, at).toarray()
        np.testing.assert_allclose(found.sum(axis=1), whole.sum(axis=1), atol=1e-5)
        assert (found**2).sum(axis=1) == pytest.approx((whole**2).sum(axis=1), rel=0.05)
        assert np.abs(found - whole).max() < 0.1 * np.abs(whole).max()


def test_every_operator_is_tested():
    named = {name for text in CASES for name in OPERATORS if f"{name}(" in text}
    assert named == set(OPERATORS)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("__import__('os').system('x')", "not a recorded quantity"),
        ("integral(1 + 1)", "not a recorded quantity"),
        ("eval(temperature)", "no operator 'eval'"),
        ("lag(temperature)", "takes 2 arguments, not 1"),
        ("lag(temperature, {[]: 1})", "neither a number nor a name"),
        ("product(above(temperature, k), above(board, k))", "a name of its own"),
        ("square(wave(temperature, P, phi))", "phi is a parameter of the camera"),
        ("square(" * 20 + "temperature" + ")" * 20, "more than 8 nested operators"),
        ("square(" * 200, "at most 300 characters"),
        ("lag(", "cannot be read"),
        ("exponential(temperature, 0)", "w of exponential is not above 0"),
    ],
)
def test_other_texts_than_formulas_are_refused(text, reason):
    with pytest.raises(ConfigurationError, match=reason):
        catalogue.get(text)


def test_units():
    units = catalogue.get("integral(above(temperature, k))").units()
    assert (units["k"], units["x0"]) == ("degC", "mm/(K s)")
    assert catalogue.get("signed_square(rate(temperature))").units()["c"] == "mm/(K2/s2)"


def known(value, unit, sd=None):
    return {"value": value, "sd": sd, "unit": unit}


WIDTH = {"w": known(288.2, "K")}


@pytest.mark.parametrize(
    ("text", "estimates", "said"),
    [
        ("integral(above(temperature, k))", {"k": known(30.0, "degC", 0.1)},
         "c follows ∫ (T − 30.00 ± 0.10 °C)₊ dt"),
        # the tail of a tanh is an exponential, so middle, width and size are on a ridge
        ("saturation(temperature, k, w)", {"k": known(38.0, "degC", 0.11), **WIDTH},
         "38.00 ± 0.11 °C"),
        ("saturation(temperature, k, w)", {"k": known(3783.7, "degC"), **WIDTH},
         "tanh((T − about 3.8e+03 °C) / about 2.9e+02 K)"),
        ("lag(temperature, tau)", {"tau": known(120.0, "s", 3.1e4)}, "about 120 s"),
    ],
)  # fmt: skip
def test_an_undetermined_constant_is_rounded_in_a_sentence(text, estimates, said):
    assert said in catalogue.get(text).sentence({"a_c": {}, **estimates})


def test_a_number_in_a_formula_does_not_split_its_name():
    model = preset_simulation("rpi-v2.1-heating").model
    model = model.with_effect(ModelEffect("above(temperature, 30.5)", {"c": 1e-4}, {"c": 1e-6}))
    name = "above(temperature, 30.5).c"
    assert name in model.parameter_names()
    assert (model.value(name), model.sd(name)) == (1e-4, 1e-6)
    assert model.with_values({name: 2e-4}).value(name) == 2e-4


def test_a_missing_column_is_named(history):
    effect = catalogue.get('lag(column("pressure"), tau)')
    with pytest.raises(DataError, match=r"no recorded column 'pressure'.*humidity"):
        effect.signal(history, tau=30.0)


def test_an_effect_file_round_trip(tmp_path):
    path = tmp_path / "proposal.yaml"
    effect = ModelEffect(
        "lag(above(temperature, k), tau)", {"k": 31.5, "tau": 80.0, "x0": 1e-4}, {"tau": 2.0}
    )
    write_effects(path, [effect], "x0 follows it", {"verdict": "unexplained"})
    (found,) = read_effects(path)
    assert found.name == effect.name
    assert (dict(found.values), dict(found.sds)) == (dict(effect.values), dict(effect.sds))


def test_slope_and_curvature_of_correlated_constants_have_true_sds():
    """300 draws of y = r T + a exp(T / w)."""
    from scipy.optimize import curve_fit

    rng, T, off = np.random.default_rng(5), np.linspace(20.0, 45.0, 60), []
    nearest = np.linalg.pinv(np.vander(np.linspace(20.0, 45.0, 41) - 30.0, 3, increasing=True))

    def course(T, w, a, r, level):
        return level + r * T + a * np.exp(T / w)

    for _ in range(300):
        y = course(T, 30.0, 0.2, -0.02, 1.0) + rng.normal(0, 0.0005, len(T))
        x, Q = curve_fit(course, T, y, [30.0, 0.2, -0.02, 1.0])
        values = dict(zip(("w", "a", "rate"), x[:3].tolist(), strict=True))
        known = known_together(
            "exponential(temperature, w)", values, ("c",), Q[:3, :3], (20.0, 30.0, 45.0)
        )
        true = nearest @ course(np.linspace(20.0, 45.0, 41), 30.0, 0.2, -0.02, 1.0)
        parts = {"slope": true[1], "curvature": 2.0 * true[2]}
        found = {part: known[part]["c"] for part in parts}
        off.append([(found[p]["value"] - value) / found[p]["sd"] for p, value in parts.items()])
    # 300 draws give a ratio to 4 %
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(off), axis=0)), 1.0, atol=0.12)
    assert known["parameters"] == ["w"]


@pytest.mark.parametrize(
    ("text", "settles"),
    [("product(temperature, board)", True), ("product(rate(temperature), board)", True),
     ("integral(temperature)", False), ("product(time, board)", False)],
)  # fmt: skip
def test_what_settles_with_both_thermometers_has_a_value(text, settles):
    """Regression: a product of two thermometers had no value at steady temperatures."""
    with nullcontext() if settles else pytest.raises(DataError, match="no value at a steady"):
        catalogue.get(text).steady({}, 20.0, {"board": 30.0})


@pytest.mark.parametrize(
    "text",
    ["rate(saturation(temperature, k, w))", "product(time, above(temperature, k))",
     "product(board, above(temperature, k))"],
)  # fmt: skip
def test_other_functions_than_of_temperature_have_no_slope(text):
    names = [name for name, _, _ in parse(text).free()]
    values = {**dict.fromkeys(names, 30.0), "a": 1.0, "rate": 0.0}
    for variance, exchanged in ((1.0, False), (1e3, True)):  # k may be anywhere in the range
        Q = np.full((len(values),) * 2, variance)
        known = known_together(text, values, ("c",), Q, (20.0, 30.0, 45.0))
        assert known["parameters"] == names
        assert "slope" not in known
        assert known["exchanged"] is exchanged
