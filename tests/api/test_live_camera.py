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


def course(epochs: int, interval: float, seed: int = 0):
    """Return uneven times, and temperatures of a warm-up and cooling with noise, °C."""
    rng = np.random.default_rng(seed)
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


def followed(camera: tc.ThermalCamera, times, temperatures, channels=None):
    live = camera.live()
    return [
        live.update(t, T if channels is None else {"temperature": T, "board": channels[k]})
        for k, (t, T) in enumerate(zip(times, temperatures, strict=True))
    ]


def assert_same(found: list[tc.Camera], along: tc.Along):
    scale = np.maximum(along.sd.max(axis=0), 1e-12)
    for k, now in enumerate(found):
        assert np.abs((now.values - along.values[k]) / scale).max() < 1e-9
        np.testing.assert_allclose(
            now.covariance / np.outer(scale, scale),
            along.covariance[k] / np.outer(scale, scale), atol=1e-9,
        )  # fmt: skip


@pytest.mark.parametrize("name", catalogue.names())
def test_every_effect_follows_as_along_says(name):
    camera = tc.ThermalCamera(thermal_model(effect_of(name)))
    times, T = course(60, 10.0)
    board = T + 2.0 * np.sin(times / 50.0)
    found = followed(camera, times, T, board)

    for k in (0, 1, 2, 30, 59):
        along = camera.along(
            times[: k + 1], {"temperature": T[: k + 1], "board": board[: k + 1]}, [times[k]],
        )  # fmt: skip
        assert_same([found[k]], along)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_lag_delay_and_play_together(order):
    camera = tc.ThermalCamera(thermal_model(*(CHAIN[i] for i in order)))
    times, T = course(200, 5.0)

    assert_same(followed(camera, times, T), camera.along(times, T))


def test_a_delay_ahead_of_its_time_is_asked_for_again():
    """T with late times, then a lag: each reading changes earlier predictions."""
    ahead = ModelEffect("time_offset", {"d": -20.0}, {"d": 0.5})
    camera = tc.ThermalCamera(thermal_model(ahead, CHAIN[0]))
    times, T = course(40, 10.0)

    found = followed(camera, times, T)
    for k in (5, 39):
        assert_same([found[k]], camera.along(times[: k + 1], T[: k + 1], [times[k]]))


@pytest.mark.slow
def test_an_hour_at_ten_hertz():
    """36,000 readings; the state does not drift away from the batch."""
    camera = tc.ThermalCamera(thermal_model(*CHAIN))
    times = 0.1 * np.arange(36_000)
    T = 35.0 + 10.0 * np.sin(times / 700.0) + np.random.default_rng(1).normal(0, 0.02, len(times))
    found = followed(camera, times, T)
    along = camera.along(times, T)

    assert_same(found[::3000] + found[-1:], replace_rows(along, [*range(0, 36_000, 3000), 35_999]))


def replace_rows(along: tc.Along, rows: list[int]) -> tc.Along:
    names = ("times", "temperatures", "values", "covariance", "extrapolated")
    return replace(along, **{n: getattr(along, n)[rows] for n in names})


def test_frames_as_the_steady_camera_had_seen_them():
    """A point of the scene is where the camera at T0 would image it, to 0.05 px."""
    cv2 = pytest.importorskip("cv2")
    base = thermal_model(CHAIN[0])
    camera = tc.ThermalCamera(replace(base, rates={"c": 2e-3, "x0": 1e-3, "y0": -8e-4}))
    size = (820, 616)
    live = camera.live(size)
    small = camera.for_images(*size)
    steady = small.at(base.T0, extrapolate=True)
    rays = steady.rays(np.array([[150.0, 100.0], [410.0, 308.0], [700.0, 500.0]]))
    scene = 1000.0 * rays
    times, T = course(30, 20.0)
    maps = []
    for t, temperature in zip(times, T, strict=True):
        now = live.update(t, temperature)
        seen = now.project(scene, np.zeros(6))
        frame = np.zeros((size[1], size[0]), np.uint8)
        for x, y in seen:
            cv2.circle(frame, (round(16 * x), round(16 * y)), 16 * 9, 255, -1, cv2.LINE_AA, 4)
        corrected = live.correct(frame)
        maps.append(live.maps())
        for ray, (x, y) in zip(rays, steady.project(scene, np.zeros(6)), strict=True):
            window = corrected[round(y) - 20 : round(y) + 21, round(x) - 20 : round(x) + 21]
            weight = window.astype(float)
            v, u = np.mgrid[round(y) - 20 : round(y) + 21, round(x) - 20 : round(x) + 21]
            centre = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
            assert np.abs(centre - [x, y]).max() < 0.12, (temperature, centre, ray)
    renewed = sum(a is not b for a, b in zip(maps[1:], maps[:-1], strict=True))
    assert 10 <= renewed <= 29


def test_another_thermometer_outside_its_range_widens_too(camera):
    """By the whole drift that follows it; far outside it is refused, at, along and live."""
    rate = 2e-4  # mm/K
    heat = ModelEffect("second_heat_source", {"channel": "board_temperature", "x0": rate}, {})
    model = replace(camera.model, effects=(heat,), covariance=None)
    two = replace(camera, model=model)
    high = model.validity["board_temperature"][1]
    times = np.array([0.0, 10.0])

    def cameras(board):
        one = {"temperature": 35.0, "board_temperature": board}
        live = two.live()
        live.update(0.0, one | {"board_temperature": 35.0})
        log = {"temperature": [35.0, 35.0], "board_temperature": [35.0, board]}
        yield two.at(35.0, channels={"board_temperature": board})
        yield two.along(times, log)[1]
        yield live.update(10.0, one)

    within = [now.covariance[1, 1] for now in cameras(high)]
    with pytest.warns(UserWarning, match=r"of board_temperature is 4\.0 K outside"):
        beyond = list(cameras(high + 4.0))
    for now, before in zip(beyond, within, strict=True):
        assert now.extrapolated == pytest.approx(4.0)
        assert now.covariance[1, 1] == pytest.approx(before + (4.0 * rate) ** 2, rel=1e-6)
    with pytest.raises(UsageError, match=r"of board_temperature is 100\.0 K outside"):
        two.at(35.0, channels={"board_temperature": high + 100.0})
    assert len(two.plot().axes) == 3  # which takes all thermometers to be as warm


def test_what_is_wrong_is_said():
    live = tc.ThermalCamera(thermal_model()).live((1640, 1232))
    with pytest.raises(UsageError, match="the frame is a list: give an array"):
        live.correct([[1, 2], [3, 4]])
    with pytest.raises(UsageError, match="no reading yet"):
        live.correct(np.zeros((1232, 1640), np.uint8))
    live.update(0.0, 30.0)
    with pytest.raises(UsageError, match="not later than the last reading"):
        live.update(0.0, 30.0)
    with pytest.raises(UsageError, match=r"live\(size=\(640, 480\)\)"):
        live.correct(np.zeros((480, 640), np.uint8))
    with pytest.raises(UsageError, match="frame of bool cannot be resampled"):
        live.correct(np.zeros((1232, 1640), bool))
    with pytest.raises(UsageError, match="outside"):
        live.update(1.0, 150.0)
    assert live.update(2.0, float("nan")).temperature == 30.0
