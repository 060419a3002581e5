"""The scene as a check of the model: rendered banks, moving water, other light, a turning mount.

At last real corners as a scene: boards of unknown depth, and two boards' corners as control points.
Nothing is heated in these fifty seconds; the cameras tremble by some hundredths of a pixel. Known
rotations and changes of c are applied to the image points of single epochs.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

import thermocald as tc
from tests.analysis.test_gauge import SD_RATE, START, thermal_camera
from tests.commands import call, finish
from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import Calibrator
from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.scene import (
    SceneCourse,
    detect_features,
    estimate_movement,
    follow_scene,
    track_features,
    write_scene,
)
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import partials, project, rotation
from thermocald.physics.model import ModelEffect
from thermocald.store.logger.temperatures import TemperatureLog
from thermocald.store.recording.reader import read_recording

WIDTH, HEIGHT = 410, 308
NOISE = 2.0


def camera():
    """Return the gauge's camera for small frames."""
    return thermal_camera().for_images(WIDTH, HEIGHT)


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
        if seed % 2:  # 12 bit
            reference, frame = (image.astype(np.uint16) << 4 for image in (reference, frame))
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
    locked = replace(day, locked=np.array([3e-4, 3e-4, 3e-4, 0.0])).per_kelvin[1]
    ends = np.full(2, 6e-4 / np.ptp(WARMTH[12::12]))  # errors that more frames do not reduce
    np.testing.assert_allclose(locked[:2] ** 2 - sds[:2] ** 2, ends**2, rtol=1e-6)
    at_once = replace(day, temperatures=np.where(day.values[:, 0] > 2.5e-4, 30.0, 20.0))
    assert "cannot be told from its movements" in str(at_once)


def followed(folder, images, warmth):
    """Follow images, 600 s apart, with the readings of the thermometer."""
    times = START + 600.0 * np.arange(len(images))
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    frames = [(folder / f"{k}.png", time) for k, time in enumerate(times)]
    return follow_scene(camera(), TemperatureLog(times, {"housing": np.array(warmth)}), frames)


def test_features_in_few_places_give_no_movement_with_small_sds():
    """Of one or two places, errors were 7 to 20 sds: a still camera "was moved" in 97 of 100."""
    rng, corner, known = np.random.default_rng(34), np.arange(16), camera().at(20.0)
    ratio = []
    for places, features in (*[(2, 8)] * 3, *[(20, 2)] * 60):
        at = rng.choice(8 * 6, places, replace=False)
        near = np.array([rng.choice(corner, features, replace=False) for _ in at])
        x, y = 44 + 42 * (at[:, None] % 8) + 10 * (near % 4), 44 + 42 * (at[:, None] // 8)
        points = np.stack([x, y + 10 * (near // 4)], axis=-1).astype(float)
        moved = 0.04 * (rng.normal(size=points.shape) + rng.normal(size=(places, 1, 2)))
        found = estimate_movement(known, known, points.reshape(-1, 2), moved.reshape(-1, 2))
        assert (found is None) == (places == 2)
        if found:
            ratio.append(found[0] / np.sqrt(found[1].diagonal()))
    assert np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.1, abs=0.12)


def test_a_movement_is_reported_with_its_frame(tmp_path):
    bank, turned = Bank(11), np.array([3e-4, -4e-4, 0.0])
    warmth = [20.0, 24.0, 28.0, 30.0, 32.0]
    turns = [np.zeros(3)] * 3 + [turned] * 2
    images = [bank.frame(camera().at(T), turn) for T, turn in zip(warmth, turns, strict=True)]
    course = followed(tmp_path, images, warmth)
    ((row, turn, covariance),) = course.movements
    assert row == 3
    error = turn - turned
    assert error @ np.linalg.solve(covariance, error) < 16  # 3 degrees of freedom, one in 1000
    assert "3.png: the camera was moved since the frame before: it turned by 0.02" in str(course)
    assert course.as_dict()["movements"][0]["frame"] == "3.png"


def test_frames_of_night_and_of_another_scene_have_no_movement(tmp_path):
    bank, other = Bank(7), Bank(8)
    day = bank.frame(bank.cold)
    course = followed(tmp_path, [day, day // 60, other.frame(bank.cold)], [20.0] * 3)
    assert not course.seen.any()
    assert "too few features" in course.reasons[2]
    assert "hardly changed" in str(course)


def replayed(folder, images, times, log, *more):
    """Run `replay` on a folder of photographs with a CSV log and the camera's model."""
    (folder / "photographs").mkdir()
    for image, time in zip(images, times, strict=True):
        name = f"{datetime.fromtimestamp(time, UTC):%Y%m%d-%H%M%S}.png"
        cv2.imwrite(str(folder / "photographs" / name), image)
    rows = [f"{t:.3f},{v:.3f}" for t, v in log]
    (folder / "log.csv").write_text("\n".join(["unix_time,housing", *rows]) + "\n")
    camera().save(folder / "camera.yaml")
    return finish(
        "replay", folder / "photographs", "--model", folder / "camera.yaml", "--log",
        folder / "log.csv", "--times", "name", "--timezone", "UTC", *more,
    ).stdout  # fmt: skip


def test_replay_follows_a_folder_of_photographs(tmp_path):
    """The command takes times from file names, the log from a CSV, the model from a file."""
    bank, warmth = Bank(300), (20.0, 24.0, 28.0, 32.0, 36.0)
    times = START + 86400.0 * np.arange(5)
    images = [bank.frame(camera().at(T)) for T in warmth]
    said = replayed(tmp_path, images, times, zip(times, warmth, strict=True))
    assert "4 of 5 frames follow the reference frame" in said
    assert "consistent with the model" in said
    alone = call("replay", tmp_path / "photographs", "--model", tmp_path / "camera.yaml")
    assert alone.returncode == 2
    assert "go together" in alone.stderr


def test_frames_of_10_bit_in_16_are_followed_as_those_of_8():
    """They had four grey levels, and twelve features were left."""
    bank = Bank(7)
    images = [bank.frame(camera().at(T)) for T in (20.0, 30.0)]
    points = detect_features(images[0])
    rows, moved = track_features(images[0], points, images[1])
    wide = [image.astype(np.uint16) * 4 for image in images]
    again = track_features(wide[0], detect_features(wide[0]), wide[1])
    np.testing.assert_array_equal(again[0], rows)
    np.testing.assert_array_equal(again[1], moved)


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
    bank, out = Bank(900), tmp_path / "bank"
    times, T, states = warm_day(41, 1800.0)
    bank.cold = states[0]
    warm = T + bank.rng.normal(0, 0.05, T.size)
    images = map(bank.frame, states)
    replayed(tmp_path, images, times[::4], zip(times, warm, strict=True), "--recording-out", out)
    found = tc.discover(tc.open(out)).as_dict()
    assert found["effects"][0]["effect"] == "thermal_lag"
    tau = found["effects"][0]["estimates"]["tau"]
    assert abs(tau["value"] - 1800.0) < 4 * tau["sd"] + 30.0, tau  # file names have whole seconds


CORNER_PX = 0.09  # largest scatter of a static corner: ../shared/data/README.md
EVERY = 8  # epochs


class Room:
    """A fixed camera before boards, calibrated with the whole field in its first epoch."""

    def __init__(self, folder) -> None:
        recording = read_recording(folder)
        self.epochs = [e for e in recording.epochs if e.observations is not None]
        whole = Calibrator.of_recording(recording).calibrate(self.epochs[0]).adjustment
        sensor = recording.camera.sensor
        self.camera = Camera(sensor, 20.0, whole.values[:10], whole.covariance[:10, :10])
        self.board = np.array([name.split(".")[0] for name in recording.testfield.names])
        seen = [self.board[e.observations.targets] for e in self.epochs[::5]]
        self.full = [b for b in np.unique(self.board) if all((s == b).sum() == 4 for s in seen)]

    def shared(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return boards (n,) and image points (n, 2) of the corners that two epochs both see."""
        a, b = (self.epochs[k].observations for k in (i, j))
        both = np.intersect1d(a.targets, b.targets)
        at = [o.points[np.searchsorted(o.targets, both)] for o in (a, b)]
        return self.board[both], *at

    def turned(self, points: np.ndarray, turn=(0.0, 0.0, 0.0), more_c: float = 0.0) -> np.ndarray:
        """Return image points after a rotation, rad, and an increase of c, mm."""
        values = self.camera.values.copy()
        values[0] += more_c
        rays = self.camera.rays(points) @ rotation(np.array(turn))
        return project(self.camera.sensor, values, np.zeros(6), rays / -rays[:, 2:])

    def control_turn(self, points: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Estimate the rotation (3,) and its covariance from control points alone."""
        rays = self.camera.rays(points)
        at = rays / -rays[:, 2:]
        _, J, _ = partials(self.camera.sensor, self.camera.values, np.zeros(6), at)
        J = J[:, :, 10:13].reshape(-1, 3)
        N = np.linalg.inv(J.T @ J)
        return N @ (J.T @ moved.ravel()), 2 * CORNER_PX**2 * N


@pytest.mark.parametrize("number", mostly_slow([0, 1, 2, 6], 1))
def test_the_turn_of_the_scene_is_that_of_control_points(shared, number):
    """Twenty pairs of epochs; eight corners give the rotation ten times worse than the scene.

    The sd of the worst corner makes the ratio conservative.
    """
    room = Room(shared / "data" / f"aviary-cam{number}")
    rng = np.random.default_rng(number)
    ratio, known = [], []
    for k in range(20):
        pair = rng.choice(room.full, 2, replace=False)
        board, then, now = room.shared(*rng.choice(len(room.epochs), 2, replace=False))
        control = np.isin(board, pair)
        if control.sum() < 8:
            continue  # hidden by a person
        turn = rng.normal(0, 1e-3, 3)
        moved = room.turned(now, turn) - then
        scene = estimate_movement(room.camera, room.camera, then[~control], moved[~control], k)
        assert scene is not None
        values, covariance, *_ = scene
        x, C = room.control_turn(then[control], moved[control])
        spread = np.sqrt(np.diag(C) + np.diag(covariance)[:3])
        ratio.append((values[:3] - x) / spread)
        known.append((values[:3] - turn) / turn.std())
    assert len(ratio) >= 15
    assert 0.3 < np.sqrt(np.mean(np.square(ratio))) < 1.0
    assert np.abs(ratio).max() < 3.5
    # it is the applied rotation, except for the tremble
    assert np.sqrt(np.mean(np.square(known))) < 0.2


def course_of_boards(room: Room, more_c: float) -> SceneCourse:
    """Use every eighth epoch as a frame of a day; c grows by `more_c` mm outside the model."""
    rows = range(0, len(room.epochs), EVERY)
    T = 10 + 25 * np.sin(np.linspace(0, np.pi, len(rows)))
    values, covariance = np.full((len(rows), 4), np.nan), np.full((len(rows), 4, 4), np.nan)
    for k, row in list(enumerate(rows))[1:]:
        board, then, now = room.shared(0, row)
        scene = ~np.isin(board, room.full[:2])
        now = room.turned(now, more_c=more_c * (T[k] - T[0]) / 25)
        found = estimate_movement(room.camera, room.camera, then[scene], (now - then)[scene], k)
        assert found is not None
        values[k], covariance[k], locked, _ = found
    n = len(rows)
    return SceneCourse(
        "room", ("",) * n, 3600.0 * np.arange(n), T, values, covariance, np.zeros((n, 4)),
        np.zeros(n, dtype=np.int64), ("",) * n, locked, 1e-3,
    )  # fmt: skip


@pytest.mark.parametrize("number", mostly_slow([0, 1, 2, 6], 1))
def test_real_boards_contradict_only_a_wrong_model(shared, number):
    """Real c varies by 0.01 to 0.02 px at the edge, up to 1.7 sds, too little for an effect."""
    room = Room(shared / "data" / f"aviary-cam{number}")
    still = course_of_boards(room, 0.0)
    assert not still.model_misses, still.values[:, 3] / still.sd[:, 3]
    size = 20 * float(np.nanmedian(still.sd[:, 3]))
    found = course_of_boards(room, size)
    assert found.model_misses
    slope, sd = (v[3] for v in found.per_kelvin)
    assert slope == pytest.approx(size / 25, abs=4 * sd)
