"""The mount as a random effect: how far a camera moves about its mean pose between epochs.

The exterior orientation of an epoch is that of the series plus a movement m ~ N(0, S). Image shift
and scale show a movement to hundredths of a pixel, but so does a change of the principal point or
distance; only the perspective separates the two, a hundred times worse. S is therefore estimated
from the *trajectory* of the pose that each epoch would have with the interior orientation held: a
camera that warms up follows an integrated random walk there, a mount trembles (white) or sways and
settles (with memory, first-order autoregressive). The variance components maximise the likelihood
in the cosine domain, direction by direction of the movement that the field shows best.

Does not hold: a change of the interior orientation as abrupt as a tremble is taken for the mount's,
which makes the standard deviations larger than they need be, not smaller.

In the trajectory there may be jumps: the mount was knocked, or a lens slipped. A jump that the
perspective attributes to the interior orientation is left to the camera; every other one counts as
a movement of the mount.

Source: variance components as Patterson and Thompson (1971), Biometrika 58, 545-554.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, EOP_COLUMNS
from thermocald.photogrammetry.linalg import mad_sd, stacked_inverses, symmetric_power
from thermocald.photogrammetry.series.movement import STILL, Movement, components

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask


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


FEWEST_EPOCHS = 20
"""Below, the epochs do not tell a tremble from their own noise."""

FASTEST_DRIFT_S = 240.0
"""Period below which a camera hardly follows its temperature."""

_WINDOW = 15  # epochs of the local cubic that smooths the interior orientation
_CUBIC = 0.6  # of the drift's shortest period: the window of the local cubic that follows it
_SPIKE = 6.0  # robust standard deviations: a passer-by, not the mount
_WEAK = 3.0  # times the usual variance of the pose: an epoch that says little of the movement
_FEWEST_A_PERIOD = 12.0  # epochs
_LEAST_WARMING_K = 0.5
_PERIODS = 2.5  # a series must be so many periods long to show a drift


def drift_period(time_s: Array, temperature: Array) -> float:
    """The shortest period of a camera's drift in epochs; 0 where the series is too short for one.

    time_s (E,): of the epochs; temperature (E,) °C, NaN where unknown: a camera that warms up
    drifts in a short series too.
    """
    if len(time_s) < 2:
        return 0.0
    interval = float(np.median(np.diff(time_s)))
    known = temperature[np.isfinite(temperature)]
    warms = len(known) > 1 and float(np.ptp(known)) >= _LEAST_WARMING_K
    if interval <= 0 or (float(np.ptp(time_s)) < FASTEST_DRIFT_S and not warms):
        return 0.0
    return fastest_period(interval)


def fastest_period(interval_s: float) -> float:
    """The shortest period of a camera's drift in epochs, which are so far apart."""
    return max(FASTEST_DRIFT_S / interval_s, _FEWEST_A_PERIOD)


def estimate_movement(
    N: Array,
    b: Array,
    own: Index,
    good: Mask,
    period: float = 24.0,
    correlated: Array | None = None,
) -> Movement:
    """Variance components of the mount from the normal equations of a series.

    N (E, 16, 16), b (E, 16): of every epoch at one linearisation, in units of the noise; own (p,):
    the free interior parameters; good (E,): epochs to use; period: of `drift_period`; correlated
    (6, 6): what correlated
    errors add to the normal matrix of the pose, ΣAᵀPCPA.
    """
    rows = np.flatnonzero(good)
    if len(rows) < FEWEST_EPOCHS:
        return STILL
    N, b = N[rows], b[rows]
    trajectory, root, weak = _trajectories(N, b, own)
    if trajectory is None:
        return STILL
    noise = np.eye(6)
    if correlated is not None:
        inverse = np.linalg.inv(root)
        noise += inverse.T @ correlated @ inverse
    whiten = symmetric_power(noise, -0.5, 1e-3)
    trajectory = _filled(trajectory @ whiten, weak)
    found = jumps(trajectory, _perspective(N, b, own, root, whiten))
    trajectory = found.removed(trajectory)
    period = min(period, len(trajectory) / _PERIODS)
    if period:
        smooth = _smoothed(trajectory, int(_CUBIC * period))
    else:
        trajectory = trajectory - trajectory.mean(axis=0)
        smooth = np.zeros_like(trajectory)
    rough = trajectory - smooth
    limit = _SPIKE * mad_sd(rough - np.median(rough, axis=0), axis=0)
    rough = np.clip(rough, -limit, limit)
    directions = _directions(rough, whiten @ _visible(N, own, root) @ whiten)
    parts = components((smooth + rough) @ directions, period)
    back = np.linalg.inv(root) @ np.linalg.inv(whiten)
    axes = back @ directions
    slow = (axes * parts.slow) @ axes.T + back @ found.covariance(len(trajectory)) @ back.T
    memory = max(parts.memory, len(trajectory) / 2.0) if found.rows else parts.memory
    return Movement(
        (axes * parts.white) @ axes.T, slow, memory, back @ back.T,
        tuple(int(rows[k]) for k in found.rows),
    )  # fmt: skip


def _perspective(N: Array, b: Array, own: Index, root: Array, whiten: Array) -> Perspective:
    """What the perspective alone says of the pose, the interior orientation eliminated."""
    M, g = N[:, EOP, EOP], b[:, EOP]
    if len(own):
        Q, _ = stacked_inverses(N[:, own[:, None], own])
        QC = Q @ N[:, own[:, None], EOP_COLUMNS]
        M = M - np.swapaxes(N[:, own[:, None], EOP_COLUMNS], 1, 2) @ QC
        g = g - np.einsum("epi,ep->ei", QC, b[:, own])
    back = np.linalg.inv(root) @ np.linalg.inv(whiten)
    return Perspective(np.swapaxes(back, 0, 1) @ M @ back, g @ back)


def _trajectories(N: Array, b: Array, own: Index) -> tuple[Array | None, Array, Mask]:
    """Poses (E, 6) with the interior orientation held, in units of their noise; the root of their
    usual normal matrix; and which epochs (E,) say little.

    Held is the smooth trajectory of the interior orientation, put back by the usual matrices:
    targets that come and go then do not turn a drift into a movement.
    """
    usual = N[:, EOP, EOP].mean(axis=0)
    interior = np.zeros((len(N), len(own)))
    if len(own):
        Q, found = stacked_inverses(N[:, own[:, None], own])
        interior = np.einsum("epq,eq->ep", Q, b[:, own])
        interior[~found] = np.nan
        interior = _filled(interior, ~found)
        interior = _smoothed(interior)
    Q, found = stacked_inverses(N[:, EOP, EOP])
    coupling = N[:, EOP_COLUMNS[:, None], own]
    pose = np.einsum("eij,ej->ei", Q, b[:, EOP] - np.einsum("eip,ep->ei", coupling, interior))
    try:
        root = np.linalg.cholesky(usual).T
    except np.linalg.LinAlgError:
        return None, usual, ~found
    if len(own):
        pose += (interior - interior.mean(axis=0)) @ np.linalg.solve(usual, coupling.mean(axis=0)).T
    size = np.einsum("ij,ejk,ik->e", root, Q, root)
    weak = ~found | (size > _WEAK * np.median(size[found], axis=0)) if found.any() else ~found
    return pose @ root.T, root, weak


def _visible(N: Array, own: Index, root: Array) -> Array:
    """How much of a movement (6, 6) an epoch sees by its perspective, 0 to 1, in units of `root`.

    The rest looks like a change of the interior orientation.
    """
    usual = N.mean(axis=0)
    seen = usual[EOP, EOP].copy()
    if len(own):
        coupling = usual[own[:, None], EOP_COLUMNS]
        Q, _ = stacked_inverses(usual[own[:, None], own][None])
        seen -= coupling.T @ Q[0] @ coupling
    inverse = np.linalg.inv(root)
    visible: Array = inverse.T @ seen @ inverse
    return visible


def _directions(rough: Array, visible: Array) -> Array:
    """Orthonormal directions (6, 6) of the movements, from their rough part (E, 6).

    Those that an epoch sees and those that it does not are kept apart: a chance correlation of the
    two would let the one predict the other.
    """
    share, axes = np.linalg.eigh(visible)
    found = []
    for part in (axes[:, share < 0.5], axes[:, share >= 0.5]):
        if part.shape[1]:
            inside = rough @ part
            found.append(part @ np.linalg.eigh(inside.T @ inside)[1])
    return np.concatenate(found, axis=1)


def _filled(trajectory: Array, missing: Mask) -> Array:
    """The trajectory with missing epochs interpolated between their neighbours."""
    if not missing.any() or missing.all():
        return trajectory
    t = np.arange(len(trajectory))
    kept = ~missing
    return np.column_stack([np.interp(t, t[kept], column[kept]) for column in trajectory.T])


def _smoothed(trajectory: Array, window: int = _WINDOW) -> Array:
    """Local cubics over a window of epochs through a trajectory (E, k), also at its ends."""
    window = min(max(window, 7), len(trajectory) // 2 - 1) | 1
    half = window // 2
    x = np.arange(-half, half + 1) / half
    V = np.vander(x, 4)
    hat = V @ np.linalg.pinv(V)
    windows = np.lib.stride_tricks.sliding_window_view(trajectory, window, axis=0)
    return np.concatenate(
        [
            hat[:half] @ trajectory[:window],
            windows @ hat[half],
            hat[half + 1 :] @ trajectory[-window:],
        ]
    )
