"""The variance components of a trajectory: how much of its scatter is white, how much has a memory.

A camera that warms up follows an integrated random walk, while a mount trembles (white) or sways
and settles (with memory, first-order autoregressive). The variance components maximise the
likelihood in the cosine domain, direction by direction. The result is averaged over the lengths of
the memory, and over models with and without each component, weighted by their plausibility.

Sources: variance components as Patterson and Thompson (1971), Biometrika 58, 545-554; Whittle
(1953), Estimation and information in stationary time series; the maximisation by multiplicative
updates as Févotte and Idier (2011), Neural Computation 23, 2421-2456.
"""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import chi2_quantile

if TYPE_CHECKING:
    from thermocald.arrays import Array

_PHI = np.array([0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98])
_LONG_PHI = np.append(_PHI, [0.99, 0.995, 0.998])  # for series without drift, which looks alike
_UPDATES = 150
_WHITE_COST = 8.0  # log-likelihood that a tremble must gain, in the best of six directions
_SLOW_COST = 2.0  # further log-likelihood that a memory must gain
_NEGLIGIBLE = 0.02  # of the noise's variance
_DEGREE = 6
_LEAST_FAST = 12  # frequencies of a drift's removal
_ENOUGH_FAST = 120  # frequencies; with fewer too much of a movement goes with the drift
_MOST_BENDS = 4
_MOST_BENDS_TRIED = 400
_TOGETHER = 200_000  # epochs of all bends that are tried at once: 100 MB
_LEAST_BEND = 8  # epochs from either end
_BY_CHANCE = 1e-3  # probability of a bend too many, which costs three of the frequencies
_END = 15  # epochs at each end that give the slope there


def components(trajectory: Array, period: float, held: bool = False) -> tuple[Array, Array, float]:
    """Estimate the variance components of every column of a trajectory.

    trajectory (E, k): in units of its noise; period: shortest period of the drift in epochs, 0 for
    none; held: no free parameter follows it, in a series of any length.

    Returns the variances (k,) of the white part and of the part with memory, about its mean, and
    the memory in epochs, 0 without one. A component without support by the likelihood is 0.
    """
    n = len(trajectory)
    coefficients = _cosines(_level_ends(trajectory) if period else trajectory)
    if period and (fast := n - 1 - (low := int(2 * n / period))) >= _LEAST_FAST:
        found = _sizes(_remove_drift(coefficients, low), period, held)
        # so a short series may show that a mount does not move, but not how far it moves
        if fast >= _ENOUGH_FAST or (found[0] + found[1]).max() < 1.0:
            return found
    return _sizes(coefficients, period, held)


def _sizes(coefficients: Array, period: float, held: bool) -> tuple[Array, Array, float]:
    """Return the components of cosine coefficients (E - 1, k), as `components`."""
    n = len(coefficients) + 1
    power = coefficients**2
    omega = np.pi * np.arange(1, n) / n
    one = np.ones_like(omega)
    drift = _drift(omega, period)
    memories = _PHI if period else _LONG_PHI
    evidence = np.empty((len(memories), 3, power.shape[1]))  # still, white, with memory
    _, walking = _fit(power, np.stack([drift]))
    evidence[:, 0] = walking
    (_, trembling), likelihood = _fit(power, np.stack([drift, one]))
    evidence[:, 1] = likelihood - _WHITE_COST
    phi = memories[:, None]
    sway = (1 - phi**2) / (1 - 2 * phi * np.cos(omega) + phi**2)
    shapes = np.stack(np.broadcast_arrays(drift, one, sway), axis=1)
    swaying, likelihood = _fit(power, shapes)
    evidence[:, 2] = likelihood - _WHITE_COST - _SLOW_COST
    evidence -= evidence.max(axis=(0, 1))
    plausible = np.exp(evidence)
    each = plausible.sum(axis=1)  # memories by directions; the mount has one memory for all
    together = np.log(each).sum(axis=1)
    of_memory = np.exp(together - together.max())
    of_memory /= of_memory.sum()
    plausible *= of_memory[:, None, None] / each[:, None]
    white = plausible[:, 1].sum(axis=0) * trembling
    white += (plausible[:, 2] * swaying[:, 1]).sum(axis=0)
    by_memory = plausible[:, 2] * swaying[:, 2]
    by_memory *= np.array([1.0 - mean_variance(phi, n) for phi in memories])[:, None]
    if not period:  # without a drift of the camera all slow movement is the mount's
        missing = power.sum(axis=0) / n - 1.0 - white - by_memory.sum(axis=0)
        if held:  # a still camera's noise is not a movement
            missing[walking + 0.5 * power.sum(axis=0) < _WHITE_COST] = 0.0
        by_memory[-1] = np.maximum(by_memory[-1] + missing, 0.0)
    negligible = white + by_memory.sum(axis=0) < _NEGLIGIBLE
    white[negligible], by_memory[:, negligible] = 0.0, 0.0
    slow = by_memory.sum(axis=0)
    total = float(slow.sum())
    memory = float(by_memory.sum(axis=1) @ (-1.0 / np.log(memories))) / total if total else 0.0
    return white, slow, memory


def _drift(omega: Array, period: float) -> Array:
    """Return the spectrum of a camera that warms up: an integrated random walk, low-pass filtered.

    period: the shortest in epochs, 0 for no filter.
    """
    x = 2.0 - 2.0 * np.cos(omega)
    if not period:
        return np.asarray((x[0] / x) ** 2)
    fast = 2.0 - 2.0 * np.cos(2.0 * np.pi / period)
    shape: Array = 1.0 / (x * (1.0 + (x / fast) ** 2)) ** 2
    shape /= shape.max()
    return shape


def _level_ends(trajectory: Array) -> Array:
    """Subtract from a trajectory (E, k) the parabola with its slopes at both ends.

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
    return np.asarray(trajectory - first * u - (last - first) * u**2 / (2 * (n - 1)))


def _remove_drift(coefficients: Array, low: int) -> Array:
    """Remove a drift from the cosine coefficients (E - 1, k) of frequencies from `low` on.

    A strong drift that is not level at its ends, or bends where a heater is switched, has high
    frequencies too; with noise of a millipixel they would look like movements of the mount. The
    drift is a polynomial with bends, as many as the likelihood of a smooth spectrum supports.
    """
    fast, n = coefficients[low:], len(coefficients) + 1
    u = np.linspace(-1.0, 1.0, n)[:, None]
    m = len(fast)
    basis = _cosines(u ** np.arange(1, min(_DEGREE, max(m // 10, 1)) + 1))[low:]
    basis = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))[0]
    fast = fast - basis @ (basis.T @ fast)
    rows = np.unique(np.linspace(_LEAST_BEND, n - _LEAST_BEND, _MOST_BENDS_TRIED).astype(int))
    needed = 0.5 * chi2_quantile(1.0 - _BY_CHANCE / len(rows), 3 * fast.shape[1])
    least = needed if m >= _ENOUGH_FAST else 0.0  # a short series only shows what no bend explains
    likelihood = float(_likelihood(fast, low))
    for _ in range(min(_MOST_BENDS, max((m // 4 - basis.shape[1]) // 3, 1))):
        parts = np.array_split(rows, -(-len(rows) * n // _TOGETHER))
        tried = (_best_bend(fast, basis, part, low, anywhere=True) for part in parts)
        best = max(tried, key=itemgetter(0))
        if best[0] - likelihood < least:
            break
        for near in (np.linspace(0.0, 1.0, 11), np.linspace(-0.1, 0.1, 21)):
            best = _best_bend(fast, basis, best[1] + near, low)
        if best[0] - likelihood < least:
            break
        least = needed
        likelihood, at, fast, bend = best
        basis = np.column_stack([basis, bend])
        rows = rows[np.abs(rows - at) > _LEAST_BEND]  # two together would be a step
        if not len(rows):
            break
    return np.concatenate([coefficients[:low], fast])


def _best_bend(
    fast: Array, basis: Array, at: Array, low: int, *, anywhere: bool = False
) -> tuple[float, float, Array, Array]:
    """Return the likelihood with the best of some bends, its epoch, the coefficients left, and its
    basis.

    fast (m, k): coefficients without `basis` (m, ·); at (bends,): epochs of the bends, anywhere: up
    to the next one, as a heater is switched between two epochs.
    """
    n = low + len(fast) + 1
    after = np.clip((np.arange(n)[:, None] - at) / n, 0.0, None)
    shapes = [after, after**2, after**3, *[np.sign(after)] * anywhere]
    bends = np.stack([_cosines(each)[low:].T for each in shapes], axis=-1)  # (bends, m, ·)
    inside = bends - basis @ (basis.T @ bends)
    inside = np.linalg.qr(inside / np.linalg.norm(inside, axis=1, keepdims=True))[0]
    left = fast - inside @ (np.swapaxes(inside, 1, 2) @ fast)
    likelihood = _likelihood(left, low)
    best = int(np.argmax(likelihood))
    return float(likelihood[best]), float(at[best]), left[best], inside[best]


def _likelihood(coefficients: Array, low: int) -> Array:
    """Return the log-likelihood (...) of coefficients (..., m, k) of frequencies from `low` on.

    Their spectrum is the power averaged over an octave, at least the noise's 1.
    """
    power = np.pad(coefficients**2, [(0, 0)] * (coefficients.ndim - 2) + [(1, 0), (0, 0)])
    sums, m = np.cumsum(power, axis=-2), coefficients.shape[-2]
    at = np.arange(m) + low + 1
    last = np.clip((at * np.sqrt(2.0)).astype(int) - low, 8, m)
    first = np.clip((at / np.sqrt(2.0)).astype(int) - low - 1, 0, last - 8)
    mean = (sums[..., last, :] - sums[..., first, :]) / (last - first)[:, None]
    return np.asarray(-0.5 * np.log(np.maximum(mean, 1.0)).sum(axis=(-1, -2)))


def _cosines(trajectory: Array) -> Array:
    """Return the coefficients (E - 1, k) of the orthonormal cosine transform, without the mean."""
    n = len(trajectory)
    even = np.concatenate([trajectory, trajectory[::-1]])
    spectrum = np.fft.rfft(even, axis=0)[1:n]
    turn = np.exp(-0.5j * np.pi * np.arange(1, n) / n)[:, None]
    return np.asarray((spectrum * turn).real / np.sqrt(2 * n))


def _fit(power: Array, shapes: Array) -> tuple[Array, Array]:
    """Fit the sizes of spectra (..., components, m) on white noise of variance 1.

    power (m, k). Returns the sizes (..., components, k) and the log-likelihood (..., k).
    """
    # Spectra are steep: each starts at the size that explains the power of its own frequencies.
    share = shapes / np.maximum(shapes.sum(axis=-1, keepdims=True), 1e-300)
    peak = (shapes * share).sum(axis=-1, keepdims=True)
    sizes = (share @ power) / np.maximum(peak, 1e-300) / shapes.shape[-2]
    across = np.swapaxes(shapes, -1, -2)
    for _ in range(_UPDATES):
        inverse = 1.0 / (1.0 + across @ sizes)
        up = shapes @ (power * inverse**2)
        sizes = sizes * np.sqrt(up / np.maximum(shapes @ inverse, 1e-300))
    model = 1.0 + across @ sizes
    likelihood = -0.5 * (np.log(model) + power / model).sum(axis=-2)
    return sizes, likelihood


def mean_variance(phi: float, n: int) -> float:
    """Return the variance of the mean of n values with unit variance and correlation φ^|i-j|."""
    apart = np.arange(n)
    return float(2.0 * phi**apart @ (n - apart) - n) / n**2 if n else 1.0
