"""How far a mount moves: its variance components, and what they do to a series.

A trajectory in time has a white component, one with memory, and the drift of the camera. They
maximise the likelihood in the cosine domain, where a trajectory of evenly spaced epochs is nearly
uncorrelated; how long the memory is, and whether a component is there at all, is averaged over as
plausible.

Source: Whittle (1953), Estimation and information in stationary time series; the maximisation by
multiplicative updates as Févotte and Idier (2011), Neural Computation 23, 2421-2456.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import symmetric_power

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array


_PHI = np.array([0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98])
_LONG_PHI = np.append(_PHI, [0.99, 0.995, 0.998])  # where no drift can be mistaken for it
_UPDATES = 150
_WHITE_COST = 8.0  # log-likelihood that a tremble must gain, in the best of six directions
_SLOW_COST = 2.0  # that a memory must gain with it
_NEGLIGIBLE = 0.02  # of the noise's variance
_MOST_FREQUENCIES = 2000
_LEAK_DEGREE = 6
_LEAST_PER_DEGREE = 20  # fast frequencies: fewer would lose much of the mount itself
_END = 15  # epochs at each end that tell the slope there


@dataclass(frozen=True, eq=False)
class Components:
    """Variances (k,) of the white part and of that with memory about the mean; the memory of the
    latter in epochs, 0 without it.
    """

    white: Array
    slow: Array
    memory: float


def components(trajectory: Array, period: float) -> Components:
    """The components of every column of a trajectory.

    trajectory (E, k) in units of its noise; period: the shortest of the drift in epochs, 0 for
    none. A component that the likelihood does not ask for is 0.
    """
    power = _cosine_power(
        _without_leak(_level_at_its_ends(trajectory), period) if period else trajectory
    )
    n = len(trajectory)
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
    by_memory *= np.array([1.0 - mean_variance(phi, n) for phi in memories])[:, None]
    if not period:  # without a drift of the camera, whatever wanders is the mount
        missing = (count @ power) / n - 1.0 - white - by_memory.sum(axis=0)
        by_memory[-1] = np.maximum(by_memory[-1] + missing, 0.0)
    negligible = white + by_memory.sum(axis=0) < _NEGLIGIBLE
    white[negligible], by_memory[:, negligible] = 0.0, 0.0
    slow = by_memory.sum(axis=0)
    total = float(slow.sum())
    memory = float(by_memory.sum(axis=1) @ (-1.0 / np.log(memories))) / total if total else 0.0
    return Components(white, slow, memory)


def _drift(omega: Array, period: float) -> Array:
    """Spectrum of a camera that warms up: an integrated random walk without fast movements.

    period: the shortest in epochs, 0 for a random walk without a bound.
    """
    x = 2.0 - 2.0 * np.cos(omega)
    if not period:
        walk: Array = (x[0] / x) ** 2
        return walk
    fast = 2.0 - 2.0 * np.cos(2.0 * np.pi / period)
    shape: Array = 1.0 / (x * (1.0 + (x / fast) ** 2)) ** 2
    shape /= shape.max()
    return shape


def _level_at_its_ends(trajectory: Array) -> Array:
    """The trajectory (E, k) less the parabola with its slopes at both ends.

    Its mirror image then continues it smoothly, and a drift stays at the low frequencies.
    """
    n = len(trajectory)
    m = max(min(_END, n // 2), 4)
    t = np.arange(m) - 0.5 * (m - 1)
    V = np.vander(t, 3)
    slopes = np.linalg.pinv(V)
    first = 2 * (slopes[0] @ trajectory[:m]) * t[0] + slopes[1] @ trajectory[:m]
    last = 2 * (slopes[0] @ trajectory[-m:]) * t[-1] + slopes[1] @ trajectory[-m:]
    u = np.arange(n)[:, None]
    level: Array = trajectory - first * u - (last - first) * u**2 / (2 * (n - 1))
    return level


def _without_leak(trajectory: Array, period: float) -> Array:
    """The trajectory (E, k) less the polynomial that explains most of its fast part.

    A strong drift that does not end flat has high frequencies of its own, those of a polynomial;
    besides a millipixel of noise they would be taken for movements of the mount.
    """
    n = len(trajectory)
    low = int(2 * n / period)
    if n - 1 - low < _LEAST_PER_DEGREE * _LEAK_DEGREE:
        return trajectory
    u = np.linspace(-1.0, 1.0, n)
    basis = np.stack([u**k for k in range(1, _LEAK_DEGREE + 1)], axis=1)
    fast, _, _, _ = np.linalg.lstsq(_cosines(basis)[low:], _cosines(trajectory)[low:], rcond=None)
    clean: Array = trajectory - basis @ fast
    return clean


def _cosine_power(trajectory: Array) -> Array:
    """Squared coefficients (E - 1, k) of the orthonormal cosine transform, without the mean."""
    power: Array = _cosines(trajectory) ** 2
    return power


def _cosines(trajectory: Array) -> Array:
    """Coefficients (E - 1, k) of the orthonormal cosine transform, without the mean."""
    n = len(trajectory)
    even = np.concatenate([trajectory, trajectory[::-1]])
    spectrum = np.fft.rfft(even, axis=0)[1:n]
    turn = np.exp(-0.5j * np.pi * np.arange(1, n) / n)[:, None]
    coefficients: Array = (spectrum * turn).real / np.sqrt(2 * n)
    return coefficients


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
    """Most likely sizes of spectra (components, m) alongside white noise of variance 1."""
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


def mean_variance(phi: float, n: int) -> float:
    """Variance of the mean of n values with unit variance and correlation φ^|i-j|."""
    if n <= 1 or phi >= 1:
        return 1.0
    sum_ = (1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2)
    return float(min(sum_ / n, 1.0))


_HIDDEN = 0.3  # of the noise's variance: too little to estimate it epoch by epoch
_FLAT = 1e-6  # of the noise: directions without movement


@dataclass(frozen=True, eq=False)
class Movement:
    """How far a mount moves about its mean pose over a series.

    white, slow (6, 6): covariance of the exterior orientation, rad and mm, of a movement without
    and with memory, about the mean over the series; memory: epochs after which the latter has lost
    63 % of its correlation; noise (6, 6): covariance of the pose of one epoch with its interior
    orientation held; jumps: the epochs from which on it stood elsewhere.
    """

    white: Array
    slow: Array
    memory: float
    noise: Array
    jumps: tuple[int, ...] = ()

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of an epoch's movement."""
        return self.white + self.slow

    @property
    def still(self) -> bool:
        """Whether no movement was found that one epoch's noise would not hide."""
        whiten = self._whitening()
        inside = np.linalg.eigvalsh(whiten @ self.covariance @ whiten.T)
        return bool(inside[-1] < _HIDDEN)

    def _whitening(self) -> Array:
        """T with T · noise · Tᵀ = 1."""
        root = symmetric_power(_scaled(self.noise), -0.5, 1e-12)
        whitening: Array = root / np.sqrt(np.diag(self.noise))
        return whitening

    def precision(self) -> Array:
        """Inverse covariance (6, 6); directions without movement are held to 1e-3 of the noise."""
        T = self._whitening()
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
        for first in range(0, len(weights), 1 << 16):
            for w in weights[first : first + (1 << 16)].tolist():
                total += w * (w + 2.0 * carried)
                carried = phi * (carried + w)
        about_mean = 1.0 - mean_variance(phi, int(np.count_nonzero(weights)))
        return white + self.slow * (total / max(about_mean, 1e-6))


STILL = Movement(np.zeros((6, 6)), np.zeros((6, 6)), 0.0, np.eye(6))
"""A mount that does not move."""


def together(movements: Sequence[Movement], starts: Sequence[int]) -> Movement:
    """The mean of the movements of parts of a series, which start at some epochs.

    The memory is the longest; jumps count as those of the series.
    """
    return Movement(
        np.mean([m.white for m in movements], axis=0),
        np.mean([m.slow for m in movements], axis=0),
        max(m.memory for m in movements),
        np.mean([m.noise for m in movements], axis=0),
        tuple(start + row for m, start in zip(movements, starts, strict=True) for row in m.jumps),
    )


def _rms_px(A: Array, covariance: Array) -> float:
    E = A[..., EOP]
    return float(np.sqrt(np.einsum("tki,ij,tkj->tk", E, covariance, E).mean()))


def _scaled(Q: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(Q))
    scaled: Array = Q * np.outer(scale, scale)
    return scaled
