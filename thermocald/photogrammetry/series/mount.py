"""The mount as a random effect: how far a camera moves about its mean pose between epochs.

The exterior orientation of an epoch is that of the series plus a movement m ~ N(0, S). Image shift
and scale show a movement to hundredths of a pixel, but so does a change of the principal point or
distance; only the perspective separates the two, a hundred times worse. S is therefore estimated
from the *course* of the pose that each epoch would have with the interior orientation held: a
camera that warms up follows an integrated random walk there, a mount trembles (white) or sways and
settles (with memory, first-order autoregressive). The variance components maximise the likelihood
in the cosine domain, direction by direction of the movement that the field shows best.

Does not hold: a change of the interior orientation as abrupt as a tremble is taken for the mount's,
which makes the standard deviations larger than they need be, not smaller.

Source: variance components as Patterson and Thompson (1971); the likelihood as Whittle (1953); its
maximisation by multiplicative updates as Févotte and Idier (2011), Neural Computation 23.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd, stacked_inverses, symmetric_power
from thermocald.photogrammetry.parameters import EOP, EOP_COLUMNS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]
    Columns = NDArray[np.int64]

__all__ = ["FEWEST_EPOCHS", "STILL", "Movement", "drift_period", "estimate_movement"]

FEWEST_EPOCHS = 20
"""Below, the epochs do not tell a tremble from their own noise."""

_WINDOW = 15  # epochs of the local cubic that smooths the interior orientation
_CUBIC = 0.6  # of the drift's shortest period: the window of the local cubic that follows it
_SPIKE = 6.0  # robust standard deviations: a passer-by, not the mount
_WEAK = 3.0  # times the usual variance of the pose: an epoch that says little of the movement
_PHI = np.array([0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98])
_LONG_PHI = np.append(_PHI, [0.99, 0.995, 0.998])  # where no drift can be mistaken for it
_UPDATES = 150
_WHITE_COST = 4.5  # log-likelihood that a component must gain to be believed
_SLOW_COST = 4.0
_NEGLIGIBLE = 0.02  # of the noise's variance
_FASTEST_DRIFT_S = 240.0  # period beyond which a camera hardly follows its temperature
_FEWEST_A_PERIOD = 12.0  # epochs
_LEAST_WARMING_K = 0.5
_PERIODS = 2.5  # a series must be so many periods long to show a drift
_MOST_FREQUENCIES = 2000
_FLAT = 1e-6  # of the noise: directions without movement


@dataclass(frozen=True, eq=False)
class Movement:
    """How far a mount moves about its mean pose over a series.

    white, slow (6, 6): covariance of the exterior orientation, rad and mm, of a movement without
    and with memory, about the mean over the series; memory: epochs after which the latter has lost
    63 % of its correlation; noise (6, 6): covariance of the pose of one epoch with its interior
    orientation held.
    """

    white: Array
    slow: Array
    memory: float
    noise: Array

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of an epoch's movement."""
        return self.white + self.slow

    @property
    def still(self) -> bool:
        """Whether no movement was found."""
        return not (self.white.any() or self.slow.any())

    def precision(self) -> Array:
        """Inverse covariance (6, 6); directions without movement are held to 1e-3 of the noise."""
        root = symmetric_power(_scaled(self.noise), -0.5, 1e-12)
        scale = 1.0 / np.sqrt(np.diag(self.noise))
        T = root * scale
        inside = T @ self.covariance @ T.T
        return T.T @ symmetric_power(inside, -1.0, _FLAT) @ T

    def image_px(self, A: Array) -> float:
        """Movement of the image, px, by partials (T, 2, 16): RMS over targets, per coordinate."""
        return _rms_px(A, self.covariance)

    def noise_px(self, A: Array) -> float:
        """The same of what an epoch's noise is mistaken for."""
        return _rms_px(A, self.noise)

    def slow_fraction(self, A: Array) -> float:
        """Fraction of the movement's variance in the image that has a memory."""
        return (_rms_px(A, self.slow) / max(self.image_px(A), 1e-12)) ** 2

    def tilt(self, weights: Array) -> Array:
        """Covariance (6, 6) of Σ w m over the epochs, weights (E,): of a line, say."""
        white: Array = self.white * float(weights @ weights)
        if not self.slow.any():
            return white
        # w'Rw for R = φ^|i-j| in one pass
        phi, carried, total = float(np.exp(-1.0 / self.memory)), 0.0, 0.0
        for w in weights.tolist():
            total += w * (w + 2.0 * carried)
            carried = phi * (carried + w)
        about_mean = 1.0 - _mean_variance(phi, int(np.count_nonzero(weights)))
        return white + self.slow * (total / max(about_mean, 1e-6))


STILL = Movement(np.zeros((6, 6)), np.zeros((6, 6)), 0.0, np.eye(6))
"""A mount that does not move."""


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
    if interval <= 0 or (float(np.ptp(time_s)) < _FASTEST_DRIFT_S and not warms):
        return 0.0
    return max(_FASTEST_DRIFT_S / interval, _FEWEST_A_PERIOD)


def estimate_movement(
    N: Array,
    b: Array,
    own: Columns,
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
    course, root, weak = _courses(N, b, own)
    if course is None:
        return STILL
    noise = np.eye(6)
    if correlated is not None:
        inverse = np.linalg.inv(root)
        noise += inverse.T @ correlated @ inverse
    whiten = symmetric_power(noise, -0.5, 1e-3)
    course = _filled(course @ whiten, weak)
    period = min(period, len(course) / _PERIODS)
    if period:
        smooth = _smoothed(course, int(_CUBIC * period))
    else:
        course = course - course.mean(axis=0)
        smooth = np.zeros_like(course)
    rough = course - smooth
    limit = _SPIKE * mad_sd(rough - np.median(rough, axis=0), axis=0)
    rough = np.clip(rough, -limit, limit)
    _, directions = np.linalg.eigh(rough.T @ rough)
    white, slow, memory = _components((smooth + rough) @ directions, period)
    back = np.linalg.inv(root) @ np.linalg.inv(whiten) @ directions
    return Movement(
        (back * white) @ back.T, (back * slow) @ back.T, memory,
        np.linalg.inv(root) @ noise @ np.linalg.inv(root).T,
    )  # fmt: skip


def _courses(N: Array, b: Array, own: Columns) -> tuple[Array | None, Array, Mask]:
    """Poses (E, 6) with the interior orientation held, in units of their noise; the root of their
    usual normal matrix; and which epochs (E,) say little.

    Held is the smooth course of the interior orientation, put back by the usual matrices: targets
    that come and go then do not turn a drift into a movement.
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


def _filled(course: Array, missing: Mask) -> Array:
    """The course with missing epochs interpolated between their neighbours."""
    if not missing.any() or missing.all():
        return course
    t = np.arange(len(course))
    kept = ~missing
    return np.column_stack([np.interp(t, t[kept], column[kept]) for column in course.T])


def _smoothed(course: Array, window: int = _WINDOW) -> Array:
    """Local cubics over a window of epochs through a course (E, k), also at its ends."""
    window = min(max(window, 7), len(course) // 2 - 1) | 1
    half = window // 2
    x = np.arange(-half, half + 1) / half
    V = np.vander(x, 4)
    hat = V @ np.linalg.pinv(V)
    windows = np.lib.stride_tricks.sliding_window_view(course, window, axis=0)
    return np.concatenate(
        [
            hat[:half] @ course[:window],
            windows @ hat[half],
            hat[half + 1 :] @ course[-window:],
        ]
    )


def _components(course: Array, period: float) -> tuple[Array, Array, float]:
    """Variances (k,) of the white part and of that with memory, and the memory in epochs.

    course (E, k) in units of its noise; period: the shortest of the drift in epochs, 0 for none. A
    component that the likelihood does not ask for is 0.
    """
    power = _cosine_power(_level_at_its_ends(course) if period else course)
    n = len(course)
    omega = np.pi * np.arange(1, n) / n
    if len(power) > _MOST_FREQUENCIES:  # the high ones are pooled, they look alike
        power, omega, count = _pooled(power, omega)
    else:
        count = np.ones(len(power))
    one = np.ones_like(omega)
    drift = _drift(omega, period)
    still = _fit(power, count, np.stack([drift]))
    trembling = _fit(power, count, np.stack([drift, one]))
    swaying = []
    memories = _PHI if period else _LONG_PHI
    for phi in memories:
        sway = (1 - phi**2) / (1 - 2 * phi * np.cos(omega) + phi**2)
        swaying.append(_fit(power, count, np.stack([drift, one, sway])))
    evidence = np.empty((len(memories), 3, power.shape[1]))  # still, white, with memory
    evidence[:, 0] = still.likelihood
    evidence[:, 1] = trembling.likelihood - _WHITE_COST
    evidence[:, 2] = [f.likelihood - _WHITE_COST - _SLOW_COST for f in swaying]
    evidence -= evidence.max(axis=(0, 1))
    plausible = np.exp(evidence)
    each = plausible.sum(axis=1)  # of a memory, by direction; the mount has one memory for all
    together = np.log(each).sum(axis=1)
    of_memory = np.exp(together - together.max())
    of_memory /= of_memory.sum()
    plausible *= of_memory[:, None, None] / each[:, None]
    white = plausible[:, 1].sum(axis=0) * trembling.sizes[1]
    white += sum(p * f.sizes[1] for p, f in zip(plausible[:, 2], swaying, strict=True))
    by_memory = np.array([p * f.sizes[2] for p, f in zip(plausible[:, 2], swaying, strict=True)])
    by_memory *= np.array([1.0 - _mean_variance(phi, n) for phi in memories])[:, None]
    if not period:  # without a drift of the camera, whatever wanders is the mount
        missing = (count @ power) / n - 1.0 - white - by_memory.sum(axis=0)
        by_memory[-1] = np.maximum(by_memory[-1] + missing, 0.0)
    negligible = white + by_memory.sum(axis=0) < _NEGLIGIBLE
    white[negligible], by_memory[:, negligible] = 0.0, 0.0
    slow = by_memory.sum(axis=0)
    total = float(slow.sum())
    memory = float(by_memory.sum(axis=1) @ (-1.0 / np.log(memories))) / total if total else 0.0
    return white, slow, memory


def _drift(omega: Array, period: float) -> Array:
    """Spectrum of a camera that warms up: an integrated random walk without fast movements.

    period: the shortest in epochs, 0 for a random walk without a bound.
    """
    x = 2.0 - 2.0 * np.cos(omega)
    if not period:
        return (x[0] / x) ** 2
    fast = 2.0 - 2.0 * np.cos(2.0 * np.pi / period)
    shape: Array = 1.0 / (x * (1.0 + (x / fast) ** 2)) ** 2
    shape /= shape.max()
    return shape


def _level_at_its_ends(course: Array) -> Array:
    """The course (E, k) less the parabola with its slopes at both ends.

    Its mirror image then continues it smoothly, and a drift stays at the low frequencies.
    """
    n = len(course)
    m = max(min(_WINDOW, n // 2), 4)
    t = np.arange(m) - 0.5 * (m - 1)
    V = np.vander(t, 3)
    slopes = np.linalg.pinv(V)
    first = 2 * (slopes[0] @ course[:m]) * t[0] + slopes[1] @ course[:m]
    last = 2 * (slopes[0] @ course[-m:]) * t[-1] + slopes[1] @ course[-m:]
    u = np.arange(n)[:, None]
    level: Array = course - first * u - (last - first) * u**2 / (2 * (n - 1))
    return level


def _cosine_power(course: Array) -> Array:
    """Squared coefficients (E - 1, k) of the orthonormal cosine transform, without the mean."""
    n = len(course)
    even = np.concatenate([course, course[::-1]])
    spectrum = np.fft.rfft(even, axis=0)[1:n]
    turn = np.exp(-0.5j * np.pi * np.arange(1, n) / n)[:, None]
    power: Array = (spectrum * turn).real ** 2 / (2 * n)
    return power


def _pooled(power: Array, omega: Array) -> tuple[Array, Array, Array]:
    """The low frequencies one by one, the others in equal groups, and how many each stands for."""
    half = _MOST_FREQUENCIES // 2
    groups = np.array_split(np.arange(half, len(power)), half)
    return (
        np.concatenate([power[:half], np.stack([power[g].mean(axis=0) for g in groups])]),
        np.concatenate([omega[:half], [omega[g].mean() for g in groups]]),
        np.concatenate([np.ones(half), [len(g) for g in groups]]),
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """sizes (components, k) and the likelihood (k,)."""

    sizes: Array
    likelihood: Array


def _fit(power: Array, count: Array, shapes: Array) -> _Fit:
    """Most likely sizes of spectra (components, m) beside white noise of variance 1."""
    weight = count[:, None]
    # Spectra are steep: start where each alone would give the power of its own frequencies.
    share = shapes * weight[:, 0] / np.maximum((shapes * weight[:, 0]).sum(axis=1), 1e-300)[:, None]
    peak = (shapes * share).sum(axis=1)[:, None]
    sizes = (share @ power) / np.maximum(peak, 1e-300) / len(shapes)
    for _ in range(_UPDATES):
        model = 1.0 + shapes.T @ sizes
        up = shapes @ (weight * power / model**2)
        down = shapes @ (weight / model)
        sizes = sizes * np.sqrt(up / np.maximum(down, 1e-300))
    model = 1.0 + shapes.T @ sizes
    likelihood = -0.5 * (weight * (np.log(model) + power / model)).sum(axis=0)
    return _Fit(sizes, likelihood)


def _mean_variance(phi: float, n: int) -> float:
    """Variance of the mean of n values with unit variance and correlation φ^|i-j|."""
    if n <= 1 or phi >= 1:
        return 1.0
    sum_ = (1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2)
    return float(min(sum_ / n, 1.0))


def _rms_px(A: Array, covariance: Array) -> float:
    E = A[..., EOP]
    return float(np.sqrt(np.einsum("tki,ij,tkj->tk", E, covariance, E).mean()))


def _scaled(Q: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(Q))
    scaled: Array = Q * np.outer(scale, scale)
    return scaled
