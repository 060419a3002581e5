"""Real corners as a scene: boards of unknown depth, and two boards' corners as control points.

Nothing is heated in these fifty seconds; the cameras tremble by some hundredths of a pixel. Known
rotations and changes of c are applied to the image points of single epochs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import Calibrator
from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.scene import SceneCourse, estimate_movement
from thermocald.photogrammetry.camera.camera_model import partials, project, rotation
from thermocald.store.recording.reader import read_recording

CORNER_PX = 0.09  # largest scatter of a static corner: ../shared/data/README.md
EVERY = 8  # epochs


@dataclass
class Room:
    """A fixed camera before boards, calibrated with the whole field in its first epoch."""

    folder: Path

    def __post_init__(self) -> None:
        recording = read_recording(self.folder)
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


def course(room: Room, more_c: float) -> SceneCourse:
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
    still = course(room, 0.0)
    assert not still.model_misses, still.values[:, 3] / still.sd[:, 3]
    size = 20 * float(np.nanmedian(still.sd[:, 3]))
    found = course(room, size)
    assert found.model_misses
    slope, sd = (v[3] for v in found.per_kelvin)
    assert slope == pytest.approx(size / 25, abs=4 * sd)
