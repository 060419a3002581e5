"""Blur over the image, and the light, from the targets' quality."""

from __future__ import annotations

import numpy as np
import pytest

from tests.photogrammetry.fields import SMALL_SENSOR
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.frame.measurement import blur_trend, frame_figures


def _points(n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform((0, 0), (SMALL_SENSOR.width - 1, SMALL_SENSOR.height - 1), (n, 2))


def _blur(points: np.ndarray, b=0.9, tx=0.1, ty=-0.05, k=0.2) -> np.ndarray:
    x, y = ((points - SMALL_SENSOR.centre) / (SMALL_SENSOR.width, SMALL_SENSOR.height)).T
    return b + tx * x + ty * y + k * 2 * (x * x + y * y)


def test_trend_is_found_with_true_sds_and_outliers_do_not_count():
    rng = np.random.default_rng(1)
    z = []
    for _ in range(300):
        points = _points(80, rng)
        blur = _blur(points) + rng.normal(0, 0.02, 80)
        blur[:3] += 2.0
        blur[3] = np.nan
        values, sd = blur_trend(points, blur, SMALL_SENSOR)
        z.append((values - (0.9, 0.1, -0.05, 0.2)) / sd)
    # 1,200 values: 2 %; cutting at 3.5 sd costs another per cent.
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.08)


def test_figures_of_a_frame():
    rng = np.random.default_rng(2)
    points = _points(50, rng)
    quality = {
        "blur": _blur(points), "contrast": np.full(50, -120.0), "grey": np.full(50, 180.0),
        "noise": np.full(50, 2.0), "saturation": np.zeros(50),
    }  # fmt: skip
    found = frame_figures(
        Observations(np.arange(50), points, np.full((50, 2), 0.01), None, quality), SMALL_SENSOR
    )
    assert found["blur_px"] == pytest.approx(0.9)
    assert found["blur_trend_x"] == pytest.approx(0.1)
    assert found["blur_curvature"] == pytest.approx(0.2)
    assert (found["contrast"], found["grey"], found["saturation"]) == (-120, 180, 0)

    # few targets tell the middle only
    points = np.array([[10.0, 10.0], [20.0, 400.0]])
    quality = {"blur": np.array([0.8, 1.0])}
    found = frame_figures(
        Observations(np.arange(2), points, np.full((2, 2), 0.01), None, quality), SMALL_SENSOR
    )
    assert found == {"blur_px": pytest.approx(0.9)}
    none = Observations(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
    assert frame_figures(none, SMALL_SENSOR) == {}
