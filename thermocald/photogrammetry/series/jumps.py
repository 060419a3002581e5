"""Jumps in the trajectory of a pose: the mount was knocked, or a lens slipped.

A jump that the perspective attributes to the interior orientation is left to the camera; every
other one counts as a movement of the mount.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd

if TYPE_CHECKING:
    from thermocald.arrays import Array

__all__ = ["Jumps", "Perspective", "jumps"]

_LARGE = 8.0  # robust standard deviations of the change between neighbours
_LASTING = 0.5  # of the change must remain
_SIDE = 8  # epochs before and after that tell where the pose stood
_MOST = 8
_SURE = 4.0  # standard deviations by which the perspective must exclude a movement
_UNSEEN = 3.0


@dataclass(frozen=True, eq=False)
class Perspective:
    """Normal equations M (E, k, k), g (E, k) of the pose with the interior orientation free."""

    M: Array
    g: Array


@dataclass(frozen=True, eq=False)
class Jumps:
    """rows: epochs from which on the pose stood elsewhere, by steps (n, k); variances (n, k)."""

    rows: tuple[int, ...]
    steps: Array
    variances: Array

    def removed(self, trajectory: Array) -> Array:
        """The trajectory (E, k) without the jumps."""
        trajectory = trajectory.copy()
        for row, step in zip(self.rows, self.steps, strict=True):
            trajectory[row:] -= step
        return trajectory

    def covariance(self, epochs: int) -> Array:
        """Covariance (k, k) of the pose about its mean over so many epochs."""
        stairs = np.zeros((epochs, self.steps.shape[1]))
        for row, step in zip(self.rows, self.steps, strict=True):
            stairs[row:] += step
        stairs -= stairs.mean(axis=0)
        out: Array = stairs.T @ stairs / max(epochs, 1)
        for row, variance in zip(self.rows, self.variances, strict=True):
            fraction = row / epochs
            out += np.diag(variance) * fraction * (1 - fraction)
        return out


def jumps(trajectory: Array, perspective: Perspective) -> Jumps:
    """The jumps of a trajectory (E, k), in units of its noise, that are the mount's."""
    rows: list[int] = []
    steps: list[Array] = []
    variances: list[Array] = []
    left = trajectory.copy()
    examined: set[int] = set()
    while len(examined) < _MOST and len(left) >= 4 * _SIDE:
        change = np.diff(left, axis=0)
        size = np.abs(change) / np.maximum(mad_sd(change, axis=0), 1e-12)
        for row in examined:
            size[row - 1] = 0.0
        worst = int(size.max(axis=1).argmax())
        row, column = worst + 1, int(size[worst].argmax())
        if size[worst, column] < _LARGE:
            break
        examined.add(row)
        step, factor = _step(left, row)
        if abs(step[column]) < _LASTING * abs(change[worst, column]):
            continue
        left[row:] -= step
        if not _is_the_cameras(row, step, perspective):
            rows.append(row)
            steps.append(step)
            variances.append(factor * mad_sd(change, axis=0) ** 2 / 2)
    shape = (len(rows), trajectory.shape[1])
    return Jumps(tuple(rows), np.array(steps).reshape(shape), np.array(variances).reshape(shape))


def _step(trajectory: Array, row: int) -> tuple[Array, float]:
    """The step (k,) at an epoch on a straight line, and its variance over the noise's."""
    first = max(row - _SIDE, 0)
    part = trajectory[first : row + _SIDE]
    t = np.arange(first, first + len(part)) - row
    estimator = np.linalg.pinv(np.column_stack([np.ones(len(t)), t, t >= 0]))[2]
    return estimator @ part, float(estimator @ estimator)


def _is_the_cameras(row: int, step: Array, perspective: Perspective) -> bool:
    """Whether the perspective excludes that the pose made a step."""

    def half(part: slice) -> tuple[float, float]:
        information = float(np.einsum("i,eij,j->", step, perspective.M[part], step))
        return float((perspective.g[part] @ step).sum()) / max(information, 1e-300), information

    (before, known_before), (after, known_after) = half(slice(None, row)), half(slice(row, None))
    if min(known_before, known_after) <= 0:
        return False
    sd = float(np.sqrt(1.0 / known_before + 1.0 / known_after))
    moved = after - before
    return abs(1.0 - moved) > _SURE * sd and abs(moved) < _UNSEEN * sd
