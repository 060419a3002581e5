"""A fit that misses an effect says so, widens its standard deviations, and states no band."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_thermal_model import LAG, for_fit, reduced, run, simulated
from thermocald.analysis.thermal.model_text import model_lines
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.physics import catalogue
from thermocald.physics.effect import Effect, coefficient_units
from thermocald.physics.model import ModelEffect
from thermocald.thermal.source import epochs_input

SIZE = {"c": 3e-4, "x0": 6e-4, "y0": -4e-4}
NOISE_PX = 0.04


class Outside(Effect):
    """An effect that is not in the catalogue."""

    kind = "signal"
    noun = "something else"
    linear = coefficient_units("1")
    usual = ("c", "x0", "y0")


class Tanh(Outside):
    name = "tanh"

    def signal(self, history, **_):
        return np.tanh((history.temperature() - 38.0) / 5.0)[:, None]


class SignedSquare(Outside):
    name = "signed_square"

    def signal(self, history, **_):
        rate = np.gradient(history.temperature(), history.times) / 0.03
        return (np.sign(rate) * rate**2)[:, None]


class Integral(Outside):
    name = "integral"

    def signal(self, history, **_):
        steps = np.diff(history.times, prepend=history.times[0])
        return (np.cumsum((history.temperature() - history.T0) * steps) / 1e4)[:, None]


def follows(history, tau):
    """The temperature (E,) of something that follows with a time constant of its own, s."""
    T = history.temperature()
    out = T.copy()
    for k, step in enumerate(np.diff(history.times), 1):
        out[k] = T[k] + (out[k - 1] - T[k]) * np.exp(-step / tau)
    return out


class TwoLags(Outside):
    name = "two_lags"

    def signal(self, history, **_):
        slow = 0.5 * (follows(history, 40.0) + follows(history, 400.0))
        return ((slow - history.temperature()) / 4)[:, None]


class OtherBody(Outside):
    name = "other_body"

    def signal(self, history, **_):
        return ((follows(history, 600.0) - history.T0) / 4)[:, None]


class Exposure(Outside):
    """A step with the lamp, as an exposure that follows its light."""

    name = "exposure"

    def signal(self, history, **_):
        rate = np.gradient(history.temperature(), history.times)
        return (1.0 / (1.0 + np.exp(-(rate - 0.01) / 0.002)))[:, None]


class Play(Outside):
    name = "play"

    def signal(self, history, **_):
        T = history.temperature()
        out = T.copy()
        for k in range(1, len(T)):
            out[k] = min(max(out[k - 1], T[k] - 2.0), T[k] + 2.0)
        return ((out - T) / 2)[:, None]


class Quadratic(Outside):
    name = "quadratic"

    def signal(self, history, **_):
        return ((history.temperature() - history.T0) ** 2 / 60)[:, None]


OTHERS = (TwoLags, OtherBody, Exposure, Play, Quadratic)

CASES = {
    "lag": ModelEffect("thermal_lag", {"tau": 120.0}),
    "tanh": ("tanh", SIZE),
    "signed_square": ("signed_square", SIZE),
    "integral": ("integral", SIZE),
}


@pytest.fixture
def outside(monkeypatch):
    """The catalogue with effects that no fit is told of."""
    own = {c.name: c() for c in (Tanh, SignedSquare, Integral, *OTHERS)}
    inside = catalogue.get
    monkeypatch.setattr(catalogue, "get", lambda name: own.get(name) or inside(name))


def hidden(name):
    case = CASES[name]
    return case if isinstance(case, ModelEffect) else ModelEffect(*case)


@pytest.mark.parametrize("name", CASES)
def test_a_camera_outside_the_family(outside, name):
    """M1 is fitted by the base model; M2, heated otherwise, gets no band that it does not keep."""
    first = simulated(1, "M1", listed=(hidden(name),))
    second = simulated(51, "M2", listed=(hidden(name),), power=6.5)

    f = fit_thermal_model([reduced(first)], [])
    error = predicted_error(f.model, reduced(second), f.fitted["series"][0].thermometer_sd)

    assert f.model.evidence["fit"]["effect_missing"]
    assert f.model.evidence["fit"]["misfit_px"] > 2 * 0.004
    assert f.model.misses_an_effect
    # the noise is not what the model lacks: neither the image's nor the thermometer's
    assert abs(f.fitted["sigma0"] - 1.0) < 0.03
    assert f.fitted["series"][0].thermometer_sd < 0.06
    assert error.floor_px < 1.2 * NOISE_PX
    assert error.rms_px > 2 * error.floor_px
    assert np.isnan(error.coverage)
    if name != "tanh":  # whose linear part is a rate like any other
        for n in ("c", "x0", "y0"):
            assert abs(f.model.rates[n] - first.model.rates[n]) < 3 * f.model.sd(f"rates.{n}"), n


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHERS)
def test_no_band_that_does_not_hold(outside, kind):
    """Effects from hardly visible to large: a band holds at least 90 %, or none is stated."""
    for k, size in enumerate((0.03, 0.3)):
        effect = ModelEffect(kind.name, {n: v * size for n, v in SIZE.items()})
        first = simulated(100 + k, "M1", listed=(effect,))
        second = simulated(151 + k, "M2", listed=(effect,), power=6.5)
        f = fit_thermal_model([reduced(first)], [])
        error = predicted_error(f.model, reduced(second), f.fitted["series"][0].thermometer_sd)
        assert np.isnan(error.coverage) or error.coverage > 0.9
        assert f.model.evidence["fit"]["effect_missing"] or error.rms_px < 1.1 * error.floor_px


def test_inside_the_family_nothing_is_missing():
    for listed in ((), (LAG,)):
        f = fit_thermal_model([reduced(simulated(3, listed=listed))], listed)
        assert not f.model.evidence["fit"]["effect_missing"]
        assert not f.model.misses_an_effect


def test_the_command_says_it(tmp_path):
    for k, name in enumerate(("M1", "M2")):
        simulated(k, name, listed=(hidden("lag"),)).write(tmp_path / name)
    model = tmp_path / "camera.yaml"
    fitted = run("fit", tmp_path / "M1", "-o", model, "--json", tmp_path / "fit.json")
    tested = run("predict", "--model", model, "--test", tmp_path / "M2")
    written = json.loads(run("predict", "--model", model, "--test", tmp_path / "M2",
                             "--json", "-").stdout)  # fmt: skip

    assert "an effect is missing" in fitted.stdout
    assert "run: thermocald discover" in fitted.stdout
    assert "valid from" not in fitted.stdout
    document = json.loads((tmp_path / "fit.json").read_text())
    assert document["effect_missing"] is True
    assert "no 95 % band is stated" in tested.stdout
    assert "the model misses an effect" in tested.stderr
    assert written["series"][0]["coverage"] is None


def level_pulls(draws, epochs, noise=0.1, field=0.02):
    """Errors of the level and the drifts over their stated sd, (draws, 11)."""
    pulls = []
    for seed in range(draws):
        s = simulated(seed, epochs=epochs)
        thermometers = {k: replace(t, noise=noise) for k, t in s.device.thermometers.items()}
        s = replace(s, device=replace(s.device, thermometers=thermometers))
        rng = np.random.default_rng(1000 + seed)
        wrong = s.field.points + rng.normal(0, field, s.field.points.shape)
        said = replace(s.field, points=wrong, sigmas=np.full(wrong.shape, field))
        source = epochs_input(s.head, said, list(s.epochs()), "M1")
        f = fit_thermal_model([for_fit(source)], [LAG], T0=30.0, search=False)
        true = s.model.interior.as_array() + 5.0 * s.model.rate_vector
        names = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
        pull = [
            (getattr(f.model.interior, n) - t) / f.model.sd(f"interior.{n}")
            for n, t in zip(names, true, strict=False)
        ]
        pull += [
            (f.model.rates[n] - s.model.rates[n]) / f.model.sd(f"rates.{n}")
            for n in ("c", "x0", "y0")
        ]
        pulls.append(pull)
    return np.array(pulls)


def test_the_level_is_not_as_uncertain_as_the_thermometer_is_noisy():
    """A few draws: ± 0.4 px is the field's share; 2.8 px was stated for 0.1 K of noise."""
    spread = np.sqrt(np.mean(level_pulls(4, 40)[:, :3] ** 2))
    assert 0.5 < spread < 1.6


def short(seed, name, effects, epochs, power=9.0):
    whole = simulated(seed, name, listed=effects, power=power)
    return replace(whole, programme=replace(whole.programme, epochs=epochs))


def test_what_is_not_examined_is_not_called_valid(tmp_path):
    """Below 30 epochs: a third state, what is left beside the noise, no band where that is much."""
    lag = ModelEffect("thermal_lag", {"tau": 60.0})
    for effects, sound in (((), True), ((lag,), False)):
        s = short(5, "M1", effects, 25)
        s.write(tmp_path / f"{sound}")
        model = tmp_path / f"{sound}.yaml"
        out = tmp_path / f"{sound}.json"
        fitted = run("fit", tmp_path / f"{sound}", "-o", model, "--json", out).stdout
        said = run("predict", "--model", model, "--temperature", "30").stderr
        document = json.loads(out.read_text())
        assert document["effect_missing"] is None
        assert document["not_examined"] == "fewer than 30 epochs"
        assert "not examined" in fitted
        assert "not examined" in said
        assert "valid from" not in fitted
        assert (document["left_over_in_noise"] < 1.1) == sound
        assert document["band"] == sound
        assert ("no 95 % band" in fitted) != sound
        for n in ("c", "x0", "y0"):
            rate = document["rates"][n]
            assert abs(rate["value"] - s.model.rates[n]) < (3 if sound else 5) * rate["sd"], n


def test_short_series_are_examined_together():
    lag = ModelEffect("thermal_lag", {"tau": 60.0})
    for effects, missing in (((), False), ((lag,), True)):
        series = [reduced(short(k, f"M{k}", effects, 20, 9.0 - k)) for k in (1, 2)]
        assert fit_thermal_model(series, []).model.evidence["fit"]["effect_missing"] is missing
        assert fit_thermal_model(series[:1], []).model.evidence["fit"]["effect_missing"] is None


def on_a_mount(s, px):
    """What was recorded, the camera's angles on a random walk of so many px."""
    source = epochs_input(s.head, s.field, list(s.epochs()), s.programme.series)
    rng = np.random.default_rng([s.seed, 9])
    epochs, eop = len(s.frame_times), s.truth.eop.copy()
    step = px / np.sqrt(epochs) * s.model.sensor.pixel_pitch / s.model.interior.c
    eop[:, :3] += np.cumsum(rng.normal(0.0, step, (epochs, 3)), axis=0)
    points = project(s.model.sensor, s.truth.iop, eop, s.field.points)
    points += rng.normal(0.0, NOISE_PX, points.shape)
    points[~source.grid.observed] = np.nan
    return replace(source, grid=replace(source.grid, points=points))


@pytest.mark.slow
@pytest.mark.parametrize("px", [0.3, 0.8])
def test_a_mount_that_wanders_is_said_beside_a_missing_effect(px):
    """`discover` finds nothing but the mount there: `fit` claims no effect that is none."""
    for seed in (1, 2):
        f = fit_thermal_model([for_fit(on_a_mount(simulated(seed, listed=()), px))], [])
        assert f.model.evidence["fit"]["effect_missing"]
        assert f.model.evidence["fit"]["trembles"]
        document = ThermalCamera(f.model).as_dict()
        assert "or the mount moves" in model_lines(document)[1]
    still = fit_thermal_model([for_fit(on_a_mount(simulated(1, listed=()), 0.0))], [])
    assert still.model.evidence["fit"]["effect_missing"] is False
    assert "trembles" not in still.model.evidence["fit"]
    lag = fit_thermal_model([reduced(simulated(1, listed=[LAG]))], [])
    assert lag.model.evidence["fit"]["effect_missing"]
    assert "trembles" not in lag.model.evidence["fit"]
