"""Noise beyond the images' sigmas, noise that follows the temperature, and thermometers' noise.

Noise that is correlated in time shows in the residuals of single targets; it makes slow
trajectories less certain than their number of epochs suggests. The corners of a marker or of a
board have slow errors in common, which bias some combinations of the parameters more than others.
Noise that neighbours share from epoch to epoch enters the camera's parameters and shows in their
jumps, once the trajectories have been explained.

Source: Liang, Zeger (1986), Biometrika 73, 13-22, for covariances from clusters with common errors;
Bell, McCaffrey (2002), Survey Methodology 28, 169-181, for the reduction of residuals by the fit.

Measuring noise that follows the temperature is estimated from the variances of the epochs' free
cameras, which no movement of the camera affects. Source: variances as a generalised linear model,
McCullagh and Nelder (1989), Generalized Linear Models, chapter 10.

The noise of the reference thermometer is estimated by `thermometer` from the roughness of the
readings. The images follow the temperature through the linear terms; they are more precise than
most thermometers and so can confirm the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.linalg import (
    orthonormal_combinations,
    scaled_inverse,
    scaled_solve,
    symmetric_power,
)
from thermocald.thermal import criteria
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import detect_tremble, weight_jumps_down
from thermocald.thermal.scan import ORDERS
from thermocald.thermal.series import ReducedSeries, cosines, in_blocks
from thermocald.thermal.thermometer import CLIPPED_AT, CLIPPED_SD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.thermal.hypothesis import Fit, Term

_JUMP_SD = 4.0  # standard deviations of the images' slope, from which its change is a jump

_LEAST = 0.005  # least noise, as a fraction of that at T0
_LEAST_AT_T0 = 0.1  # of that at the nearest recorded temperature: at less, a defocus stops

_FEIGNED = 0.8  # of a delay's sd half an interval between readings later: a smaller one is feigned
_BY_READINGS = 0.9  # of a rate's sd beside known readings: a smaller one comes from the images


@dataclass(frozen=True, eq=False)
class NoiseGrowth:
    """A measuring noise 1 + factor (T - T0).

    factor, sd: per K; gain: in -2 log L over constant noise; other_gain, other: of the best
    trajectory other than the reference temperature (time, another channel); noise (E,): per series.
    """

    factor: float
    sd: float
    gain: float
    other_gain: float
    other: str
    noise: tuple[Array, ...]


def noise_growth(series: Sequence[ReducedSeries]) -> NoiseGrowth | None:
    """Estimate how the measuring noise follows the reference temperature; None if it does not.

    None also if another thermometer explains it better, or time explains it as well. The variances
    of the epochs' adjustments are χ² distributed about (1 + k (T - T0))².
    """
    data = _list_variances(series)
    temperature = _temperatures(series)[1]
    gain = _estimate_slope(temperature, data)[1]
    others: list[tuple[float, str]] = []
    for name in series[0].history.readings:
        if name != series[0].history.reference and all(name in e.history.readings for e in series):
            trajectory = [e.history.temperature(name) for e in series]
            others.append((_estimate_slope([c - c.mean() for c in trajectory], data)[1], name))
    time = [(e.times - e.times.mean()) / max(float(np.ptp(e.times)), 1.0) for e in series]
    by_time = _estimate_slope(time, data)[1]
    other_gain, other = max([*others, (by_time, "time")])
    # two thermometers of a camera rise together: only a clearly better one excludes the reference
    least = [criteria.GROWTH, by_time + criteria.CLEAR, *(g - criteria.CLEAR for g, _ in others)]
    if gain < max(least):
        return None
    growth = estimate_noise_slope(series)
    if growth.gain < criteria.GROWTH:
        return None
    return replace(growth, other_gain=other_gain * growth.gain / gain, other=other)


def estimate_noise_slope(series: Sequence[ReducedSeries]) -> NoiseGrowth:
    """Estimate how the measuring noise follows the reference temperature, significant or not.

    Raises DataError if there would be none at a T0 beyond the recorded temperatures.
    """
    data = _list_variances(series)
    nearest, temperature = _temperatures(series)
    k, gain, sd = _estimate_slope(temperature, data)
    rough = _measure_roughness(temperature, data, k)
    T0 = series[0].T0
    at_T0 = 1.0 + k * (T0 - nearest)
    if at_T0 < _LEAST_AT_T0:
        raise DataError(
            f"the measuring noise follows the temperature so closely that at T0 = {T0:g} °C there "
            f"would be none; choose T0 nearer to the recorded temperatures, as {nearest:.1f} °C"
        )
    noise = tuple(np.maximum(1.0 + k * t, _LEAST) / at_T0 for t in temperature)
    return NoiseGrowth(
        k / at_T0, sd * float(np.sqrt(rough)) / at_T0**2, gain / rough, 0.0, "", noise
    )


def _temperatures(series: Sequence[ReducedSeries]) -> tuple[float, list[Array]]:
    """Return the recorded temperature nearest to T0, and each series' temperatures minus it."""
    recorded = [e.history.temperature() for e in series]
    nearest = float(np.clip(series[0].T0, min(map(np.min, recorded)), max(map(np.max, recorded))))
    return nearest, [T - nearest for T in recorded]


def _list_variances(
    series: Sequence[ReducedSeries],
) -> list[tuple[NDArray[np.bool_], Array, Array]]:
    """Return for each series which epochs count, and their degrees of freedom and variances."""
    free = [np.maximum(2.0 * e.n - e.N.shape[1], 1.0) for e in series]
    return [(e.n > 0, f, e.sigma0**2) for e, f in zip(series, free, strict=True)]


def _measure_roughness(
    trajectories: Sequence[Array], data: Sequence[tuple[NDArray[np.bool_], Array, Array]], k: float
) -> float:
    """Return the factor, at least 1, by which the variances scatter more and slower than χ²."""
    total = []
    for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
        f = free[ok]
        ratio = v[ok] / np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
        z = (ratio / (np.sum(f * ratio) / np.sum(f)) - 1.0) * np.sqrt(f / 2.0)
        power = float(np.mean(z**2))
        slow = 1.0 + 2.0 * sum(
            float(np.mean(z[j:] * z[:-j])) / max(power, 1e-9) for j in range(1, min(11, len(z)))
        )
        total.append(power * max(slow, 1.0))
    return max(1.0, float(np.mean(total)))


def _estimate_slope(
    trajectories: Sequence[Array],
    data: Sequence[tuple[NDArray[np.bool_], Array, Array]],
) -> tuple[float, float, float]:
    """Estimate the noise 1 + k trajectory, with a level per series; return k, -2 log L gain, sd."""
    from scipy.optimize import minimize_scalar

    def objective(k: float) -> float:
        total = 0.0
        for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
            s2 = np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
            # the targets' offsets, as means over all epochs, bring the mean noise into each epoch
            s2 = s2 + (s2.mean() - s2) / len(s2)
            f = free[ok]
            level = np.sum(f * v[ok] / s2) / np.sum(f)
            total += float(np.sum(f * (np.log(s2) + np.log(level))))
        return total

    reach = max(float(np.max(np.abs(c))) for c in trajectories)
    if reach == 0.0:  # a thermometer that is stuck
        return 0.0, 0.0, float("inf")
    low = min(float(np.min(c)) for c in trajectories)
    high = max(float(np.max(c)) for c in trajectories)
    bounds = (-0.995 / max(high, 1e-9), 0.995 / max(-low, 1e-9))
    start = minimize_scalar(objective, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    k = float(start.x)
    gain = objective(0.0) - float(start.fun)
    h = 0.01 / reach
    curvature = (objective(k + h) - 2 * objective(k) + objective(k - h)) / h**2
    # log variances scatter slightly more than χ², because of gross errors near the limit
    sd = float(np.sqrt(2.0 / curvature)) if curvature > 0 else float("inf")
    return k, gain, sd


def calibrate_thermometers(series: Sequence[ReducedSeries]) -> list[ReducedSeries]:
    """Return the series with the reference thermometer's noise estimated from readings and images.

    The images measure the temperature too, through the linear terms: with an unknown slow error,
    but more precisely than most thermometers. If a fast effect prevents that, the readings alone
    count. The thermometer has the same noise in all series.
    """
    fitter = HypothesisFitter([in_blocks(e) for e in series])
    fit = fitter.fit(())
    fitter = HypothesisFitter(series)
    d = fit.direction(fit.blocks[0])[0]
    variances, weights, jumps = [], [], []
    for s, e in enumerate(series):
        # a tremble of the mount would bend the trajectory too
        jumps.append(np.zeros(len(e.times)) if detect_tremble(e) else _slope_jumps(e, d))
        instrument = e.thermometers[e.history.reference]
        precision = np.einsum("p,epq,q->e", d, e.N, d)
        ok = precision > 0
        own = instrument.noise**2
        alike = _find_alike(e, ok)
        if alike.sum() > 18 and not instrument.coarse:  # steps are no noise from epoch to epoch
            trajectory = fitter.drive_trajectory((), s)
            matrix = e.history.temperature_matrix() @ instrument.mixing
            shown = trajectory + matrix @ instrument.deviation
            # the images' T, but for its level, minus the readings', K
            rest = (e.b @ d)[ok] / precision[ok] - shown[ok]
            image = 6.0 * float(np.mean(1.0 / precision[ok][1:-1][alike]))
            # between two readings, the error is smaller than a reading's and correlated
            rows = matrix[ok]
            second = (rows[2:] - 2.0 * rows[1:-1] + rows[:-2])[alike]
            share = float(second.multiply(second).sum()) / second.shape[0]
            power = _estimate_clipped_sd(np.diff(rest, 2)[alike]) ** 2 - image
            shown_by_image = power / max(share, 1e-9)
            if shown_by_image < 1.5 * own:
                weight = share / (share + 6.0)  # 1/2 if frames and readings coincide
                own = max((1.0 - weight) * own + weight * shown_by_image, 0.25 * own)
        variances.append(own)
        weights.append(float(ok.sum()))
    noise = float(np.sqrt(np.average(variances, weights=weights)))
    out = []
    for e, jump in zip(series, jumps, strict=True):
        name = e.history.reference
        old = e.thermometers[name]
        ratio = noise / old.noise
        channels = {**e.thermometers, name: replace(old, sd=old.sd * ratio, noise=noise)}
        out.append(replace(e, thermometers=channels, slope_jumps=jump))
    return out


def _slope_jumps(series: ReducedSeries, direction: Array) -> Array:
    """Return the jumps (E,) K/s of the temperature's slope, as measured by the images."""
    precision = np.einsum("p,epq,q->e", direction, series.N, direction)
    rows = np.flatnonzero(precision > 0)
    rows = rows[np.diff(series.times[rows], prepend=-np.inf) > 0]  # one epoch for each time
    out = np.zeros(len(precision))
    if len(rows) < 4:
        return out
    shown, step = (series.b @ direction)[rows] / precision[rows], np.diff(series.times[rows])
    slope = np.diff(shown) / step
    variance = (1.0 / precision[rows][1:] + 1.0 / precision[rows][:-1]) / step**2
    jump = np.abs(slope[2:] - slope[:-2])
    jump[jump**2 < _JUMP_SD**2 * (variance[2:] + variance[:-2])] = 0.0
    # at both epochs of the interval around which the slope changes
    out[rows[1:-2]] = jump
    out[rows[2:-1]] = np.maximum(out[rows[2:-1]], jump)
    return out


def sharpen_trajectories(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """Return the series linearised at the temperature estimated from readings and images together.

    None if that changes none: means of epochs have little noise, and a camera that moves measures
    no temperature.

    The readings and their errors remain the data. Noise that is left in the smoothed readings would
    bias the rates towards 0, and in their slope would seem to determine a delay.
    """
    direction = fit.direction(fit.blocks[0])[0]
    out: list[ReducedSeries | None] = []
    for s, e in enumerate(fitter.series):
        if e.blocks is not None or e.movement is not None or e.tremble is not None:
            out.append(None)
            continue
        name = e.history.reference
        old = e.thermometers[name]
        precision = np.einsum("p,epq,q->e", direction, e.N, direction)
        left = e.b - np.einsum("epq,eq->ep", e.N, fit.parameters(s))
        operator, sd = fitter.drive(fit.terms, s)[1].states, e.state_sd(name)
        # normal equations of the states and one level
        A = np.column_stack([operator, np.ones(len(operator))])
        normal = A.T @ (precision[:, None] * A)
        normal[:-1, :-1] += np.diag(1.0 / sd**2)
        right = A.T @ (left @ direction)
        right[:-1] += e.state_deviation(name) / sd**2
        state = np.zeros(len(old.sd))
        state[old.erring] = scaled_solve(normal, right, 1e-12)[:-1]
        trajectory = old.trajectory + old.mixing @ state
        new = replace(old, trajectory=trajectory, deviation=old.deviation - state)
        history = replace(e.history, readings={**e.history.readings, name: trajectory})
        out.append(replace(e, history=history, thermometers={**e.thermometers, name: new}))
    return fitter.replaced(out)


def find_poorly_read(fitter: HypothesisFitter, fit: Fit) -> list[str]:
    """Return the effects for which the thermometer is too noisy or too coarse.

    Where a delay puts the frames half-way between two readings, noise of the estimated temperature
    along its slope seems to determine the delay; half an interval later, it does not. A rate is not
    known better than the readings show it, however precisely the images, by what the parameters do
    not have in common, determine the temperature. A coarse thermometer shows neither.
    """

    def sds(terms: Sequence[Term], x: Array, at: slice) -> Array:
        normals = fitter.normal_equations(fitter.fit(terms, x, 1))[0]
        return np.asarray(np.sqrt(np.diag(scaled_inverse(normals))[at]))

    found, known = [], [e.thermometers[e.history.reference] for e in fitter.series]
    coarse = any(k.coarse for k in known)
    half = 0.5 * float(np.median(np.diff(known[0].times[known[0].real])))
    for place, (i, name) in enumerate(fit.searched, len(fit.coefficients)):
        term, at = fit.terms[i], slice(place, place + 1)
        if term.kind.nonlinear[name].role == "delay":
            later = term.with_value(name, float(dict(term.nonlinear)[name]) + half)
            terms = [later if t is term else t for t in fit.terms]
            least = _FEIGNED * sds(terms, fit.coefficients, at)
            if coarse or sds(fit.terms, fit.coefficients, at) < least:
                found.append(term.effect)
    for block in fit.blocks[1:]:
        if fit.terms[block.term].kind.follows_rate:
            at, without = slice(block.start, block.stop), fit.coefficients.copy()
            without[at] = 0.0
            least = _BY_READINGS * sds(fit.terms, without, at)
            if coarse or (sds(fit.terms, fit.coefficients, at) < least).any():
                found.append(fit.terms[block.term].effect)
    return found


def _find_alike(series: ReducedSeries, ok: Mask) -> Mask:
    """Return which rows with a result (n - 2,), without both ends, are like their neighbours.

    In a condensed series, these are means over the usual number of epochs with neighbours of the
    same kind, as shorter means are noisier.
    """
    counts = series.source.counts
    if counts is None:
        return np.ones(max(int(ok.sum()) - 2, 0), dtype=bool)
    usual = counts[ok] == np.median(counts[ok])
    return np.asarray(usual[:-2] & usual[1:-1] & usual[2:])


def _estimate_clipped_sd(values: Array) -> float:
    """Estimate the sd of a normal distribution with contaminated tails."""
    scale = float(np.sqrt(np.mean(values**2)))
    for _ in range(20):
        kept = values[np.abs(values) <= CLIPPED_AT * scale]
        scale = float(np.sqrt(np.mean(kept**2))) / CLIPPED_SD if len(kept) > 5 else scale
    return scale


def weight_slow_noise(evidence: ReducedSeries) -> ReducedSeries:
    """Return the series with weights that are correct for slow trajectories.

    Their variance over white noise is that of the common residuals of clusters of neighbouring
    targets, in combinations that are orthonormal in the mean normal matrix, corrected for the part
    that the fit absorbs, so that white noise gives 1.
    """
    k = evidence.correlation
    if k <= 1.0:
        return evidence
    M = evidence.N.mean(axis=0)
    W, good = orthonormal_combinations(M)
    trajectories = cosines(evidence.history.times, ORDERS)
    trajectories /= np.linalg.norm(trajectories, axis=1, keepdims=True)
    weights = evidence.weights[..., :2]
    v = np.nan_to_num(evidence.residuals) * weights
    mean = weights.mean(axis=0)
    total = np.zeros(M.shape)
    for rows in _group_targets(evidence):
        A = (evidence.columns[rows] @ W).reshape(-1, len(M))
        left = np.eye(len(M)) - A.T @ (A * mean[rows].reshape(-1, 1))
        pull = (trajectories @ v[:, rows].reshape(len(v), -1)) @ A
        # the residuals of a cluster do not show a combination that it alone determines
        pull = pull @ symmetric_power(left, -0.5, 0.05)
        total += pull.T @ pull / len(trajectories)
    total[~good] = 0.0
    total[:, ~good] = 0.0
    factors, turn = np.linalg.eigh(total)
    e = evidence.weighted(1.0 / k)
    return weight_jumps_down(e, factors / k, W @ turn) or e


def _group_targets(evidence: ReducedSeries) -> list[NDArray[np.int64]]:
    """Group neighbouring targets into at most 30 clusters, without dividing markers."""
    from scipy.cluster.hierarchy import fcluster, linkage

    field = evidence.source.field
    used = np.flatnonzero((evidence.weights[..., 0] > 0).any(axis=0))
    markers, member = np.unique(field.groups[used], return_inverse=True)
    middle = np.stack([field.points[used[member == g]].mean(axis=0) for g in range(len(markers))])
    count = int(np.clip(len(used) // 6, 8, 30))
    if len(middle) > count:
        label = fcluster(linkage(middle, "complete"), count, "maxclust")
    else:
        label = np.arange(len(middle))
    return [used[label[member] == g] for g in np.unique(label)]
