"""The recursive estimate has true standard deviations, and names changes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.audit_camera import Scene
from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.analysis.online.filter import FieldErrors, OnlineFilter
from thermocald.analysis.online.observer import OnlineObserver
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


def one_changed(parameter: int, size: float) -> np.ndarray:
    return size * np.eye(16)[parameter]


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


@pytest.mark.parametrize("readings_end", [20, 1000])
@pytest.mark.parametrize("every", [1, 12])
def test_a_camera_that_warms_while_its_thermometer_is_not_read_did_not_slip(every, readings_end):
    """The last reading counted as the camera's temperature, and its warming as a slip."""
    camera, events = Surveyed(0.0, 5), []
    observer = OnlineObserver(camera.sensor, camera.field, lambda *a: events.append(a))
    for k in range(60):
        seen, result = camera.epoch(0.35 * k)
        at = k - k % every
        reading = 25.0 + 0.35 * at if k < readings_end else np.nan
        epoch = Epoch(k, 10.0 * k, 10.0 * at, {"temperature": reading}, None, seen)
        observer.observe(CalibratedEpoch(epoch, result, {}))
    assert not events


def test_one_bad_epoch_is_an_outlier_and_leaves_the_estimate_alone():
    found, take = Surveyed(0.0, 2).filter()
    for _ in range(20):
        take()
    before = found.values()
    assert take(change=one_changed(13, 2.0)).change == "outlier"
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
        change = one_changed(11, 0.1 * camera.sensor.pixel_pitch / camera.iop[0])  # phi, rad
        noticed += any(take(change=change).change not in ("", "outlier") for _ in range(4))
    assert noticed >= 7


def test_a_steady_camera_is_ready_in_time_before_an_uncertain_field():
    camera = Surveyed(0.05, 1)
    events, states = [], []
    observer = OnlineObserver(camera.sensor, camera.field, lambda *a: events.append(a))
    for k in range(80):
        seen, result = camera.epoch()
        epoch = Epoch(k, 10.0 * k, 10.0 * k, {"temperature": 25.0}, None, seen)
        observer.observe(CalibratedEpoch(epoch, result, {}))
        states.append(observer.report()["state"])
    assert "ready" in states[:50]
    assert states[60:].count("ready") >= 16
    assert states.count("drifting") <= 4  # 2 sd in up to three components
    assert not events


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


def test_noise_twice_as_large_as_stated_is_followed_from_the_first_epoch():
    """When the first epoch had the stated weight, error over sd was 1.5 after six epochs."""
    off = []
    for seed in range(30):
        scene = Scene(np.random.default_rng(seed), 0.0, 0.08)
        errors = FieldErrors(scene.sensor, scene.field)
        found = OnlineFilter(scene.sensor, errors.variances)
        for _ in range(6):
            seen = scene.observe(scene.iop, scene.eop)
            result = scene.adjust(seen)
            found.update(result, 25.0, errors.split(result, seen))
        sd = np.sqrt(np.diag(found.covariance()))[:3]
        off.append((found.values()[:3] - scene.iop[:3]) / sd)
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.25
