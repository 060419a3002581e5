"""The scene as a check of the model: rendered banks, moving water, other light, a turning mount."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

import thermocald as tc
from tests.analysis.test_gauge import RATES, SD_RATE, START, thermal_camera
from tests.commands import call
from thermocald.analysis.thermal.scene import (
    SceneCourse,
    detect_features,
    estimate_movement,
    follow_scene,
    track_features,
    write_scene,
)
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import project, rotation
from thermocald.physics.model import ModelEffect
from thermocald.store.logger.temperatures import TemperatureLog

WIDTH, HEIGHT = 410, 308
NOISE = 2.0


def camera(more_per_kelvin: float = 0.0):
    """Return the gauge's camera for small frames; more_per_kelvin: added to the rate of c, µm/K."""
    thermal = thermal_camera().for_images(WIDTH, HEIGHT)
    rates = {**RATES, "c": RATES["c"] + 1e-3 * more_per_kelvin}
    return replace(thermal, model=replace(thermal.model, rates=rates))


def texture(rng: np.random.Generator, smooth: float = 1.8) -> np.ndarray:
    noise = rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
    coarse = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 8)
    fine = cv2.GaussianBlur(noise, (0, 0), smooth)
    return 120 + 25 * fine / fine.std() + 20 * coarse / coarse.std()


class Bank:
    """A still bank as seen by the cold camera, and water in half of the frame."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.bank = spline_filter(texture(self.rng).astype(float))
        self.cold = camera().at(20.0)
        u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
        self.pixels = np.stack([u.ravel(), v.ravel()], axis=1)

    def frame(self, now, turn=(0.0, 0.0, 0.0), light: float = 1.0) -> np.ndarray:
        """Render the frame of a turned camera; each pixel looks up its place in the cold frame."""
        rays = now.rays(self.pixels) @ rotation(np.array(turn)).T
        at = project(self.cold.sensor, self.cold.values, np.zeros(6), rays / -rays[:, 2:])
        # OpenCV's remap rounds to 1/32 px, a systematic error of a frame
        image = map_coordinates(self.bank, at.T[::-1], prefilter=False, mode="nearest")
        image = image.reshape(HEIGHT, WIDTH)
        water = np.zeros((HEIGHT, WIDTH), np.float32)
        water[165:300, 20:] = 1.0
        water = cv2.GaussianBlur(water, (0, 0), 3)
        image = light * (image * (1 - water) + texture(self.rng, 3.0) * water)
        noisy = image + self.rng.normal(0, NOISE, image.shape)
        return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_turn_and_principal_distance_have_true_sds():
    """Error over sd in 40 scenes; half of the frame is moving water."""
    ratio = []
    for seed in range(40):
        bank, thermal = Bank(seed), camera()
        reference = bank.frame(bank.cold)
        points = detect_features(reference)
        now = thermal.at(20.0 + bank.rng.uniform(-15, 15))
        turn = bank.rng.normal(0, 1e-3, 3)
        frame = bank.frame(now, turn, bank.rng.uniform(0.8, 1.1))
        rows, moved = track_features(reference, points, frame)
        found = estimate_movement(bank.cold, now, points[rows], moved)
        values, covariance, *_ = found
        ratio.append((values - [*turn, 0.0]) / np.sqrt(np.diag(covariance)))
    rms = np.sqrt(np.mean(np.square(ratio), axis=0))
    assert np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.0, abs=0.15), rms


NONE_OF_POINT = {"x0": 0.0, "y0": 0.0}
LACKING = {
    "": (),
    "thermal_lag": (ModelEffect("thermal_lag", {"tau": 7200.0}),),
    "self_heating": (ModelEffect("self_heating", {"tau": 3600.0, "c": 1e-2, **NONE_OF_POINT}),),
    "nonlinear_expansion": (ModelEffect("nonlinear_expansion", {"c": 5e-5, **NONE_OF_POINT}),),
    "creep": (ModelEffect("creep", {"c": 2e-7, **NONE_OF_POINT}),),
    "permanent_set": (ModelEffect("permanent_set", {"c": 4e-4, **NONE_OF_POINT}),),
}
"""Effects of up to 10 µm in c, 0.8 px in the corners of these frames; the lag up to 7 µm."""


HOURS = np.arange(0, 12.01, 1 / 12)
WARMTH = 10 + 25 * np.sin(np.pi * HOURS / 12) ** 1.5


C_SD = 0.4e-3  # mm, of c in a frame of these days; 0.03 px in the corners


@cache
def course_of(lacks: str) -> np.ndarray:
    """Return an effect's course of c in the thirteen frames of a day; its largest value is 1."""
    times, known = START + 3600 * HOURS, camera()
    true = replace(known, model=replace(known.model, effects=LACKING[lacks]))
    c = [one.along(times, {"housing": WARMTH}, times[::12]).values[:, 0] for one in (true, known)]
    beside = (c[0] - c[0][0]) - (c[1] - c[1][0])
    return beside / np.abs(beside).max()


def drawn(rng: np.random.Generator, lacks: str, size: float, noise: float = 1.0) -> SceneCourse:
    """Draw a day's course of c outside the model, with an effect of `size` sds of a frame.

    noise: true over stated noise.
    """
    T = WARMTH[::12]
    beside = size * C_SD * course_of(lacks) if lacks else np.zeros(len(T))
    slope = rng.normal(0, SD_RATE) * (T - T[0])
    values = np.zeros((len(T), 4))
    values[:, 3] = beside + slope + noise * C_SD * (rng.normal(0, 1, len(T)) - rng.normal())
    values[0] = np.nan  # the reference
    covariance = np.tile(np.diag([1e-10, 1e-10, 1e-10, C_SD**2]), (len(T), 1, 1))
    unsure = np.outer(np.abs(T - T[0]) * SD_RATE, [0, 0, 0, 1.0])
    n = len(T)
    return SceneCourse(
        "", ("",) * n, START + 3600 * HOURS[::12], T, values, covariance, unsure,
        np.zeros(n, dtype=np.int64), ("",) * n, np.zeros(4), 3e-3,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "most"), [(0.7, 4), (1.0, 4), (2.0, 35)])
def test_false_alarms_are_as_rare_as_stated(noise, most):
    """1000 days: one in a thousand, or three in a hundred with twice the stated noise.

    Residuals of twelve frames do not always show that the noise is larger than stated.
    """
    rng = np.random.default_rng(31)
    assert sum(drawn(rng, "", 0.0, noise).model_misses for _ in range(1000)) <= most


@pytest.mark.parametrize("lacks", [name for name in LACKING if name])
def test_a_missing_effect_is_found_in_the_course_of_a_day(lacks):
    """Effects of 8 and 16 sds, 0.27 and 0.54 px in the corners; benchmarks.river renders days."""
    rng = np.random.default_rng(32)
    assert "the model misses an effect" in str(drawn(rng, lacks, 30.0))
    for size, fewest in ((8.0, 27), (16.0, 35)):
        assert sum(drawn(rng, lacks, size).model_misses for _ in range(40)) >= fewest


def test_a_knock_is_no_slope_of_the_turns():
    """The slope of a mount that stood still was 2 to 12 standard deviations off."""
    rng, off = np.random.default_rng(33), []
    for _ in range(40):
        day = drawn(rng, "", 0.0)
        day.values[1:, :3] = 1e-5 * rng.normal(size=(len(day.times) - 1, 3))
        day.values[int(rng.integers(4, len(day.times) - 2)) :, :2] += 5e-4
        slopes, sds = day.per_kelvin
        off.append(slopes[:2] / sds[:2])
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(0.9, abs=0.15)
    at_once = replace(day, temperatures=np.where(day.values[:, 0] > 2.5e-4, 30.0, 20.0))
    assert "cannot be told from its movements" in str(at_once)


def test_a_movement_is_reported_with_its_frame(tmp_path):
    bank, thermal = Bank(11), camera()
    turned = np.array([3e-4, -4e-4, 0.0])
    frames = []
    warmth = np.array([20.0, 24.0, 28.0, 30.0, 32.0])
    for k, T in enumerate(warmth):
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), bank.frame(thermal.at(T), turned if k > 2 else np.zeros(3)))
        frames.append((path, START + 600.0 * k))
    log = TemperatureLog(START + 600.0 * np.arange(5), {"housing": warmth})
    course = follow_scene(thermal, log, frames)
    ((row, turn, covariance),) = course.movements
    assert row == 3
    error = turn - turned
    assert error @ np.linalg.solve(covariance, error) < 16  # 3 degrees of freedom, one in 1000
    assert "3.png: the camera was moved since the frame before: it turned by 0.02" in str(course)
    assert course.as_dict()["movements"][0]["frame"] == "3.png"


def test_replay_follows_a_folder_of_photographs(tmp_path):
    """The command takes times from file names, the log from a CSV, the model from a file."""
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    bank, thermal = Bank(300), camera()
    with (tmp_path / "log.csv").open("w") as log:
        log.write("time,temperature\n")
        for k, T in enumerate((20.0, 24.0, 28.0, 32.0, 36.0)):
            name = f"{20260504 + k}-120000.png"
            cv2.imwrite(str(photographs / name), bank.frame(thermal.at(T)))
            log.write(f"2026-05-0{4 + k}T12:00:00Z,{T}\n")
    thermal.save(tmp_path / "camera.yaml")
    done = call(
        "replay", photographs, "--model", tmp_path / "camera.yaml", "--log", tmp_path / "log.csv",
        "--times", "name", "--timezone", "UTC",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "4 of 5 frames follow the reference frame" in done.stdout
    assert "consistent with the model" in done.stdout
    alone = call("replay", photographs, "--model", tmp_path / "camera.yaml")
    assert alone.returncode == 2
    assert "go together" in alone.stderr


def test_frames_of_night_and_of_another_scene_have_no_movement(tmp_path):
    bank, other = Bank(7), Bank(8)
    images = [bank.frame(bank.cold), bank.frame(bank.cold) // 60, other.frame(bank.cold)]
    frames = []
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        frames.append((tmp_path / f"{k}.png", START + k))
    log = TemperatureLog(START + np.arange(3.0), {"housing": np.full(3, 20.0)})
    course = follow_scene(camera(), log, frames)
    assert not course.seen.any()
    assert "too few features" in course.reasons[2]
    assert "hardly changed" in str(course)


def test_frames_that_cannot_be_followed_are_refused(tmp_path):
    with pytest.raises(DataError, match="features"):
        detect_features(np.full((HEIGHT, WIDTH), 90, np.uint8))
    with pytest.raises(DataError, match="at least one more"):
        follow_scene(camera(), TemperatureLog(np.array([START]), {}), [])


def warm_day(count: int, lag_s: float):
    """Return a day's times, temperatures and true states of a camera whose lag the model lacks."""
    known, lag = camera(), ModelEffect("thermal_lag", {"tau": lag_s})
    hours = np.linspace(0, 10, 4 * count - 3)
    T = 10 + 25 * np.sin(np.pi * hours / 10) ** 1.5
    times = START + 3600 * hours
    true = replace(known, model=replace(known.model, effects=(lag,)))
    return times, T, true.along(times, {"housing": T}, times[::4])


def test_still_features_give_a_recording(tmp_path):
    """Changes of c, x0 and y0 are true within their sds; features that disappear are left out."""
    rng = np.random.default_rng(41)
    times, T, states = warm_day(40, 1800.0)
    corners = rng.uniform([5, 5], [WIDTH - 5, HEIGHT - 5], (150, 2))
    tracks = []
    for state in states:
        at = states[0].as_seen_by(corners, state.interior) + rng.normal(0, 0.04, corners.shape)
        rows = np.flatnonzero(np.arange(150) % 10 != 0) if len(tracks) > 4 else np.arange(150)
        tracks.append((rows, at[rows]))
    tracks[7] = None
    log = TemperatureLog(times, {"housing": T})
    kept = write_scene(tmp_path / "R", states[0], log, times[::4], corners, tracks)
    series = tc.open(tmp_path / "R")
    epochs = series.calibrate(exterior="series")
    assert (kept, len(series), len(series.testfield), int(epochs.ok.sum())) == (135, 40, 135, 39)
    good = epochs.ok
    truth = np.array([state.values[:3] for state in states])[good]
    error = epochs.values[good, :3] - truth
    ratio = (error - error.mean(axis=0)) / epochs.sd[good, :3]
    # the sds include a trend, of which one day is a single draw
    assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.1
    short = [None if t is None else (t[0][:11], t[1][:11]) for t in tracks]
    with pytest.raises(DataError, match="11 features"):
        write_scene(tmp_path / "S", states[0], log, times[::4], corners, short)
    assert not (tmp_path / "S").exists()


@pytest.mark.slow
def test_discover_names_the_missing_effect_from_the_scene_alone(tmp_path):
    """`replay` writes a recording from photographs; half of the frame is moving water."""
    bank = Bank(900)
    times, T, states = warm_day(41, 1800.0)
    bank.cold = states[0]
    (tmp_path / "photographs").mkdir()
    for k, state in enumerate(states):
        moment = datetime.fromtimestamp(times[4 * k], UTC)
        cv2.imwrite(str(tmp_path / f"photographs/{moment:%Y%m%d-%H%M%S}.png"), bank.frame(state))
    warm = T + bank.rng.normal(0, 0.05, T.size)
    rows = [f"{t:.3f},{v:.3f}" for t, v in zip(times, warm, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["unix_time,housing", *rows]) + "\n")
    camera().save(tmp_path / "camera.yaml")
    out = tmp_path / "bank"
    done = call(
        "replay", tmp_path / "photographs", "--model", tmp_path / "camera.yaml", "--log",
        tmp_path / "log.csv", "--times", "name", "--timezone", "UTC", "--recording-out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = tc.discover(tc.open(out)).as_dict()
    assert found["effects"][0]["effect"] == "thermal_lag"
    tau = found["effects"][0]["estimates"]["tau"]
    assert abs(tau["value"] - 1800.0) < 4 * tau["sd"] + 30.0, tau  # file names have whole seconds
