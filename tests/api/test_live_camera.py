"""The live camera: equal to `along` for the same history, reading by reading; frames corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from tests.analysis.test_thermal_camera import thermal_model
from thermocald.errors import UsageError
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect

CHAIN = (
    ModelEffect("thermal_lag", {"tau": 80.0}, {"tau": 2.0}),
    ModelEffect("time_offset", {"d": 12.0}, {"d": 0.5}),
    ModelEffect("hysteresis", {"half_width": 0.5}, {"half_width": 0.05}),
)
AHEAD = ModelEffect("time_offset", {"d": -20.0}, {"d": 0.5})


def course(epochs: int, interval: float):
    """Return uneven times, and temperatures of a warm-up and cooling with noise, °C."""
    rng = np.random.default_rng(0)
    times = np.cumsum(interval * rng.uniform(0.6, 1.4, epochs))
    phase = np.linspace(0.0, 2.5 * np.pi, epochs)
    return times, 34.0 + 11.0 * np.sin(phase) + rng.normal(0.0, 0.05, epochs)


def effect_of(name: str) -> ModelEffect:
    """Return an effect of the catalogue with all its values and their standard deviations."""
    kind = catalogue.get(name)
    values: dict = {k: p.default for k, p in kind.nonlinear.items() if not p.text}
    values |= {k: "board" for k, p in kind.nonlinear.items() if p.unit == "name"}
    values |= {k: ("1",) for k, p in kind.nonlinear.items() if p.unit == "names"}
    values |= dict.fromkeys(kind.usual, 1e-5)
    return ModelEffect(name, values, {k: 1e-6 for k, v in values.items() if isinstance(v, float)})


def assert_same(found: list[tc.Camera], along: tc.Along):
    scale = np.maximum(along.sd.max(axis=0), 1e-12)
    area = np.outer(scale, scale)
    for k, now in enumerate(found):
        assert np.abs((now.values - along.values[k]) / scale).max() < 1e-9
        np.testing.assert_allclose(now.covariance / area, along.covariance[k] / area, atol=1e-9)


@pytest.mark.parametrize(
    "effects",
    [
        *(pytest.param((effect_of(name),), id=name) for name in catalogue.names()),
        pytest.param(CHAIN, id="lag, delay and play"),
        pytest.param((CHAIN[2], *CHAIN[:2]), id="play, lag and delay"),
        # with late times, each reading changes earlier predictions
        pytest.param((AHEAD, CHAIN[0]), id="a delay ahead of its time and a lag"),
    ],
)
def test_effects_follow_as_along_says(effects):
    camera = tc.ThermalCamera(thermal_model(*effects))
    times, T = course(60, 10.0)
    board = T + 2.0 * np.sin(times / 50.0)
    live = camera.live()
    found = [live.update(t, {"temperature": T[k], "board": board[k]}) for k, t in enumerate(times)]
    for k in (0, 1, 2, 30, 59):
        log = {"temperature": T[: k + 1], "board": board[: k + 1]}
        assert_same([found[k]], camera.along(times[: k + 1], log, [times[k]]))


@pytest.mark.slow
def test_an_hour_at_ten_hertz():
    """36,000 readings; the state does not drift away from the batch."""
    camera = tc.ThermalCamera(thermal_model(*CHAIN))
    times = 0.1 * np.arange(36_000)
    T = 35.0 + 10.0 * np.sin(times / 700.0) + np.random.default_rng(1).normal(0, 0.02, len(times))
    live, rows = camera.live(), [*range(0, 36_000, 3000), 35_999]
    found = [live.update(t, temperature) for t, temperature in zip(times, T, strict=True)]
    assert_same([found[k] for k in rows], camera.along(times, T, times[rows]))


def test_frames_as_the_steady_camera_had_seen_them():
    """A point of the scene is where the camera at T0 would image it, to a tenth of a pixel."""
    cv2 = pytest.importorskip("cv2")
    base = thermal_model(CHAIN[0])
    camera = tc.ThermalCamera(replace(base, rates={"c": 2e-3, "x0": 1e-3, "y0": -8e-4}))
    size = (820, 616)
    live = camera.live(size)
    steady = camera.for_images(*size).at(base.T0, extrapolate=True)
    scene = 1000.0 * steady.rays(np.array([[150.0, 100.0], [410.0, 308.0], [700.0, 500.0]]))
    maps = []
    for t, temperature in zip(*course(30, 20.0), strict=True):
        now = live.update(t, temperature)
        frame = np.zeros((size[1], size[0]), np.uint8)
        for x, y in now.project(scene, np.zeros(6)):
            cv2.circle(frame, (round(16 * x), round(16 * y)), 16 * 9, 255, -1, cv2.LINE_AA, 4)
        corrected = live.correct(frame)
        maps.append(live.maps())
        for x, y in steady.project(scene, np.zeros(6)):
            v, u = np.mgrid[round(y) - 20 : round(y) + 21, round(x) - 20 : round(x) + 21]
            weight = corrected[v, u].astype(float)
            centre = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
            assert np.abs(centre - [x, y]).max() < 0.12, (temperature, centre)
    renewed = sum(a is not b for a, b in zip(maps[1:], maps[:-1], strict=True))
    assert 10 <= renewed <= 29


def test_another_thermometer_outside_its_range_widens_too(camera):
    """By the whole drift that follows it; far outside it is refused, at, along and live."""
    rate = 2e-4  # mm/K
    heat = ModelEffect("second_heat_source", {"channel": "board_temperature", "x0": rate}, {})
    two = replace(camera, model=replace(camera.model, effects=(heat,), covariance=None))
    high = two.model.validity["board_temperature"][1]

    def cameras(board):
        log = {"temperature": [35.0, 35.0], "board_temperature": [35.0, board]}
        live = two.live()
        live.update(0.0, {"temperature": 35.0, "board_temperature": 35.0})
        yield two.at(35.0, channels={"board_temperature": board})
        yield two.along([0.0, 10.0], log)[1]
        yield live.update(10.0, {"temperature": 35.0, "board_temperature": board})

    within = [now.covariance[1, 1] for now in cameras(high)]
    with pytest.warns(UserWarning, match=r"of board_temperature is 4\.0 K outside"):
        beyond = list(cameras(high + 4.0))
    for now, before in zip(beyond, within, strict=True):
        assert now.extrapolated == pytest.approx(4.0)
        assert now.covariance[1, 1] == pytest.approx(before + (4.0 * rate) ** 2, rel=1e-6)
    with pytest.raises(UsageError, match=r"of board_temperature is 100\.0 K outside"):
        two.at(35.0, channels={"board_temperature": high + 100.0})
    assert len(two.plot().axes) == 3  # which takes all thermometers to be as warm
