"""The mount as a random effect: how far a camera moves about its mean pose between epochs.

The exterior orientation of an epoch is that of the series plus a movement m ~ N(0, S). A movement
shifts and scales the image, which shows it to hundredths of a pixel, but so does a change of the
principal point or distance; only the perspective separates the two, with a hundredth of that
accuracy. S is therefore estimated from the *trajectory*: the pose of each epoch with the interior
orientation held (`variance_components`), direction by direction; directions that the field shows
well are separate from the others.

Limit: a change of the interior orientation as abrupt as a tremble is attributed to the mount, which
makes the standard deviations too large, not too small.

The mount's jumps (`jumps`) are steps of its mean pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, EOP_COLUMNS
from thermocald.photogrammetry.linalg import (
    mad_sd,
    stacked_inverses,
    symmetric_power,
    unit_diagonal,
)
from thermocald.photogrammetry.series.covariances import pose_equations
from thermocald.photogrammetry.series.jumps import (
    SIDE,
    estimate_steps,
    find_drift,
    find_jumps,
    least_deviation,
)
from thermocald.photogrammetry.series.target_noise import slow_course
from thermocald.photogrammetry.series.variance_components import components, mean_variance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index, Mask

_HIDDEN = 0.3  # of the noise's variance, below which a movement cannot be estimated per epoch
_AMISS = 0.5  # share of a brief movement that may be otherwise, which real cameras show
_FLAT = 1e-6  # of the noise's variance, for directions without movement


@dataclass(frozen=True, eq=False)
class Movement:
    """The variance components of a mount's movement about its mean pose over a series.

    white, slow (6, 6): covariances of the exterior orientation, rad and mm, for movements without
    and with memory; memory: epochs after which the slow movement has lost 63 % of its correlation;
    noise (6, 6): covariance of one epoch's pose with the interior orientation held; jumps: the
    first epoch after each jump of the mean pose; steps: the jumps and touches, each with the course
    (E,) of a unit step, about its mean if it lasts, the step (6,) and its covariance (6, 6); hidden
    (6, 6): covariance of a step in a gap that shows none; drift (6, 6): mean square of a drift that
    the perspectives of all epochs show together; touched: the epochs in which the mount was
    elsewhere.
    """

    white: Array
    slow: Array
    memory: float
    noise: Array
    jumps: tuple[int, ...] = ()
    steps: tuple[tuple[Array, Array, Array], ...] = ()
    hidden: Array = field(default_factory=lambda: np.zeros((6, 6)))
    drift: Array = field(default_factory=lambda: np.zeros((6, 6)))
    touched: tuple[int, ...] = ()

    @property
    def shifts(self) -> Array:
        """Shifts (E, 6) of the mean pose by the jumps, (1, 6) without any."""
        each = (np.outer(course, step) for course, step, _ in self.steps)
        return sum(each, np.zeros((1, 6)))

    @property
    def of_jumps(self) -> Array:
        """Covariance (6, 6) of an epoch's pose about the mean by the jumps."""
        shifts = self.shifts
        of_shifts: Array = shifts.T @ shifts / len(shifts)
        return sum((np.mean(course**2) * V for course, _, V in self.steps), of_shifts)

    @property
    def swaying(self) -> Array:
        """Covariance (6, 6) of an epoch's movement about the shifted mean pose."""
        return self.white + self.slow

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of an epoch's movement about the mean pose, with the jumps."""
        return self.swaying + self.of_jumps

    @property
    def over_noise(self) -> float:
        """The largest variance of an epoch's movement in any direction, over that of its noise."""
        whiten = self._whitening()
        return float(np.linalg.eigvalsh(whiten @ self.swaying @ whiten.T)[-1])

    @property
    def still(self) -> bool:
        """Whether the movement is hidden by the noise of one epoch in every direction."""
        return not self.steps and self.over_noise < _HIDDEN

    def _whitening(self) -> Array:
        """Return T (6, 6) with T · noise · Tᵀ = 1."""
        scaled, scale = unit_diagonal(self.noise)
        return symmetric_power(scaled, -0.5, 1e-12) * scale

    def precision(self) -> Array:
        """Return the inverse covariance (6, 6) of the movements about the shifted mean pose.

        Their sd is at least 1e-3 of the noise's.
        """
        T = self._whitening()
        inside = T @ self.swaying @ T.T
        return T.T @ symmetric_power(inside, -1.0, _FLAT) @ T

    def tilt(self, weights: Array) -> Array:
        """Return the covariance (6, 6) of Σ w m over the epochs, with weights (E,)."""
        white: Array = self.white * float(weights @ weights)
        if not self.slow.any():
            return white
        # w'Rw for R = φ^|i-j|, by the autocorrelation of w
        n, phi = len(weights), float(np.exp(-1.0 / self.memory))
        products = np.fft.irfft(np.abs(np.fft.rfft(weights, 2 * n)) ** 2, 2 * n)[:n]
        total = 2.0 * float(phi ** np.arange(n) @ products) - float(products[0])
        about_mean = 1.0 - mean_variance(phi, int(np.count_nonzero(weights)))
        return white + self.slow * (total / max(about_mean, 1e-6))


STILL = Movement(np.zeros((6, 6)), np.zeros((6, 6)), 0.0, np.eye(6))
"""A mount that does not move."""


def image_px(covariance: Array, A: Array) -> float:
    """Return the effect of a movement's covariance (6, 6) on the image, px, by partials (T, 2, 16).

    RMS over targets, per coordinate.
    """
    E = A[..., EOP]
    return float(np.sqrt(max(np.einsum("tki,ij,tkj->tk", E, covariance, E).mean(), 0.0)))


FEWEST_EPOCHS = 20
"""Epochs needed to separate a tremble from the noise."""

FASTEST_DRIFT_S = 240.0
"""Period below which a camera hardly follows its temperature."""

_MEDIAN_CHI2_6 = 5.348
_WINDOW = 15  # epochs of the local cubic that smooths the interior orientation
_CUBIC = 0.6  # window of the local cubic that follows the drift, over the drift's shortest period
_SPIKE = 6.0  # robust standard deviations beyond which a deviation is a passer-by, not the mount
_WEAK = 3.0  # times the usual variance of a parameter, beyond which an epoch is interpolated
_FEWEST_A_PERIOD = 12.0  # epochs
_LEAST_WARMING_K = 0.5
_LEAST_NOISE = 0.2  # variance with correlated errors, whose estimate may even be negative
_FOLLOWED = 1e-9  # share of a movement that the free parameters follow, beyond rounding
_PERIODS = 2.5  # periods that a series must have to show a drift


def drift_period(time_s: Array, temperature: Array) -> float:
    """Return the shortest period of a camera's drift in epochs; 0 if the series is too short.

    time_s (E,): of the epochs; temperature (E,) °C, NaN if unknown: a camera that warms up drifts
    even in a short series.
    """
    if len(time_s) < 2:
        return 0.0
    interval = float(np.median(np.diff(time_s)))
    known = temperature[np.isfinite(temperature)]
    warms = len(known) > 1 and float(np.ptp(known)) >= _LEAST_WARMING_K
    if interval <= 0 or (float(np.ptp(time_s)) < FASTEST_DRIFT_S and not warms):
        return 0.0
    return max(FASTEST_DRIFT_S / interval, _FEWEST_A_PERIOD)


def drift_gaps(time_s: Array) -> tuple[int, ...]:
    """Return the first epoch after each gap in times (E,) s in which a camera may drift."""
    steps = np.diff(time_s)
    return tuple((np.flatnonzero(steps > 0.5 * FASTEST_DRIFT_S) + 1).tolist())


def estimate_movement(
    N: Array,
    b: Array,
    own: Index,
    good: Mask,
    scale: Array,
    period: float = 24.0,
    correlated: Array | None = None,
    gaps: Sequence[int] = (),
) -> Movement:
    """Estimate the variance components of the mount from the normal equations of a series.

    N (E, 16, 16), b (E, 16): of every epoch at one linearisation, in units of the noise; own (p,):
    the free interior parameters; good (E,): epochs to use; scale (E,): noise of an epoch
    over the typical one; period: from `drift_period`; correlated (6, 6): part of the pose's normal
    matrix from correlated errors, ΣAᵀPCPA; gaps: from `drift_gaps`. In a gap the mount has moved if
    the perspective shows it.
    """
    rows = np.flatnonzero(good)
    if len(rows) < FEWEST_EPOCHS:
        return STILL
    N, b, scale = N[rows], b[rows], scale[rows]
    trajectory, root, weak = _trajectories(N, b, own)
    if trajectory is None:
        return STILL
    noise = np.eye(6)
    if correlated is not None:
        inverse = np.linalg.inv(root)
        noise += inverse.T @ correlated @ inverse
    whiten = symmetric_power(noise, -0.5, _LEAST_NOISE)
    trajectory = _fill(trajectory @ whiten, weak)
    back = np.linalg.inv(root) @ np.linalg.inv(whiten)
    # the pose by the perspective alone, the interior orientation eliminated
    M, g = pose_equations(N, b, own, stacked_inverses(N[:, own[:, None], own])[0])
    M, g = back.T @ M @ back, g @ back
    M, g = M / scale[:, None, None] ** 2, g / scale[:, None] ** 2
    unit = _unit_variance(M, g)
    M, g = M / unit, g / unit
    alike, axes = np.linalg.eigh(_hidden(N, own, root))
    axes = np.linalg.qr(np.linalg.solve(whiten, axes))[0]  # none contains those after it
    drifting = alike > _FOLLOWED
    period = min(period, len(trajectory) / _PERIODS) if drifting.any() else 0.0
    missing = np.flatnonzero(np.diff(rows) > (0.5 * period or np.inf)) + 1
    pauses = sorted({*missing.tolist(), *np.searchsorted(rows, gaps).tolist()})
    pauses = _apart(pauses, len(rows), SIDE)
    cuts = _apart(pauses, len(rows), FEWEST_EPOCHS)
    trajectory, jumps, hidden, touches = find_jumps(trajectory, M, g, scale, rows, pauses)
    steps = estimate_steps(M, g, jumps)
    drift = find_drift(M, g)
    # what the free parameters do not follow is the mount's, however slow
    found = [
        _separate(trajectory, axes[:, part], alike[part], *how)
        for part, how in (
            (~drifting, ([], 0.0, True)),
            (drifting, (cuts if period else [], period, False)),
        )
        if part.any()
    ]
    directions, white, slow = (np.concatenate([f[k] for f in found], axis=-1) for k in range(3))
    steady = np.count_nonzero(~drifting)
    if 0 < steady < 6:  # a mount that drifts where this shows does so in all directions
        usual = ((directions.T @ whiten @ root / np.sqrt(np.diag(root.T @ root))) ** 2).sum(axis=1)
        share = (slow[:steady] / usual[:steady]).max()
        slow[steady:] = np.maximum(slow[steady:], share * usual[steady:])
    # the directions are uncertain themselves, so that movements leak into all others
    white = np.maximum(white, np.count_nonzero(white + slow) / len(trajectory) - slow)
    axes, first = back @ directions, tuple(int(rows[row]) for row in jumps)
    moved = [
        (slow_course(len(good), row), back @ step, back @ V @ back.T)
        for row, (step, V) in zip(first, steps, strict=True)
    ]
    for row, (away, variance) in touches.items():  # all of it the mount's, as of what trembles
        there = (np.arange(len(good)) == rows[row]).astype(float)
        variance = variance * scale[row] ** 2 + (_AMISS * np.linalg.norm(away)) ** 2
        moved.append((there, back @ away, variance * (back @ back.T)))
    return Movement(
        (axes * white) @ axes.T, (axes * slow) @ axes.T, max(f[3] for f in found), back @ back.T,
        first, tuple(moved), back @ hidden @ back.T,
        back @ drift @ back.T, tuple(rows[sorted(touches)].tolist()),
    )  # fmt: skip


def _apart(rows: Sequence[int], end: int, least: int) -> list[int]:
    """Return the rows before which, and up to `end`, there are at least so many epochs."""
    kept: list[int] = []
    for row in rows:
        if min(row - max(kept, default=0), end - row) >= least:
            kept.append(row)
    return kept


def _unit_variance(M: Array, g: Array) -> float:
    """Return the variance of unit weight, at least 1, of the poses by the perspective.

    M (E, k, k), g (E, k): as in `find_jumps`; from the changes between neighbours.
    """
    Q, found = stacked_inverses(M)
    change = np.diff(np.einsum("eij,ej->ei", Q, g), axis=0)[..., None]
    chi2 = (change * np.linalg.solve(Q[1:] + Q[:-1], change)).sum(axis=(1, 2))[
        found[1:] & found[:-1]
    ]
    return max(float(np.median(chi2)) / _MEDIAN_CHI2_6, 1.0) if len(chi2) else 1.0


def _trajectories(N: Array, b: Array, own: Index) -> tuple[Array | None, Array, Mask]:
    """Return poses (E, 6) with the interior orientation held, in units of their noise; the root of
    their usual normal matrix; and a mask (E,) of weak epochs. The poses are None if that is
    singular.

    The interior orientation is held at its smooth trajectory, whose effect is added again by the
    usual matrices, so that targets that come and go do not turn a drift into a movement.
    """
    usual = N[:, EOP, EOP].mean(axis=0)
    interior = np.zeros((len(N), len(own)))
    if len(own):
        Q, found = stacked_inverses(N[:, own[:, None], own])
        interior = np.einsum("epq,eq->ep", Q, b[:, own])
        spread = np.where(found[:, None], np.diagonal(Q, axis1=1, axis2=2), np.inf)
        shown = found & (spread <= _WEAK * np.median(spread, axis=0)).all(axis=1)
        interior = _smooth(_fill(interior, ~shown))
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


def _hidden(N: Array, own: Index, root: Array) -> Array:
    """Return the share (6, 6), 0 to 1, of a movement that looks like a change of the interior
    orientation, in units of `root`; an epoch's perspective shows the rest.
    """
    usual = N.mean(axis=0)
    Q, _ = stacked_inverses(usual[None, own[:, None], own])
    looks = np.linalg.solve(root.T, usual[EOP_COLUMNS[:, None], own])
    return np.asarray(looks @ Q[0] @ looks.T)


def _separate(
    trajectory: Array, axes: Array, alike: Array, cuts: list[int], period: float, held: bool
) -> tuple[Array, Array, Array, float]:
    """Estimate the variance components of a trajectory (E, 6) along some orthonormal axes (6, d).

    alike (d,): share of a movement along each that looks like the camera's; cuts: the first epoch
    after each gap; period, held: as in `components`. Returns orthonormal directions (6, d), the
    white and the slow variances (d,), and the memory.

    Directions that an epoch's perspective shows are separate from the others, as by a chance
    correlation the former would predict the latter.
    """
    trajectory = trajectory - trajectory.mean(axis=0)
    smooth = np.zeros_like(trajectory)
    if period:
        parts = np.split(trajectory, cuts)
        smooth = np.concatenate([_smooth(part, int(_CUBIC * period)) for part in parts])
    rough = trajectory - smooth
    limit = _SPIKE * mad_sd(rough - np.median(rough, axis=0), axis=0)
    beyond = np.maximum(np.abs(rough) - limit, 0.0)
    if period:
        beyond[least_deviation(trajectory) < limit] = 0.0
    rough -= np.copysign(beyond, rough)
    groups = []
    for part in (axes[:, alike > 0.5], axes[:, alike <= 0.5]):
        inside = rough @ part
        groups.append(part @ np.linalg.eigh(inside.T @ inside)[1])
    directions = np.concatenate(groups, axis=1)
    parts = np.split((smooth + rough) @ directions, cuts)
    found = [components(p, min(period, len(p) / _PERIODS), held) for p in parts]
    size = [len(p) for p in parts]
    white, slow = (np.average([f[k] for f in found], axis=0, weights=size) for k in (0, 1))
    return directions, white, slow, max(f[2] for f in found)


def _fill(trajectory: Array, missing: Mask) -> Array:
    """Interpolate missing epochs of a trajectory between their neighbours."""
    if not missing.any() or missing.all():
        return trajectory
    t = np.arange(len(trajectory))
    kept = ~missing
    return np.column_stack([np.interp(t, t[kept], column[kept]) for column in trajectory.T])


def _smooth(trajectory: Array, window: int = _WINDOW) -> Array:
    """Smooth a trajectory (E, k) by local cubics over a window of epochs, also at its ends."""
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
