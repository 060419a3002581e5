"""Tracking measures windows only, renews weights, and searches again if targets are lost."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.photogrammetry import board_images
from tests.photogrammetry.exact_rendering import noisy, rms
from tests.photogrammetry.fields import (
    SMALL_CAMERA,
    SMALL_SENSOR,
    draw,
    small_field,
    small_frame,
    station,
)
from tests.photogrammetry.network_cases import looking_at
from tests.photogrammetry.printed_sheets import photograph
from thermocald.photogrammetry.camera.camera_model import CameraModel, CameraSpec, Sensor
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.frame import tracking
from thermocald.photogrammetry.frame.measurement import Measurement, measure
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.targets.boards import charuco

FIELD, NORMALS = small_field()
STATION = station(800.0)
CLEAN = small_frame()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(21)


@pytest.fixture(scope="module")
def begun() -> Tracker:
    tracker = Tracker(FIELD, CameraSpec("", SMALL_SENSOR))
    first = tracker.measure(noisy(CLEAN, np.random.default_rng(20)))
    assert first.status.ok
    assert first.searched
    return tracker


@pytest.fixture
def tracker(begun) -> Tracker:
    """Return a tracker that has measured the first frame; it replaces its state, never fills it."""
    return copy(begun)


def _z(measured, camera=SMALL_CAMERA, exterior=STATION) -> np.ndarray:
    o = measured.observations
    return (o.points - camera.project(exterior, FIELD.points)[o.targets]) / o.sigmas


def count_searches(monkeypatch) -> list:
    """Return the searches of whole frames from now on, which find nothing."""
    done: list = []
    nothing = Measurement(Observations.none())
    monkeypatch.setattr(tracking, "measure", lambda *frame: done.append(frame) or nothing)
    return done


@pytest.fixture
def searches(monkeypatch) -> list:
    return count_searches(monkeypatch)


def test_windows_are_enough_and_sigmas_stay_true(tracker, rng, searches):
    z = []
    for _ in range(10):
        measured = tracker.measure(noisy(CLEAN, rng))
        assert measured.status.ok
        assert len(measured.observations) >= 100
        z.append(_z(measured))
    assert searches == []
    assert 0.93 <= rms(np.array(z)) <= 1.07
    # Fixed weights add no error that epochs have in common
    assert rms(np.mean(z, axis=0)) < 1.35 / np.sqrt(10)


@pytest.mark.slow
@pytest.mark.parametrize("px", [0.12, 1.2])
def test_drift_is_followed_without_bias(tracker, rng, searches, px):
    """The principal point drifts by `px` in x and half as much in y."""
    i, shift = SMALL_CAMERA.interior, px * SMALL_SENSOR.pixel_pitch
    camera = CameraModel(SMALL_SENSOR, replace(i, x0=i.x0 + shift, y0=i.y0 - shift / 2))
    image = draw(FIELD, NORMALS).render(camera, STATION)
    z = np.array([_z(tracker.measure(noisy(image, rng)), camera) for _ in range(6)])
    assert searches == []
    assert rms(z) <= 1.12
    # 200 targets × 6 frames would show a common bias of 0.001 px (sigma 0.008 px)
    assert np.abs(z.mean(axis=(0, 1))).max() < 4 / np.sqrt(z.shape[0] * z.shape[1])


def test_light_noise_and_focus_may_change(tracker, rng, searches):
    for factor in (0.9, 0.5, 1.1):
        measured = tracker.measure(noisy(CLEAN * factor, rng))
        assert len(measured.observations) >= 100
        assert 0.88 <= rms(_z(measured)) <= 1.12
        contrast = np.median(measured.observations.quality["contrast"])
        assert contrast == pytest.approx(-150 * factor, rel=0.02)
    measured = tracker.measure(noisy(CLEAN, rng, 4.0))
    assert 0.88 <= rms(_z(measured)) <= 1.12
    assert np.median(measured.observations.quality["noise"]) == pytest.approx(4.0, rel=0.1)
    defocused = cv2.GaussianBlur(CLEAN, (0, 0), np.sqrt(1.2**2 - 0.8**2))
    measured = tracker.measure(noisy(defocused, rng))
    assert np.median(measured.observations.quality["blur"]) == pytest.approx(1.2, abs=0.02)
    assert searches == []


def test_a_target_may_be_hidden_and_come_back(tracker, rng, searches):
    before = len(tracker.measure(noisy(CLEAN, rng)).observations)
    covered = CLEAN.copy()
    covered[500:700, 700:900] = 120
    for _ in range(2):
        measured = tracker.measure(noisy(covered, rng))
        assert measured.missed
        assert len(measured.observations) + len(measured.missed) >= before
        assert np.abs(_z(measured)).max() < 6
    back = tracker.measure(noisy(CLEAN, rng))
    assert len(back.observations) == before
    assert np.abs(_z(back)).max() < 5
    assert searches == []


BOARD_CAMERA = CameraModel(Sensor(820, 616, 0.00448), SMALL_CAMERA.interior)


@pytest.fixture(scope="module")
def board():
    """Return a board and photographs of it: two from one stand, one where a pattern repeats."""
    pattern = (7, 5, 45.0, 33.75, "DICT_5X5_250")
    field, sheet = charuco(*pattern), board_images.charuco_sheet(*pattern, legacy=False)
    frames, away = [], np.array([150.0, -120.0, 380.0])
    for step in (0.0, 90.0):
        middle = field.points.mean(axis=0) + np.array([step, 0, 0])
        stand = looking_at(middle + away, middle, 0.3)
        frames.append(photograph([sheet], BOARD_CAMERA, stand, noise=0.0, finer=2))
    rng = np.random.default_rng(1)
    return field, [noisy(frames[k], rng, 1.5) for k in (0, 0, 1)]


@pytest.fixture
def boards_tracker(board) -> Tracker:
    """Return a tracker that has measured the first frame."""
    tracker = Tracker(board[0], CameraSpec("", BOARD_CAMERA.sensor))
    tracker.measure(board[1][0])
    return tracker


def test_all_corners_of_a_board_are_tracked(board, boards_tracker, searches):
    """The squares of a ChArUco board were measured in the first frame only."""
    field, frames = board
    first = measure(frames[0], field).observations
    second = boards_tracker.measure(frames[1]).observations
    assert np.array_equal(second.targets, first.targets)
    assert 0 < rms(second.points - first.points) < 0.03


def test_a_board_that_moves_by_whole_squares_keeps_its_numbers(board, boards_tracker):
    field, frames = board
    moved = boards_tracker.measure(frames[2]).observations
    whole = measure(frames[2], field).observations
    assert np.array_equal(moved.targets, whole.targets)
    assert rms(moved.points - whole.points) < 0.01


def test_what_was_hidden_in_the_first_frames_is_found(board, monkeypatch):
    """Searches end once everything is seen, or become rare."""
    field, frames = board
    tracker = Tracker(field, CameraSpec("", BOARD_CAMERA.sensor))
    hand = frames[0].copy()
    hand[:, :450] = 110
    begin = [tracker.measure(hand) for _ in range(3)]
    seen = [tracker.measure(frames[k % 2]) for k in range(2)]
    whole = len(measure(frames[1], field).observations)
    assert len(begin[2].observations) < 0.6 * whole
    assert len(seen[1].observations) == whole
    searches = count_searches(monkeypatch)
    assert [len(tracker.measure(frames[k % 2]).observations) for k in range(12)] == [whole] * 12
    assert len(searches) <= 5


def test_a_knock_leads_to_a_reported_search(tracker, rng):
    knocked = station(760.0, target=(215.0, 190.0, 200.0), roll=0.03)
    image = draw(FIELD, NORMALS).render(SMALL_CAMERA, knocked, finer=2)
    measured = tracker.measure(noisy(image, rng))
    assert "lost" in measured.searched
    assert measured.status.ok
    assert np.abs(_z(measured, exterior=knocked)).max() < 5
    assert not tracker.measure(noisy(image, rng)).searched


def test_tracking_goes_on_after_dark_frames(tracker, rng):
    for _ in range(2):
        dark = tracker.measure(noisy(np.full_like(CLEAN, 4.0), rng))
        assert dark.status.word == "black"
        assert "lost" in dark.searched
        assert len(dark.observations) == 0
    light = tracker.measure(noisy(CLEAN, rng))
    assert light.status.ok
    assert not light.searched  # the targets' places are still stored


def test_a_frame_of_another_type_and_a_reset_lead_to_a_search(tracker, rng):
    frame = noisy(CLEAN, rng)
    assert tracker.measure(frame[:-10]).status.word == "wrong_size"
    sixteen = tracker.measure(frame.astype(np.uint16) * 256)
    assert "uint16" in sixteen.searched
    assert sixteen.status.ok
    tracker.reset()
    assert "nothing is tracked" in tracker.measure(frame).searched
