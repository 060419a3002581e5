"""The measuring noise of a series' targets, from the scatter of their own residuals.

A-priori sigmas seldom state that a near, bright marker is measured better than a far one, or that
two corners of a marker have correlated errors (corners from fitted edges correlate at -0.7 along a
common edge). A series of a static camera shows both.

Source: variance components as Förstner (1979); the shrinkage of single variances: Smyth (2004),
Linear models and empirical Bayes methods, Stat. Appl. Genet. Mol. Biol. 3(1), section 3;
the covariance of least squares under correlated noise, Q (Aᵀ P C P A) Q, as Koch (1999), 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import median_known

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask

MEDIAN_WORTH = 0.37
"""Efficiency of the median of squares: degrees of freedom per square."""

FEW_EPOCHS = 10
"""Epochs below which a slow wander of targets looks like an offset."""

_MEDIANS_FROM = 10.0  # degrees of freedom that a target's median needs
_CUT = 2.5  # standard deviations at which larger residuals are cut
_LEFT_OF_CUT = 0.9776  # mean square of a standard normal distribution cut there
_ALIKE = 1e4  # degrees of freedom if the noise of all targets is the same
_MEDIAN_CHI2_1 = 0.4549
_SIGNIFICANT = 4.0  # correlations of n pairs below 4/√n are noise: 6e-5 two-sided
_FEWEST_PAIRS = 40
_LEAST_CORRELATION = 0.3
_SMOOTH = 15  # epochs
_FEWEST_RADII = 8  # targets
_LOG_CHI2 = np.pi**2 / 6  # variance of the logarithm of χ² with two degrees of freedom
_NOISIEST = 9.0  # times the series' variance of unit weight: three times its noise
_STEP_GAIN = 20.0  # χ² that a step must explain beyond a line, over the root of the coordinates
_LEAST_STEP_PX = 0.02
_SIDE, _ABRUPT = 4, 0.8  # epochs on both sides of a step, between which this share must happen
_KINKED = 5.0  # ratio of the squares that a cubic leaves without and with a kink
_CLIP = 60.0  # times the median square, beyond which a square is a jump


def noise_ratios(
    residuals: Array, weights: Array, used: Mask, redundancy: Array | float, lost: int = 0
) -> tuple[Array, Array]:
    """Estimate variances (T, 2) of the targets' coordinates in units of their a-priori variances;
    return them with their degrees of freedom (T,).

    residuals (E, T, 2) px; weights (E, T, 3) px⁻²; used (E, T); redundancy (T, 2): redundancy
    numbers of the coordinates; lost: epochs of each target that its offset uses up. Robust: from
    medians of squares, or for a few epochs means of squares with jumps cut. They are drawn to the
    targets' common variance, strongly if they differ no more than by chance (Smyth, 2004).
    """
    squares = np.where(used[..., None], residuals**2 * weights[..., :2], np.nan) / redundancy
    n = used.sum(axis=0)[:, None].astype(np.float64)
    if lost:
        left = np.maximum(n - lost, 0.0)
        squares *= np.divide(n, left, out=np.full_like(n, np.nan), where=left > 0)
        n = left
    middle = median_known(squares) / _MEDIAN_CHI2_1
    usual = float(np.nanmedian(middle)) if np.isfinite(middle).any() else 1.0
    worth = MEDIAN_WORTH * n
    cut = (worth * middle + _MEDIANS_FROM * usual) / (worth + _MEDIANS_FROM)
    capped = np.minimum(squares, _CUT**2 * cut)
    with np.errstate(invalid="ignore"):  # targets that are not in use
        mean = np.nansum(capped, axis=0) / (~np.isnan(capped)).sum(axis=0) / _LEFT_OF_CUT
    few = worth < _MEDIANS_FROM
    ratio, worth = np.where(few, mean, middle), np.where(few, n, worth)
    of_usual = np.where(few, (1.0 - 2.0 / (9.0 * np.maximum(n, 1.0))) ** 3, 1.0)  # Wilson, Hilferty
    shown = np.isfinite(ratio) & (ratio > 0)
    if not shown.any():
        return np.ones(ratio.shape), np.full(len(worth), _ALIKE)
    freedom = np.broadcast_to(worth, ratio.shape)[shown]
    common = float(np.median((ratio / of_usual)[shown]))
    # degrees of freedom of a prior with this scatter of logarithms: trigamma(prior/2) = between
    of_chance = float(np.mean(2.0 / freedom + 2.0 / freedom**2))  # of ln χ²: trigamma(freedom/2)
    between = float(np.var(np.log(ratio[shown]))) - of_chance
    prior = (1.0 + np.sqrt(1.0 + 2.0 * between)) / between if between > 0 else _ALIKE
    prior = min(prior, _ALIKE)
    worth = worth * redundancy  # the share of a residual that is of its own error
    drawn: Array = (worth * np.where(shown, ratio, common) + prior * common) / (worth + prior)
    return np.maximum(drawn, 1e-12), worth.mean(axis=1) + prior


@dataclass(frozen=True, eq=False)
class CorrelatedPairs:
    """Pairs of image coordinates whose errors correlate.

    i, j (m,): coordinates, 2·target + axis; covariance (m,) px².
    """

    i: Index
    j: Index
    covariance: Array

    def __len__(self) -> int:
        return len(self.i)

    def normal_matrices(self, weights: Array, A: Array) -> Array:
        """Return the pairs' part (E, p, p) of Aᵀ P C P A, for weights (E, T, 3), A (T, 2, p)."""
        E, p = len(weights), A.shape[-1]
        rows, columns = np.triu_indices(p)
        flat = np.ascontiguousarray(A).reshape(-1, p)
        w = weights[..., :2].reshape(E, -1)
        together = w[:, self.i] * w[:, self.j] * self.covariance
        a, b = flat[self.i], flat[self.j]
        upper = together @ (a[:, rows] * b[:, columns] + b[:, rows] * a[:, columns])
        out = np.empty((E, p, p))
        out[:, rows, columns] = upper
        out[:, columns, rows] = upper
        return out


def correlated_pairs(
    residuals: Array, used: Mask, group: Index, redundancy_share: float
) -> CorrelatedPairs:
    """Find pairs of coordinates within a group whose residuals correlate over a series.

    residuals (E, T, 2) px; used (E, T); group (T,): label of each target's group. A group with a
    significant correlation has all its covariances in the result, as without the small ones its
    common error would be too small. Without such a group the result is empty.
    """
    E = len(residuals)
    seen = np.repeat(used, 2, axis=1)
    v = np.where(seen, residuals.reshape(E, -1), 0.0)
    mean = v.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    v = np.where(seen, v - mean, 0.0)
    none = np.empty(0, dtype=np.int64)
    left, right, covariances = [none], [none], [np.empty(0)]
    for label in np.flatnonzero(np.bincount(group) > 1):
        targets = np.flatnonzero(group == label)
        columns = np.stack([2 * targets, 2 * targets + 1], axis=1).ravel()
        part, present = v[:, columns], seen[:, columns].astype(np.float64)
        n = present.T @ present
        covariance = (part.T @ part) / np.maximum(n, 1.0)
        square = (part * part).T @ present / np.maximum(n, 1.0)  # of i over epochs shared with j
        scale = np.sqrt(square * square.T)
        r = np.divide(covariance, scale, out=np.zeros_like(covariance), where=scale > 0)
        limit = np.maximum(_SIGNIFICANT / np.sqrt(np.maximum(n, 1.0)), _LEAST_CORRELATION)
        i, j = np.nonzero(np.triu(n > 0, 1))
        if ((np.abs(r) > limit) & (n >= _FEWEST_PAIRS))[i, j].any():
            left.append(columns[i])
            right.append(columns[j])
            covariances.append(covariance[i, j])
    return CorrelatedPairs(
        np.concatenate(left), np.concatenate(right), np.concatenate(covariances) / redundancy_share
    )


def noise_by_radius(tests: Array, used: Mask, radius: Array) -> tuple[float, float]:
    """Estimate the noise of the outermost target over that in the image's middle, with its sd.

    tests (E, T): squared residuals over their stated variance; used (E, T); radius (T,): of the
    targets from the image's middle. The logarithm of the noise is a straight line in r², robust to
    gross errors; the sd follows the targets' scatter about it. NaN if it cannot be estimated.
    """
    counted = used & (tests > 0)
    n = counted.sum(axis=0)
    logarithms = np.log(np.where(counted, tests, 1.0)).sum(axis=0)
    seen = n > 0
    if seen.sum() < _FEWEST_RADII or not np.ptp(radius[seen]) > 0:
        return float("nan"), float("nan")
    y, x, w = logarithms[seen] / n[seen], radius[seen] ** 2, n[seen].astype(float)
    line, Q = np.polyfit(x, y, 1, w=np.sqrt(w), cov="unscaled")
    scatter = float(w @ (y - np.polyval(line, x)) ** 2) / (len(y) - 2)
    ratio = float(np.exp(0.5 * line[0] * x.max()))
    return ratio, ratio * 0.5 * float(x.max() * np.sqrt(max(scatter, _LOG_CHI2) * Q[0, 0]))


def slow_course(epochs: int, step: int) -> Array:
    """Return the course (epochs,), centred and of range 1, of a step at a row, 0 for a line."""
    if not step:
        return np.linspace(-0.5, 0.5, epochs, dtype=np.float64)
    return np.where(np.arange(epochs) >= step, step / epochs, step / epochs - 1.0)


def slow_errors(residuals: Array, used: Mask, steps: bool = True) -> tuple[Array, int]:
    """Estimate the slow change (T, 2) px of each target's error over a series.

    residuals (E, T, 2) px; used (E, T); steps: whether the change may be a step. Returns the
    changes, whose course is `slow_course`, and the first epoch (row) after a step, 0 for a straight
    line. Light that wanders over a marker, or a board that gives way, moves
    single targets slowly; a knock moves a part of the field. A change is less its noise, and 0 if
    it is no larger than that.
    """
    E = len(residuals)
    w = used[..., None].astype(np.float64)
    n = np.maximum(w.sum(axis=0), 1.0)
    v = np.where(used[..., None], residuals, 0.0)
    v = (v - v.sum(axis=0) / n) * w

    def fit(course: Array) -> tuple[Array, Array, Array]:
        """Return changes (T, 2), their variances, and the squares that they explain."""
        x = course[:, None, None]
        x = (x - (w * x).sum(axis=0) / n) * w
        sxx = np.maximum((x * x).sum(axis=0), 1e-12)
        slope = (x * v).sum(axis=0) / sxx
        variance = ((v - slope * x) ** 2).sum(axis=0) / np.maximum(n - 2, 1.0) / sxx
        enough = (n >= FEW_EPOCHS) & (sxx > 0.01 * E)
        return np.where(enough, slope, 0.0), variance, np.where(enough, slope**2 * sxx, 0.0)

    row = 0
    slope, variance, explained = fit(slow_course(E, 0))
    if steps and E >= 2 * _SMOOTH:
        before = np.cumsum(w, axis=0)[:-1]
        sxx = before * (n - before) / n
        gains = np.cumsum(v, axis=0)[:-1] ** 2 / np.maximum(sxx, 1.0)
        gains = np.where(sxx > 0.01 * E, gains, 0.0).sum(axis=(1, 2))
        at = 1 + int(np.argmax(gains))
        step = fit(slow_course(E, at))
        rest = float((v**2).sum() - step[2].sum()) / max(2.0 * float(w.sum()), 1.0)
        sides = [slice(max(at - _SIDE, 0), at), slice(at, at + _SIDE)]
        earlier, later = (v[k].sum(axis=0) / np.maximum(w[k].sum(axis=0), 1.0) for k in sides)
        size = float((step[0] ** 2).sum())
        abrupt = float(((later - earlier) * step[0]).sum()) > _ABRUPT * size
        gain, moving = float(step[2].sum() - explained.sum()), np.count_nonzero(step[2])
        large = size > moving * _LEAST_STEP_PX**2
        if large and abrupt and gain > _STEP_GAIN * np.sqrt(moving) * rest:
            (slope, variance, _), row = step, at
    squares = slope**2
    noise = np.divide(variance, squares, out=np.ones_like(squares), where=squares > variance)
    return slope * np.sqrt(1.0 - noise), row


def neighbours_variance(unit: Array, known: Mask, least: float = 1.0) -> Array:
    """Return the variance of unit weight (E,) about each epoch, over the series', `least` to 9.

    unit (E,): of the epochs, over the series' own; known (E,): which of them count. The median of
    the 15 epochs around each, 1 where fewer than 10 of them count: the noise of a camera that
    warms up and defocuses changes slowly, a gross error is of one epoch.
    """
    size = min(_SMOOTH, len(unit))
    windows = np.lib.stride_tricks.sliding_window_view(np.where(known, unit, np.nan), size)
    enough = np.isfinite(windows).sum(axis=1) >= FEW_EPOCHS
    middle = np.ones(len(windows))
    middle[enough] = np.nanmedian(windows[enough], axis=1)
    at = np.clip(np.arange(len(unit)) - size // 2, 0, len(windows) - 1)
    return np.clip(middle, least, _NOISIEST)[at]


@cache
def _local_fit(kink: int) -> Array:
    """Return the projector (15, 15) on a cubic over 15 epochs, with a kink before one of them.

    kink: 0 for none. The epochs from the kink on have a parabola of their own, so that it may be
    anywhere between two epochs.
    """
    t = np.arange(_SMOOTH) - _SMOOTH // 2
    basis = np.vander(t, 4)
    if kink:
        after = np.arange(_SMOOTH) >= kink
        basis = np.column_stack([basis, np.vander(t, 3) * after[:, None]])
    return np.asarray(basis @ np.linalg.pinv(basis.astype(float)))


def _kinks_inside(windows: Array, hats: Array) -> Index:
    """Return for windows (n, k, 15) before which of their epochs there is a kink, 0 for none.

    hats (15, 15, 15): from `_local_fit`.
    """
    half = _SMOOTH // 2
    without, within = (((windows - windows @ hats[at]) ** 2).sum(axis=-1) for at in (0, half))
    gain = np.pad(without / np.maximum(within, 1e-300), ((half - 1, half), (0, 0)))
    around = np.lib.stride_tricks.sliding_window_view(gain, _SMOOTH - 1, axis=0)
    return np.where(around.max(axis=-1) > _KINKED, 1 + around.argmax(axis=-1), 0)


def excess_scatter(values: Array, variances: Array, kinks: bool, drift: bool) -> Array:
    """Estimate the excess variance (k,) of epochs about a smooth trajectory; 0 if not significant.

    values, variances (E, k): of consecutive epochs. The trajectory is a local cubic over 15 epochs,
    whose residuals have a thousandth of a drift with a time constant of 30 epochs; kinks: whether
    it may have kinks beyond the noise (a heater switched), which the cubic then has too, and a
    median is needed; drift: whether the camera may drift, else the trajectory is constant. The test
    is at 5 %.
    """
    half = _SMOOTH // 2
    if len(values) < 2 * _SMOOTH:
        return np.zeros(values.shape[1])
    if not drift:
        normed = (values - values.mean(axis=0)) ** 2 / variances
        ratio = normed.mean(axis=0) * len(values) / (len(values) - 1)
        significant = ratio > 1 + 1.65 * np.sqrt(2 / len(values))
        # Each epoch's own variance is subtracted, so that a few large ones do not raise the excess.
        wide = (values - values.mean(axis=0)) ** 2 - variances
        return np.where(significant, np.maximum(wide.mean(axis=0), 0.0), 0.0)
    hats = np.stack([_local_fit(at) for at in range(_SMOOTH)])
    inner = slice(half, len(values) - half)
    windows = np.lib.stride_tricks.sliding_window_view(values, _SMOOTH, axis=0)
    model = _kinks_inside(windows, hats) if kinks else np.zeros(windows.shape[:2], np.int64)
    smooth = hats[model, half]
    residual = values[inner] - (windows * smooth).sum(axis=-1)
    normed = residual**2 / (1.0 - smooth[..., half]) / variances[inner]
    n, left = len(normed), 1.0 - hats[0, half, half]
    if kinks:
        ratio, worth = np.median(normed, axis=0) / _MEDIAN_CHI2_1, MEDIAN_WORTH * left
    else:
        # The mean counts epochs that scatter more, as when a passer-by hides half of the targets.
        ratio, worth = np.minimum(normed, _CLIP * np.median(normed, axis=0)).mean(axis=0), left
    significant = ratio > 1 + 1.65 * np.sqrt(2 / (worth * n))
    return np.where(significant, (ratio - 1) * variances.mean(axis=0), 0.0)
