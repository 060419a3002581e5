"""The linearisation does not bias the rates of a camera with a large temperature range."""

from __future__ import annotations

import numpy as np
import pytest

import thermocald as tc
from benchmarks.adjustment import EXTERIOR, INTERIOR, SENSOR
from benchmarks.long_recording import INTERVAL_S, RATES, field_of, write_long_recording
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.physics.model import follow_angle
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.series import SeriesInput

NAMES = ("c", "x0", "y0")


def series_of(epochs):
    """A year of image points without noise: 36 K, more on one side of the mean."""
    field = field_of(21)
    u = np.linspace(0, 1, epochs)
    T = 16 + 12 * np.sin(2 * np.pi * u) + 6 * np.sin(4 * np.pi * u + 1)
    values = np.tile(INTERIOR.as_array(), (epochs, 1))
    for column, rate in RATES.items():
        values[:, column] += rate * (T - 15.0)
    values = follow_angle(values, INTERIOR.c)
    points = project(SENSOR, values, np.tile(EXTERIOR.as_array(), (epochs, 1)), field.points)
    weights = np.zeros((*points.shape[:2], 3))
    weights[..., :2] = 1e4
    times = INTERVAL_S * np.arange(epochs)
    return SeriesInput(
        name="far", series="far", camera="rpi", sensor=SENSOR, field=field,
        grid=ObservationGrid(points, weights), numbers=np.arange(epochs), frame_times=times,
        reading_times=times, readings={"temperature": T}, resolutions={"temperature": None},
        principal_distance=INTERIOR.c,
    )  # fmt: skip


def test_the_rates_of_a_large_range():
    reduced = reduce_series(series_of(300), strict=False)
    fitted = fit_thermal_model([reduced], [])
    for column, name in enumerate(NAMES):
        assert fitted.model.rates[name] == pytest.approx(RATES[column], rel=3e-6)


@pytest.mark.slow
def test_the_scatter_of_long_series(tmp_path):
    """Errors of the rates over their standard deviations, from ten series of 30,000 epochs."""
    pytest.importorskip("pyarrow")
    ratios, noise = [], []
    for seed in range(10):
        path = tmp_path / f"{seed}"
        write_long_recording(path, 30_000, 21, seed=seed)
        series = tc.open(path).observed()
        assert series.counts is not None  # of means
        fitted = fit_thermal_model([reduce_series(series, strict=False)], [])
        sds = fitted.model.sds
        ratios.append([(fitted.model.rates[n] - RATES[k]) / sds[f"rates.{n}"]
                       for k, n in enumerate(NAMES)])  # fmt: skip
        noise.append(fitted.fitted["series"][0].thermometer_sd)
    # thirty values estimate a standard deviation to 13 %
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.25
    assert np.median(noise) == pytest.approx(0.02, rel=0.15)
