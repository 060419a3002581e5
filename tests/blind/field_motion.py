"""Motions of the test field of a blind recording, which are no effects of the camera.

A board is one of the three sheets, 49 targets.
"""

from __future__ import annotations

import numpy as np

MOVED_MM = 0.3
BOARD = np.arange(49, 98)
TARGET = 20


def moved_field(
    rng: np.random.Generator, kind: str, points: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Return object points (E, n, 3) mm with a knocked or creeping board, or a wandering target."""
    out = points.copy()
    u = (frames - frames[0]) / (frames[-1] - frames[0])
    if kind == "wander":
        steps = np.cumsum(rng.normal(size=(len(frames), 3)), axis=0)
        steps -= steps.mean(axis=0)
        out[:, TARGET] += MOVED_MM * steps / np.sqrt(np.mean(steps**2))
        return out
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    X = points[0, BOARD] - points[0, BOARD].mean(axis=0)
    turn = rng.normal(size=3) * MOVED_MM / 4 / np.abs(X).max()
    step = MOVED_MM * way + np.cross(turn, X)
    course = u >= rng.uniform(0.3, 0.7) if kind == "knock" else u
    out[:, BOARD] += course[:, None, None] * step
    return out
