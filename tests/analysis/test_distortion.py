"""Series of cameras whose distortion follows the angle (from OpenCV), or the place in the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.audit_thermal import NAMES, fitted, rate_errors, seen, seen_by_opencv, simulated
from thermocald.analysis.thermal.certificate import model_lines
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.series.adjustment import adjust_series
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import choose_distortion
from thermocald.thermal.reduce import reduce_series

SEEDS = range(1, 5)


def test_the_rates_of_an_opencv_camera_whose_f_changes():
    errors = []
    for seed in SEEDS:
        s = simulated(seed, ())
        f = fitted(seen_by_opencv(s))
        assert f.model.distortion == "angle"
        assert f.model.evidence["fit"]["effect_missing"] is False
        errors.append(rate_errors(f, s))
    assert np.abs(errors).max() < 3.0
    # twelve numbers give a standard deviation to 20 %
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_the_same_series_epoch_by_epoch():
    """In `study` and `replay`, A and B are free in each epoch; c has its rate."""
    errors = []
    for seed in SEEDS[:2]:
        s = simulated(seed, ())
        source = seen_by_opencv(s)
        observed = []
        for points, there in zip(source.grid.points, source.grid.observed, strict=True):
            rows = np.flatnonzero(there)
            observed.append(Observations(rows, points[rows], np.full((len(rows), 2), 0.04)))
        found = adjust_series(
            source.sensor, source.field, observed, s.model.interior,
            ExteriorOrientation.from_array(s.truth.eop[0]), SeriesSettings(),
        )  # fmt: skip
        T = s.true_history.temperature()
        T = T - T.mean()
        for column, name in enumerate(NAMES):
            rate = T @ found.values[:, column] / (T @ T)
            left = found.values[:, column] - found.values[:, column].mean() - rate * T
            sd = np.sqrt(left @ left / (len(T) - 2) / (T @ T))
            errors.append((rate - s.model.rates[name]) / sd)
    assert np.abs(errors).max() < 3.0


def test_a_camera_whose_distortion_keeps_its_place_in_the_image():
    recognised = 0
    for seed in SEEDS:
        s = simulated(seed, ())
        s = replace(s, model=replace(s.model, distortion="image"))
        f = fitted(seen(s))
        lines = "\n".join(model_lines(ThermalCamera(f.model).as_dict() | {"band": True}))
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
        reduced = reduce_series(seen(simulated(seed, (effect,))), strict=False)
        assert choose_distortion([reduced])[0] == "angle"
