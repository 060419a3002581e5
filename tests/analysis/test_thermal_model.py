"""The fit of a thermal model: M1 predicts M2, true standard deviations, refusals.

Also of cameras whose distortion follows the angle (from OpenCV) or the place in the image, and of
thermometers that are read between the frames, by a wrong clock, or poorly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import stdtrit

import thermocald as tc
from benchmarks import audit_thermal
from benchmarks.audit_camera import Scene
from benchmarks.audit_thermal import fitted, rate_errors, read_apart, seen
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.errors import DataError
from thermocald.physics.model import ModelEffect
from thermocald.store.recording.reader import open_recording
from thermocald.thermal.fit import choose_distortion
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input
from thermocald.thermal.thermometer import USUAL_THERMOMETER_SD, estimate_reading_noise

LAG = ModelEffect("thermal_lag", {"tau": 70.0})
START = ModelEffect("thermal_lag", {"tau": 10.0})
NO_GRADIENT = ModelEffect("thermal_gradient", {"c": 0.0, "x0": 0.0, "y0": 0.0})
DELAY = ModelEffect("time_offset", {"d": 0.0})


def gradient(size: float) -> ModelEffect:
    return replace(NO_GRADIENT, values={"c": 2e-3 * size, "x0": 6e-3 * size, "y0": -4e-3 * size})


def simulated(seed, series="M1", epochs=120, listed=(LAG,), power=9.0):
    """Return a simulation with these effects; M1 is heated for a shorter time than others."""
    until = 500.0 if series == "M1" else 700.0
    return audit_thermal.simulated(seed, tuple(listed), epochs, power, until, series)


def for_fit(source):
    return reduce_series(source, strict=False)


def reduced(s):
    return for_fit(seen(s))


def pull(fit, name, true):
    """Return error over sd of a number of the model."""
    return (fit.model.value(name) - true) / fit.model.sd(name)


def read_with(s, noise_k):
    """Return the series as seen, with more noise of its thermometers."""
    source, rng = seen(s), np.random.default_rng([s.seed, 3])
    poor = {n: r + rng.normal(0, noise_k, len(r)) for n, r in source.readings.items()}
    return replace(source, readings=poor, resolutions=dict.fromkeys(poor))


def test_a_model_of_m1_predicts_m2():
    """The error is at most 1.1 × the noise floor; 95 % bands hold 93 to 97 %."""
    first, second = reduced(simulated(1, "M1")), reduced(simulated(2, "M2", power=6.5))
    model = fit_thermal_model([first], [START])
    sd = model.fitted["series"][0].thermometer_sd
    error = predicted_error(model.model, second, sd)
    assert error.rms_px <= 1.1 * error.floor_px
    assert 0.93 <= error.coverage <= 0.97
    # not so without the effect
    base = fit_thermal_model([first], []).model
    assert predicted_error(base, second, sd).rms_px > 1.5 * error.rms_px


@pytest.mark.parametrize("seed", [3, *(pytest.param(k, marks=pytest.mark.slow) for k in (4, 5))])
def test_sixteen_targets_suffice(seed):
    """Most epochs show at least twelve of them; fewer than three such epochs are refused."""
    s = simulated(seed)
    rows = np.sort(np.random.default_rng(seed).permutation(len(s.field))[:16])
    f = fit_thermal_model([reduced(replace(s, field=s.field.subset(rows)))], [START])
    assert np.abs(rate_errors(f, s)).max() < 3.5
    assert abs(pull(f, "thermal_lag.tau", 70.0)) < 3.5
    assert f.model.sd("thermal_lag.tau") < 6.0
    with pytest.raises(DataError, match="fewer than 3 epochs show 12 targets or more"):
        reduced(replace(s, field=s.field.subset(rows[:11])))


@pytest.mark.parametrize("kind", ["noisy", pytest.param("coarse", marks=pytest.mark.slow)])
def test_a_poor_thermometer_does_not_bias_a_lag(kind):
    """Noise or steps of 1 K: errors are as large as their sds, and of either sign."""
    source, z = seen(simulated(6, epochs=100, power=5.0)), []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        read, phase = source.readings["temperature"], rng.uniform()
        poor = read + rng.normal(0, 1, len(read)) if kind == "noisy" else np.round(read + phase)
        one = for_fit(replace(source, readings={"temperature": poor}, noises=None))
        z.append(pull(fit_thermal_model([one], [START]), "thermal_lag.tau", 70.0))
    assert abs(np.mean(z)) < 1.0, z  # 1.3 with the determinant in the objective
    assert np.sqrt(np.mean(np.square(z))) < 1.5, z


@pytest.mark.slow
def test_events_and_phases_differ_between_series():
    """Two series have a slip, at different times; a fan has another phase in each series."""
    heights = {"c": 1e-4, "x0": 6e-4, "y0": 2e-4}
    fan = {"P": 143.0, "c": 5e-5, "x0": 4e-4, "y0": -2e-4}
    series = []
    for k, (time, phase) in enumerate([(405.0, 0.9), (805.0, -2.0), (None, 2.5)]):
        listed = [ModelEffect("cyclic_interference", {**fan, "phase": phase})]
        if time is not None:
            listed.append(ModelEffect("slip", {"time": time, **heights}))
        series.append(reduced(simulated(k, f"M{k + 1}", power=9.0 - k, listed=listed)))
    start = [
        ModelEffect("cyclic_interference", {**dict.fromkeys(fan, 0.0), "P": 60.0, "phase": 0.0}),
        ModelEffect("slip", {**dict.fromkeys(heights, 0.0), "time": 100.0}),
    ]
    f = fit_thermal_model(series, start)
    assert abs(pull(f, "cyclic_interference.P", 143.0)) < 4
    assert abs(f.model.value("slip.time") - 405.0) <= 5.0
    assert abs(f.fitted["sigma0"] - 1.0) < 0.03
    slip_first = replace(f.model, effects=f.model.effects[::-1])
    for s, of_series in zip(series, f.fitted["series"], strict=True):
        for model in (f.model, slip_first):
            error = predicted_error(model, s, of_series.thermometer_sd)
            assert error.rms_px <= 1.1 * error.floor_px
            assert 0.93 <= error.coverage <= 0.97


def test_a_kink_between_two_readings_is_no_signal():
    """A lamp is switched between two readings; the gradient's coefficients are right."""
    true = {"c": 2e-3, "x0": 8e-3, "y0": -5e-3}
    s = simulated(5, listed=[replace(NO_GRADIENT, values=true)], power=12.0)
    f = fit_thermal_model([reduced(s)], [NO_GRADIENT])
    assert abs(f.fitted["sigma0"] - 1.0) < 0.03
    assert max(abs(pull(f, f"thermal_gradient.{n}", v)) for n, v in true.items()) < 4


def test_refusals():
    steady = simulated(4, power=0.0)
    with pytest.raises(DataError, match="heat the camera by several kelvin"):
        fit_thermal_model([reduced(steady)])
    nobody = ModelEffect("target_displacement", {"time": 1.0, "targets": ("nobody",), "dX": 0.0})
    with pytest.raises(DataError, match="none of the targets"):
        fit_thermal_model([reduced(simulated(1, epochs=30))], [nobody])
    few = list(steady.epochs())[:2]
    with pytest.raises(DataError, match="fewer than 3 epochs"):
        for_fit(epochs_input(steady.head, steady.field, few, "few"))


def test_a_defocus_is_stated_at_any_t0_or_refused():
    """At a T0 at which there would be no noise, the factor was 10⁹ ± 10² per kelvin."""
    defocus = ModelEffect("defocus", {"factor": 0.15})
    series = [reduced(simulated(1, epochs=60, listed=[defocus]))]
    own = fit_thermal_model(series, [defocus]).model
    k, T0 = own.value("defocus.factor"), own.T0
    low = T0 - 0.8 / k
    assert low < series[0].history.temperature().min()
    cold = fit_thermal_model(series, [defocus], T0=low).model
    assert cold.value("defocus.factor") == pytest.approx(k / 0.2, rel=1e-3)
    with pytest.raises(DataError, match="there would be none; choose T0 nearer"):
        fit_thermal_model(series, [defocus], T0=T0 - 1.0 / k)


@pytest.mark.parametrize(("depth", "doubtful"), [("corner", False), ("wall", True)])
def test_rates_are_doubtful_with_a_field_that_hardly_shows_c(depth, doubtful):
    """With one wall they are off by 4 to 19 standard deviations, with a corner by 1.2."""
    scene = Scene(np.random.default_rng(3), 0.01, camera='1/4", 62°', depth=depth)
    s = simulated(7, listed=())
    found = fit_thermal_model([for_fit(audit_thermal.before(scene, s))], [])
    assert doubtful or np.abs(rate_errors(found, s)).max() < 3.0
    assert ("rates_hang_on_c" in found.as_dict()) is doubtful
    assert ("rates depend on it" in " ".join(found.lines())) is doubtful


@pytest.mark.parametrize(
    ("effect", "start", "power", "within"),
    [(LAG, START, 9.0, 0.03), (gradient(4.0), NO_GRADIENT, 1.2, 0.2)],
    ids=["lag", "gradient"],
)
def test_the_stated_noise_is_what_a_true_model_leaves_over(effect, start, power, within):
    """The thermometer's noise through the effect: a gradient left 1.7 to 2 times it, a lag 0.93."""
    left = []
    for seed in range(2):
        f = fit_thermal_model([reduced(simulated(seed, listed=(effect,), power=power))], [start])
        left.append(f.model.evidence["fit"]["left_over_in_noise"])
    assert np.mean(left) == pytest.approx(1.0, abs=within)


@pytest.mark.parametrize(
    ("seed", "epochs", "power", "size", "noise_k", "doubted"),
    [pytest.param(93002, 90, 1.2, 3.0, 0.0, True, marks=pytest.mark.slow),
     (201, 120, 1.45, 3.0, 0.0, True), (9105, 120, 9.0, 1.0, 1.0, True),
     (9105, 120, 9.0, 1.0, 0.05, False), (200, 120, 9.0, 1.0, 0.0, False)],
    ids=["4 K, more than the noise", "4 K, no more", "1 K of noise", "0.05 K of noise", "25 K"],
)  # fmt: skip
def test_a_gradient_that_readings_hardly_show_is_doubted(
    seed, epochs, power, size, noise_k, doubted
):
    """After 4 K its coefficients are up to 45 %, 5 standard deviations, wrong."""
    s = simulated(seed, epochs=epochs, listed=[gradient(size)], power=power)
    source = read_with(s, noise_k) if noise_k else seen(s)
    found = fit_thermal_model([for_fit(source)], [NO_GRADIENT])
    poorly = found.fitted.get("read_poorly", {"effects": []})
    assert ("thermal_gradient" in poorly["effects"]) is doubted
    assert ("values may be wrong by several standard deviations" in found.page()) is doubted


def test_correlated_constants_are_reported_by_slope_and_curvature():
    """Width and size of an exponential at room temperature correlate by 0.999."""
    true = ModelEffect("exponential(temperature, w)", {"w": 15.0, "c": 3e-4, "x0": 9e-4})
    s = simulated(1, listed=(true,))
    start = replace(true, values={"w": 30.0, "c": 0.0, "x0": 0.0})

    found = fit_thermal_model([reduced(s)], [start])

    known = found.fitted["known_together"][0]
    assert known["parameters"] == ["w"]
    assert known["correlation"] > 0.99
    T = np.linspace(*found.model.validity["temperature"], 41)
    half, slope, _ = np.polyfit(T - found.model.T0, np.exp(T / 15.0), 2)
    for name in ("c", "x0"):
        size = true.values[name]
        for part, value in (("slope", s.model.rates[name] + size * slope),
                            ("curvature", 2.0 * size * half)):  # fmt: skip
            estimate = known[part][name]
            assert estimate["value"] == pytest.approx(value, abs=4.0 * estimate["sd"])
            assert estimate["sd"] < 0.02 * abs(value)
    assert any("best known together, as they correlate by 0.99" in line for line in found.lines())


def test_an_unstated_affinity_is_reported_and_estimated(tmp_path):
    """fx and fy of a phone differ by 0.3 %; a held affinity gives rates 6 to 20 sds off."""
    s = simulated(11, epochs=60, listed=())
    s = replace(s, model=replace(s.model, interior=replace(s.model.interior, C1=3e-3)))
    s.write(tmp_path / "M1")
    series = tc.open(tmp_path / "M1")
    text = " ".join(series.calibrate().lines())
    assert "C1 is held, and the targets show that it differs by 0.0030" in text
    found = tc.fit(series)
    assert np.abs(rate_errors(found, s)).max() < 3
    assert abs(pull(found, "interior.C1", 3e-3)) < 4
    assert found.model.sd("interior.C1") < 2.5e-4


SEEDS = range(1, 5)


def test_a_camera_whose_distortion_keeps_its_place_in_the_image():
    recognised = 0
    for seed in SEEDS:
        s = simulated(seed, listed=())
        s = replace(s, model=replace(s.model, distortion="image"))
        f = fitted(seen(s))
        lines = "\n".join(f.lines())
        if f.model.distortion == "image":
            recognised += 1
            assert np.abs(rate_errors(f, s)).max() < 3.0
            assert "keeps its place in the image" in lines
        else:
            assert "the data cannot distinguish" in lines
    assert recognised >= 3  # χ² is 25 ± 10, and 9 is required


@pytest.mark.slow
@pytest.mark.parametrize("effect", [
    ModelEffect("thermal_lag", {"tau": 120.0}),
    ModelEffect("permanent_set", {"c": 2e-5, "x0": 6e-5, "y0": -4e-5}),
    ModelEffect("mount_motion", {"phi": 2e-6, "Z0": 2e-3}),
    ModelEffect("nonlinear_expansion", {"c": 2e-6, "x0": 6e-6, "y0": -4e-6}),
], ids=lambda e: e.name)  # fmt: skip
def test_the_distortion_is_recognised_before_any_effect(effect):
    for seed in SEEDS[:3]:
        assert choose_distortion([reduced(simulated(seed, listed=(effect,)))])[0] == "angle"


def test_a_wrong_clock():
    for seed in (1, 2):
        s = simulated(seed, listed=())
        f = fitted(read_apart(s, -33.0), DELAY)
        assert abs(pull(f, "time_offset.d", 33.0)) < 3.0
        assert f.model.sd("time_offset.d") < 0.2
        assert np.abs(rate_errors(f, s)).max() < 3.5


def test_a_delay_by_a_thermometer_of_1_k():
    """Where frames are half-way between readings, its sd was a tenth of its error."""
    off = {}
    for seed in (9107, 9109):
        true = float(np.random.default_rng([seed, 4]).uniform(-25, 25))
        s = simulated(seed, listed=[replace(DELAY, values={"d": true})])
        f = fitted(read_with(s, 1.0), DELAY)
        if "read_poorly" not in f.fitted:
            off[seed] = pull(f, "time_offset.d", true)
    assert 9107 not in off  # it is 15 standard deviations off
    assert np.max(np.abs(list(off.values()))) < 3.0, off


def test_a_lamp_switched_between_two_readings_is_no_delay():
    """With readings every 30 s, the instant of the kink is unknown."""
    for seed in (1, 5):  # otherwise 2 s
        f = fitted(read_apart(simulated(seed, listed=()), 0.0, 30.0), DELAY)
        assert abs(f.model.effects[0].values["d"]) < 0.6  # s


@pytest.mark.parametrize("epochs", [6, 12])
def test_few_readings_hardly_show_their_own_noise(tmp_path, epochs):
    """Their resolution was taken for it, and rates of four epochs were up to 18 sds off."""
    tc.simulate("nexus5-cold", seed=1, epochs=epochs, out=tmp_path)
    head = tmp_path / "recording.yaml"
    head.write_text(head.read_text().replace("resolution: 0.0625", "resolution: 0.01"))
    wanted = USUAL_THERMOMETER_SD
    if epochs == 12:  # Student's t, from nine third differences that are correlated
        read = open_recording(tmp_path).columns.readings_of("temperature")
        shown = estimate_reading_noise(*read, 0.01)
        wanted = shown * stdtrit(9 / 2.3, 0.975) / 1.96
    assert tc.fit(tc.open(tmp_path)).model.fitted_on[0]["thermometer_sd_K"] == pytest.approx(
        wanted, rel=1e-3
    )
