"""Long series: condensed to means, an afternoon in a year, effects that take a year."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from year_of_means import DAY, year

import thermocald as tc
from benchmarks.adjustment import EXTERIOR, INTERIOR, SENSOR
from benchmarks.long_recording import INTERVAL_S, RATES, field_of, write_long_recording
from tests.blocks import InBlocks
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.discovery.result import discover_series
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.physics.model import follow_angle
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.series import SeriesInput, in_blocks
from thermocald.thermal.source import condensed

LAG_S = 1200.0


def cellar(t):
    """The temperature of a cellar: 1 K over the year, and one afternoon with open shutters."""
    slow = 15.0 + np.sin(2 * np.pi * t / (365 * DAY))
    return slow + 12.0 * np.exp(-0.5 * ((t - 200.6 * DAY) / (0.06 * DAY)) ** 2)


def outdoors(t):
    weather = np.sin(t / (5.3 * DAY)) + np.sin(t / (2.1 * DAY) + 1.0)
    year_ = 10.0 * np.sin(2 * np.pi * t / (365 * DAY))
    return 15.0 + year_ + 5.0 * np.sin(2 * np.pi * t / DAY) + weather


def behind(at, _):
    """The cellar's temperature with a lag, in steps of 10 s about the afternoon."""
    fine = np.arange(199.0 * DAY, 203.0 * DAY, 10.0)
    a, late = np.exp(-10.0 / LAG_S), [cellar(fine[0])]
    for warm in cellar(fine[1:]):
        late.append(a * late[-1] + (1 - a) * warm)
    near = (at > 199.5 * DAY) & (at < 202.5 * DAY)
    # for a slow change, a lag is a delay
    return np.where(near, np.interp(at, fine + 5.0, late), cellar(at - LAG_S))


def test_the_afternoon_keeps_short_rows():
    (evidence,) = year(cellar, behind, 5, targets=12)
    blocks = in_blocks(evidence, rows=300)
    assert len(blocks.times) <= 300
    inside = (blocks.times > 200.3 * DAY) & (blocks.times < 200.95 * DAY)
    assert inside.sum() > 25  # a day elsewhere has one at most
    np.testing.assert_allclose(blocks.N.sum(axis=0), evidence.N.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(blocks.b.sum(axis=0), evidence.b.sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(blocks.averaged(evidence.times), blocks.times, rtol=1e-9)
    fewer = (evidence.n > 0).sum() - (blocks.n > 0).sum()
    assert blocks.blocks.within_free == evidence.rank * fewer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("temperature", "drives", "effect", "number", "true", "sds"),
    [
        (cellar, behind, "thermal_lag", "tau", LAG_S, 3),
        (outdoors, lambda at, T: T + 2.0 * at / (365 * DAY), "creep", "a_c",
         2.0 * 2e-4 / (365 * DAY), 4),
        (outdoors, lambda at, T: T + 1.5 * (at > 123.6 * DAY), "slip", "time", 123.6 * DAY, 3),
    ],
    ids=["hidden in one afternoon", "takes a year", "comes on one day"],
)  # fmt: skip
def test_an_effect_in_a_year_is_named(temperature, drives, effect, number, true, sds):
    found = discover_series(year(temperature, drives, 3))
    assert [e.effect for e in found.effects] == [effect]
    said = found.effects[0].estimates[number]
    assert said["value"] == pytest.approx(true, abs=sds * said["sd"])


@pytest.mark.slow
def test_nothing_is_found_in_a_year_without_an_effect():
    assert discover_series(year(outdoors, lambda _, T: T, 3)).verdict == "adequate"


E = 7200


def series_of(field, points, times, T, sigma):
    weights = np.zeros((*points.shape[:2], 3))
    weights[..., :2] = 1.0 / sigma**2
    return SeriesInput(
        "long", "camera", SENSOR, field, INTERIOR.c, times, times, {"temperature": T},
        {"temperature": None}, ObservationGrid(points, weights), np.arange(len(times)) + 1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recorded():
    """A sine of 80 s for one of 30 hours; one point in epoch 4001 has a gross error."""
    rng = np.random.default_rng(1)
    t, field = 15.0 * np.arange(E), field_of(9)
    fast = np.where((t > 20 * 3600) & (t < 21 * 3600), 0.5 * np.sin(2 * np.pi * t / 600), 0.0)
    points = rng.uniform(200, 2800, (9, 2)) + fast[:, None, None] + rng.normal(0, 0.05, (E, 9, 2))
    points[4001, 3] += 30.0
    hidden = np.zeros((E, 9), dtype=bool)
    hidden[100:150, 2] = True
    whole = series_of(field, points, t, 20 + 5 * np.sin(t / 40_000) + rng.normal(0, 0.03, E), 0.05)
    return whole, whole.grid.reject(hidden)


def test_rows_are_weighted_means_without_gross_errors_and_short_where_it_is_fast(recorded):
    whole, grid = recorded
    out = condensed(whole, InBlocks(grid, 911), most=500)
    assert out.counts.sum() == E
    assert len(out.counts) <= 550
    first = out.numbers - 1
    row = int(np.searchsorted(first, 100, side="right")) - 1
    part = slice(int(first[row]), int(first[row] + out.counts[row]))
    w = grid.weights[part, :, 0]
    mean = np.nansum(w[..., None] * grid.points[part], axis=0) / w.sum(axis=0)[:, None]
    np.testing.assert_allclose(out.grid.points[row], mean, atol=1e-9)
    np.testing.assert_allclose(out.grid.weights[row, :, 0], w.sum(axis=0), rtol=1e-12)
    assert out.frame_times[row] == pytest.approx(whole.frame_times[part].mean())
    noise = out.noises["temperature"] * np.sqrt(out.counts)
    np.testing.assert_allclose(noise, 0.03, rtol=0.1)
    row = int(np.searchsorted(out.numbers, 4002, side="right")) - 1
    fine = np.nanmedian(grid.points[4001 - 100 : 4001 + 100, 3], axis=0)
    np.testing.assert_allclose(out.grid.points[row, 3], fine, atol=0.1)
    fast = (out.frame_times > 20 * 3600) & (out.frame_times < 21 * 3600)
    assert np.mean(out.counts[fast]) * 2 < np.median(out.counts[~fast])


def test_the_blocks_that_are_read_do_not_matter(recorded):
    whole, grid = recorded
    coarse = replace(whole, resolutions={"temperature": 0.5})
    one, other = (condensed(coarse, InBlocks(grid, size), most=500) for size in (E, 480))
    assert one.noises["temperature"].min() > 0.04  # what the steps hide is no noise of each reading
    # except for points at the limit of gross errors
    assert np.mean(np.abs(one.grid.points - other.grid.points) > 1e-9) < 0.002
    np.testing.assert_array_equal(one.counts, other.counts)


NAMES = ("c", "x0", "y0")


def test_the_rates_of_a_large_range():
    """A year of image points without noise: 36 K, more on one side of the mean."""
    u = np.linspace(0, 1, 300)
    T = 16 + 12 * np.sin(2 * np.pi * u) + 6 * np.sin(4 * np.pi * u + 1)
    values = np.tile(INTERIOR.as_array(), (300, 1))
    for column, rate in RATES.items():
        values[:, column] += rate * (T - 15.0)
    exterior, field = np.tile(EXTERIOR.as_array(), (300, 1)), field_of(21)
    points = project(SENSOR, follow_angle(values, INTERIOR.c), exterior, field.points)
    series = series_of(field, points, INTERVAL_S * np.arange(300), T, 0.01)
    fitted = fit_thermal_model([reduce_series(series, strict=False)], [])
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
