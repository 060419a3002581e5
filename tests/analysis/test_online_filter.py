"""The recursive estimate has true standard deviations, and names changes; drift, time to steady."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.audit_camera import Scene
from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.analysis.online.filter import FieldErrors, OnlineFilter
from thermocald.analysis.online.observer import EquilibriumWatch, OnlineObserver, fit_approach
from thermocald.epoch import Epoch
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.field.testfield import TestField

RATES = np.array([2.0e-4, -4.5e-4, -3.0e-4])


class Surveyed(Scene):
    """Epochs before a field whose coordinates have errors of the stated size."""

    def __init__(self, sigma_mm: float, seed: int, missing: float = 0.0) -> None:
        super().__init__(np.random.default_rng([seed, round(1e3 * sigma_mm)]), sigma_mm)
        self.missing = missing

    def epoch(self, rise: float = 0.0, change=0.0):
        values = np.concatenate([self.iop, self.eop]) + change
        values[:3] += RATES * rise
        seen = self.observe(values[:10], values[10:])
        if self.missing:
            seen = seen.select(self.rng.random(len(seen)) >= self.missing)
        result = self.adjust(seen)
        assert result.ok
        return seen, result

    def filter(self):
        """Return the filter, and a function that updates it with an epoch."""
        errors = FieldErrors(self.sensor, self.field)
        found = OnlineFilter(self.sensor, errors.variances)

        def take(rise: float = 0.0, change=0.0):
            seen, result = self.epoch(rise, change)
            reading = 25.0 + rise + self.rng.normal(0, 0.05)
            return found.update(result, reading, errors.split(result, seen))

        return found, take


@pytest.mark.slow
def test_the_covariance_of_estimate_and_rates_is_true():
    deviations = []
    for seed in range(40):
        camera = Surveyed(0.0, seed)
        found, take = camera.filter()
        for k in range(40):
            take(0.25 * k)
        sd = np.sqrt(np.diag(found.covariance()))[:3]
        # the estimate is for the last temperature reading, which is noisy
        truth = camera.iop[:3] + RATES * (found.last_temperature - 25.0)
        sd_rate = np.sqrt(np.diag(found.rates_covariance))
        deviations.append(
            [*((found.values()[:3] - truth) / sd), *((found.rates - RATES) / sd_rate)]
        )
    rms = np.sqrt(np.mean(np.square(deviations), axis=0))
    # the sds allow for wander and lag, which this camera lacks, so they are conservative
    assert np.all(rms < 1.3)
    assert np.all(rms > 0.2)
    assert sd[1] < 0.35 * camera.epoch()[1].sd[1]


def test_no_alarm_over_a_warm_up():
    for seed in range(3):
        _, take = Surveyed(0.0, seed).filter()
        assert all(take(0.35 * max(k - 20, 0)).change == "" for k in range(60))


def observed(camera, epochs, rise=0.0, every=1, readings_end=1000):
    """Return the observer's states and events; rise: K per epoch; every: epochs per reading."""
    events, states = [], []
    observer = OnlineObserver(camera.sensor, camera.field, lambda *a: events.append(a))
    for k in range(epochs):
        seen, result = camera.epoch(rise * k)
        at = k - k % every
        reading = 25.0 + rise * at if k < readings_end else np.nan
        epoch = Epoch(k, 10.0 * k, 10.0 * at, {"temperature": reading}, None, seen)
        observer.observe(CalibratedEpoch(epoch, result, {}))
        states.append(observer.report()["state"])
    return states, events


@pytest.mark.parametrize("readings_end", [20, 1000])
@pytest.mark.parametrize("every", [1, 12])
def test_a_camera_that_warms_while_its_thermometer_is_not_read_did_not_slip(every, readings_end):
    """The last reading counted as the camera's temperature, and its warming as a slip."""
    assert not observed(Surveyed(0.0, 5), 60, 0.35, every, readings_end)[1]


def test_a_steady_camera_is_ready_in_time_before_an_uncertain_field():
    states, events = observed(Surveyed(0.05, 1), 80)
    assert "ready" in states[:50]
    assert states[60:].count("ready") >= 16
    assert states.count("drifting") <= 4  # 2 sd in up to three components
    assert not events


def test_one_bad_epoch_is_an_outlier_and_leaves_the_estimate_alone():
    found, take = Surveyed(0.0, 2).filter()
    for _ in range(20):
        take()
    before = found.values()
    assert take(change=2.0 * np.eye(16)[13]).change == "outlier"
    assert np.abs((found.values() - before)[:3]).max() < 1e-9
    assert take().change == ""


def test_an_epoch_without_a_result_changes_nothing():
    camera = Surveyed(0.0, 4)
    observer = OnlineObserver(camera.sensor, camera.field, lambda *_: None)
    epoch = Epoch(1, 0.0, 0.0, {"temperature": 25.0}, None, camera.epoch()[0])
    assert observer.observe(CalibratedEpoch(epoch, failed("bad_frame", ""), {})) == {}
    assert observer.filter.epochs == 0


@pytest.mark.parametrize("missing", mostly_slow([0.0, 0.1], 0.1))
@pytest.mark.parametrize("sigma_mm", mostly_slow([0.0, 0.01, 0.05], 0.05))
def test_innovations_agree_with_their_covariance_for_any_field(sigma_mm, missing):
    """With the field's errors as noise of each epoch, χ² per degree of freedom was 0.09."""
    ratios = []
    for seed in range(4):
        _, take = Surveyed(sigma_mm, seed, missing).filter()
        found = [take() for _ in range(40)]
        assert all(one.change == "" for one in found)
        ratios += [one.chi2 / one.dof for one in found[1:]]
    # 156 epochs of 14 degrees of freedom: the sd of the mean is 0.03
    assert 0.9 < np.mean(ratios) < 1.1


@pytest.mark.parametrize("sigma_mm", mostly_slow([0.0, 0.01, 0.05], 0.05))
def test_a_knock_of_a_tenth_of_a_pixel_is_noticed(sigma_mm):
    noticed = 0
    for seed in range(8):
        camera = Surveyed(sigma_mm, seed)
        _, take = camera.filter()
        assert all(take().change == "" for _ in range(20))
        change = 0.1 * camera.sensor.pixel_pitch / camera.iop[0] * np.eye(16)[11]  # phi, rad
        noticed += any(take(change=change).change not in ("", "outlier") for _ in range(4))
    assert noticed >= 7


def test_the_noise_is_estimated_independently_of_the_field():
    """The level of the noise is right if the field's sigmas are far too small or too large."""
    for sigma_mm, stated in ((0.05, 0.001), (0.0, 0.05)):
        camera = Surveyed(sigma_mm, 3)
        camera.field = TestField.build(camera.field.names, camera.field.points, stated)
        errors = FieldErrors(camera.sensor, camera.field)
        for _ in range(30):
            seen, result = camera.epoch()
            errors.split(result, seen)
        # 30 differences of 96 coordinates give 3 %
        assert errors.level == pytest.approx(1.0, abs=0.1)


GAIN, POSE = np.zeros((3, 6)), np.zeros(6)


@pytest.mark.parametrize("tau", [200.0, 600.0, 2400.0])
def test_drift_now_and_time_to_the_steady_state_have_true_sds(tau):
    """The drift was once that of the middle of the last minutes, 9 sds off."""
    rng = np.random.default_rng(2)
    bound = 0.05 / 60.0
    t = np.arange(60) * 10.0
    now = 6.0 * tau / 300.0 / tau * np.exp(-t[-1] / tau)  # px/s
    truth = tau * np.log(now / bound)
    course = now * tau * np.exp((t[-1] - t) / tau)[:, None] * np.array([1.0, 2.0, -2.0]) / 3.0
    drifts, ready = [], []
    for _ in range(150):
        values = course + rng.normal(0, 0.03, (60, 3))
        speed, sd, ready_in, sd_ready_in, _ = fit_approach(t, values, np.full((60, 3), 0.03), bound)
        drifts.append((speed - now) / sd)
        ready.append((ready_in - truth) / sd_ready_in)
    for errors in (drifts, ready):
        # 150 errors: sd of their RMS 0.06; where the sd differs from fit to fit they are not normal
        assert 0.8 < np.sqrt(np.nanmean(np.square(errors))) < 1.2


def test_a_straight_line_drifts_and_has_no_steady_state():
    rng = np.random.default_rng(5)
    t = np.arange(60) * 10.0
    errors = []
    for _ in range(100):
        values = 0.01 * t[:, None] + rng.normal(0, 0.02, (60, 1))
        speed, sd, ready_in, *_ = fit_approach(t, values, np.full((60, 1), 0.02), 1e-3)
        errors.append((speed - 0.01) / sd)
    assert np.isnan(ready_in)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.25


def assessed(size, epochs: int = 60, held: float = 0.0):
    """Return the state of a camera that approaches its steady one; held: added to c, NaN if so."""
    rng, watch, gone = np.random.default_rng(3), EquilibriumWatch(), np.array([held, 0.0, 0.0])
    for k in range(epochs):
        values = np.array(size) * np.exp(-k / 40.0) + rng.normal(0, 0.02, 3)
        watch.add(10.0 * k, values + gone, GAIN, 0.02 + gone)
    return watch.assess(POSE)


def test_a_warm_camera_is_ready_and_a_warming_one_drifts():
    """A held parameter does not count."""
    assert assessed([0.0] * 3).state == assessed([0.0] * 3, held=np.nan).state == "ready"
    assert assessed([0.0] * 3, epochs=4).state == "unknown"
    warming = assessed([1.0, 2.0, -2.0])
    assert warming.state == "drifting"
    truth = 60.0 * 3.0 / 400.0 * np.exp(-590.0 / 400.0)
    assert warming.drift == pytest.approx(truth, abs=3.0 * warming.sd_drift)
    assert warming.sd_drift < 0.1 * truth
    assert "ready in about" in warming.sentence


def test_memory_at_5_hz_is_bounded():
    """The watch once went through 14,400 epochs at every epoch."""
    rng = np.random.default_rng(4)
    quick, seldom = EquilibriumWatch(), EquilibriumWatch()
    for k in range(5 * 800):
        time = 0.2 * k
        values = np.array([1.0, 2.0, -2.0]) * np.exp(-time / 600.0) + rng.normal(0, 0.02, 3)
        quick.add(time, values, GAIN, np.full(3, 0.02))
        if k % 50 == 0:
            seldom.add(time, values, GAIN, np.full(3, 0.02))
    assert len(quick._past) <= 4 * 180 + 1
    found, rough = quick.assess(POSE), seldom.assess(POSE)
    assert found.state == "drifting"
    assert found.drift == pytest.approx(rough.drift, abs=3.0 * rough.sd_drift)
    assert found.sd_drift < 0.3 * rough.sd_drift  # all 50 times as many epochs count
