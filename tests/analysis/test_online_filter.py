"""The recursive estimate: its standard deviations are true, changes are found and named."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.analysis.online.filter import FilterSettings, OnlineFilter, chi2_quantile
from thermocald.analysis.online.observer import given_exterior
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import adjust
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.simulation.demonstration import demonstration_model
from thermocald.simulation.testfields import corner_field

RATES = np.array([2.0e-4, -4.5e-4, -3.0e-4])


@pytest.fixture(scope="module")
def camera():
    """seed → function (temperature, change of the 16 parameters) → adjustment."""
    field = corner_field("plain", per_side=4, pitch_mm=150.0)
    model = demonstration_model(field)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    rows = np.arange(len(field))

    def make(seed: int):
        rng = np.random.default_rng(seed)

        def epoch(temperature: float, change=None):
            values = np.concatenate([iop, eop])
            values[:3] += RATES * (temperature - 25.0)
            if change is not None:
                values = values + change
            points = project(model.sensor, values[:10], values[10:], field.points)
            points = points + rng.normal(0, 0.04, points.shape)
            seen = Observations(rows, points, np.full(points.shape, 0.04))
            result = adjust(
                model.sensor, field, seen, InteriorOrientation.from_array(iop),
                ExteriorOrientation.from_array(eop),
            )  # fmt: skip
            assert result.ok
            return result

        return epoch

    make.sensor = model.sensor
    make.truth = lambda temperature: iop[:3] + RATES * (temperature - 25.0)
    make.eop = eop
    return make


def run(camera, seed: int, epochs: int = 40):
    rng = np.random.default_rng([seed, 9])
    epoch, found = camera(seed), OnlineFilter(camera.sensor)
    for k in range(epochs):
        temperature = 25.0 + 0.25 * k
        found.update(epoch(temperature), temperature + rng.normal(0, 0.05))
    return found


def test_the_scatter_of_estimate_and_rates_is_what_its_covariance_says(camera):
    deviations = []
    for seed in range(40):
        found = run(camera, seed)
        sd = np.sqrt(np.diag(found.covariance()))[:3]
        # the estimate stands at the last temperature read, which has noise of its own
        at = found._temperature
        sd_rate = np.sqrt(np.diag(found.rates_covariance))
        deviations.append([*((found.values()[:3] - camera.truth(at)) / sd),
                           *((found.rates - RATES) / sd_rate)])  # fmt: skip
    rms = np.sqrt(np.mean(np.square(deviations), axis=0))
    # wander and lag are allowed for, and this camera has none: conservative, not by much more
    assert np.all(rms < 1.3)
    assert np.all(rms > 0.2)
    assert np.sqrt(np.diag(found.covariance()))[1] < 0.35 * camera(0)(25.0).sd[1]


def test_no_alarm_over_a_warm_up(camera):
    for seed in range(5):
        rng = np.random.default_rng([seed, 3])
        epoch, found = camera(seed), OnlineFilter(camera.sensor)
        for k in range(60):
            temperature = 25.0 + (0.0 if k < 20 else 0.35 * (k - 20))
            innovation = found.update(epoch(temperature), temperature + rng.normal(0, 0.05))
            assert innovation.change == ""


@pytest.mark.parametrize(
    ("name", "parameter", "size"),
    [("knock", 13, 0.5), ("knock", 12, 0.002), ("slip", 0, 3e-3), ("wrong_lens", 0, 0.2)],
)
def test_a_change_that_stays_is_named_at_its_second_epoch(camera, name, parameter, size):
    epoch, found = camera(1), OnlineFilter(camera.sensor)
    for _ in range(20):
        found.update(epoch(25.0), 25.0)
    change = np.zeros(16)
    change[parameter] = size
    named = [found.update(epoch(25.0, change), 25.0).change for _ in range(6)]
    assert named == ["outlier", name, "", "", "", ""]


def test_one_bad_epoch_is_an_outlier_and_leaves_the_estimate_alone(camera):
    epoch, found = camera(2), OnlineFilter(camera.sensor)
    for _ in range(20):
        found.update(epoch(25.0), 25.0)
    before = found.values()
    change = np.zeros(16)
    change[13] = 2.0
    assert found.update(epoch(25.0, change), 25.0).change == "outlier"
    assert np.abs((found.values() - before)[:3]).max() < 1e-9
    assert found.update(epoch(25.0), 25.0).change == ""


def test_with_the_exterior_known_an_epoch_tells_the_interior_ten_times_better(camera):
    result = camera(3)(25.0)
    given, sds = given_exterior(result.values, result.covariance, camera.eop)
    assert np.all(sds[1:] < 0.1 * result.sd[1:3])
    assert np.all(np.abs(given - camera.truth(25.0)) < 4 * sds)


def test_chi2_quantiles():
    from scipy.stats import chi2

    for dof in (6, 8, 11, 14, 16):
        for p in (0.95, 0.999, 1 - 1e-6):
            assert chi2_quantile(p, dof) == pytest.approx(chi2.ppf(p, dof), rel=0.04)


def test_an_epoch_without_a_result_changes_nothing(camera):
    from thermocald.photogrammetry.epoch.adjustment import failed

    found = OnlineFilter(camera.sensor, FilterSettings())
    assert found.update(failed("bad_frame", ""), 25.0) is None
    assert found.epochs == 0
