"""Noise that the images' own sigmas do not know: correlated in time, or shared by neighbours.

Correlation in time is seen in the residuals of single targets and makes slow trajectories less
certain than their number of epochs says; corners of a marker, or of a board, err slowly together,
and pull at some combinations of the parameters more than at others. Noise that neighbours share
from epoch to epoch goes into the camera's parameters; it is seen in their jumps, once the
trajectories have been explained.

Source: Liang, Zeger (1986), Biometrika 73, 13-22, for covariances from clusters that err together;
Bell, McCaffrey (2002), Survey Methodology 28, 169-181, for what the fit takes off their residuals.

A measuring noise that follows the temperature.

It is looked for in the variances of the epochs' free cameras, which no movement of the camera
touches. Source: variances as a generalised linear model, McCullagh and Nelder (1989), Generalized
Linear Models, chapter 10.

The noise of the reference thermometer as the images confirm it.

The readings' own roughness is the estimate of `thermometer`; the images follow the temperature
through the linear terms and are sharper than most thermometers, so that they can confirm it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import orthonormal_combinations, scaled_solve
from thermocald.thermal import criteria
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import detect_tremble, weight_jumps_down
from thermocald.thermal.scan import ORDERS, cosines
from thermocald.thermal.series import ReducedSeries, in_blocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.thermal.hypothesis import Fit

_JUMP_SD = 4.0  # of a slope that the images show

_LEAST = 0.005  # fraction of the noise at T0 that is left where it is coldest


@dataclass(frozen=True, eq=False)
class NoiseGrowth:
    """Noise 1 + factor (T - T0): factor per K and its sd; gain in -2 log L; noise (E,) per series.

    other_gain: of the best trajectory that is not the reference temperature (time, another
    channel).
    """

    factor: float
    sd: float
    gain: float
    other_gain: float
    other: str
    noise: tuple[Array, ...]


def noise_growth(series: Sequence[ReducedSeries]) -> NoiseGrowth | None:
    """Test whether the measuring noise follows the reference temperature; None where it does not.

    None also where another thermometer explains it better, or time does as well.

    The variances of the epochs' adjustments are χ² distributed about (1 + k (T - T0))².
    """
    data = _list_variances(series)
    temperature = [e.history.temperature() - e.T0 for e in series]
    gain = _estimate_slope(temperature, data)[1]
    others: list[tuple[float, str]] = []
    for name in series[0].history.readings:
        if name != series[0].history.reference and all(name in e.history.readings for e in series):
            trajectory = [e.history.temperature(name) for e in series]
            others.append((_estimate_slope([c - c.mean() for c in trajectory], data)[1], name))
    # two thermometers of a camera rise together: another one is in the way only where it is better
    if others and gain < max(others)[0] - criteria.CLEAR:
        return None
    time = [(e.times - e.times.mean()) / max(float(np.ptp(e.times)), 1.0) for e in series]
    by_time = _estimate_slope(time, data)[1]
    other_gain, other = max([*others, (by_time, "time")])
    if gain < criteria.GROWTH or gain < by_time + criteria.CLEAR:
        return None
    found = estimate_noise_slope(series)
    if found.gain < criteria.GROWTH:
        return None
    return replace(found, other_gain=other_gain * found.gain / gain, other=other)


def estimate_noise_slope(series: Sequence[ReducedSeries]) -> NoiseGrowth:
    """Estimate how the measuring noise follows the reference temperature, significant or not."""
    data = _list_variances(series)
    temperature = [e.history.temperature() - e.T0 for e in series]
    k, gain, sd = _estimate_slope(temperature, data)
    rough = _measure_roughness(temperature, data, k)
    noise = tuple(np.maximum(1.0 + k * t, _LEAST) for t in temperature)
    return NoiseGrowth(k, sd * float(np.sqrt(rough)), gain / rough, 0.0, "", noise)


def _list_variances(
    series: Sequence[ReducedSeries],
) -> list[tuple[NDArray[np.bool_], Array, Array]]:
    """Return of each series the epochs that count, their degrees of freedom, their variances."""
    free = [np.maximum(2.0 * e.n - e.N.shape[1], 1.0) for e in series]
    return [(e.n > 0, f, e.sigma0**2) for e, f in zip(series, free, strict=True)]


def _measure_roughness(
    trajectories: Sequence[Array], data: Sequence[tuple[NDArray[np.bool_], Array, Array]], k: float
) -> float:
    """Measure by how much the variances scatter more, and slower, than χ² does; at least 1."""
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
    """Estimate k of the noise 1 + k trajectory: k, gain in -2 log L, sd; a level per series."""
    from scipy.optimize import minimize_scalar

    def objective(k: float) -> float:
        total = 0.0
        for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
            s2 = np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
            # the targets' offsets are means over all epochs, and bring their noise into each
            s2 = s2 + (s2.mean() - s2) / len(s2)
            f = free[ok]
            level = np.sum(f * v[ok] / s2) / np.sum(f)
            total += float(np.sum(f * (np.log(s2) + np.log(level))))
        return total

    reach = max(float(np.max(np.abs(c))) for c in trajectories)
    low = min(float(np.min(c)) for c in trajectories)
    high = max(float(np.max(c)) for c in trajectories)
    bounds = (-0.995 / max(high, 1e-9), 0.995 / max(-low, 1e-9))
    start = minimize_scalar(objective, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    k = float(start.x)
    gain = objective(0.0) - float(start.fun)
    h = 0.01 / reach
    curvature = (objective(k + h) - 2 * objective(k) + objective(k - h)) / h**2
    # log variances scatter a little more than χ² does: gross errors near the limit
    sd = float(np.sqrt(2.0 / curvature)) if curvature > 0 else float("inf")
    return k, gain, sd


def calibrate_thermometers(series: Sequence[ReducedSeries]) -> list[ReducedSeries]:
    """Estimate the noise of the reference thermometer as the images confirm it.

    The images tell the temperature too, through the linear terms: with an unknown slow error, but
    sharper than most thermometers. Where a fast effect spoils that, the readings alone count. One
    thermometer has one noise.
    """
    fitter = HypothesisFitter([in_blocks(e) for e in series])
    fit = fitter.fit(())
    fitter = HypothesisFitter(series)
    d = fit.direction(fit.blocks[0])[0]
    variances, weights, jumps = [], [], []
    for s, e in enumerate(series):
        # a mount that trembles bends the trajectory too
        jumps.append(np.zeros(len(e.times)) if detect_tremble(e) else _slope_jumps(e, d))
        instrument = e.thermometers[e.history.reference]
        precision = np.einsum("p,epq,q->e", d, e.N, d)
        ok = precision > 0
        own = instrument.noise**2
        alike = _find_alike(e, ok)
        if alike.sum() > 18:
            trajectory = fitter.drive_trajectory((), s)
            matrix = e.history.temperature_matrix() @ instrument.mixing
            shown = trajectory + matrix @ instrument.deviation
            # what the image says of T beyond its level, in K
            rest = (e.b @ d)[ok] / precision[ok] - shown[ok]
            image = 6.0 * float(np.mean(1.0 / precision[ok][1:-1][alike]))
            # between two readings the error is less than that of one, and neighbours share it
            rows = matrix[ok]
            second = (rows[2:] - 2.0 * rows[1:-1] + rows[:-2])[alike]
            share = float(second.multiply(second).sum()) / second.shape[0]
            power = _estimate_clipped_sd(np.diff(rest, 2)[alike]) ** 2 - image
            shown_by_image = power / max(share, 1e-9)
            if shown_by_image < 1.5 * own:
                weight = share / (share + 6.0)  # a half where frames and readings coincide
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
    """Return by how much (E,) K/s the slope of the temperature that the images show jumps."""
    precision = np.einsum("p,epq,q->e", direction, series.N, direction)
    rows = np.flatnonzero(precision > 0)
    rows = rows[np.diff(series.times[rows], prepend=-np.inf) > 0]  # one epoch of each time
    out = np.zeros(len(precision))
    if len(rows) < 4:
        return out
    shown, step = (series.b @ direction)[rows] / precision[rows], np.diff(series.times[rows])
    slope = np.diff(shown) / step
    variance = (1.0 / precision[rows][1:] + 1.0 / precision[rows][:-1]) / step**2
    jump = np.abs(slope[2:] - slope[:-2])
    jump[jump**2 < _JUMP_SD**2 * (variance[2:] + variance[:-2])] = 0.0
    # around the interval between two epochs
    out[rows[1:-2]] = jump
    out[rows[2:-1]] = np.maximum(out[rows[2:-1]], jump)
    return out


def sharpen_trajectories(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """Take as the point of linearisation what readings and images together say of the temperature.

    The readings and their errors stay the data. A delay moves the smoothed readings along, and what
    noise the smoothing has left in their slope would pass for knowledge of it. None where no effect
    changes what drives the camera.
    """
    if not any(term.is_drive for term in fit.terms):
        return None
    direction = fit.direction(fit.blocks[0])[0]
    out = []
    for s, e in enumerate(fitter.series):
        if e.blocks is not None:
            out.append(e)
            continue
        name = e.history.reference
        old = e.thermometers[name]
        precision = np.einsum("p,epq,q->e", direction, e.N, direction)
        left = e.b - np.einsum("epq,eq->ep", e.N, fit.parameters(s))
        operator, sd = fitter.drive(fit.terms, s)[1], old.sd
        # normal equations of the states and of one level
        A = np.column_stack([operator, np.ones(len(operator))])
        normal = A.T @ (precision[:, None] * A)
        normal[:-1, :-1] += np.diag(1.0 / sd**2)
        right = A.T @ (left @ direction)
        right[:-1] += old.deviation / sd**2
        state = scaled_solve(normal, right, 1e-12)[:-1]
        trajectory = old.trajectory + old.mixing @ state
        new = replace(old, trajectory=trajectory, deviation=old.deviation - state)
        history = replace(e.history, readings={**e.history.readings, name: trajectory})
        out.append(replace(e, history=history, thermometers={**e.thermometers, name: new}))
    return out


def _find_alike(series: ReducedSeries, ok: Mask) -> Mask:
    """Find the rows with a result (n - 2,) that are like both neighbours.

    In a long series that was condensed the usual mean among its like: short means are as noisy as
    their neighbours are sharp.
    """
    counts = series.source.counts
    if counts is None:
        return np.ones(max(int(ok.sum()) - 2, 0), dtype=bool)
    usual = counts[ok] == np.median(counts[ok])
    return np.asarray(usual[:-2] & usual[1:-1] & usual[2:])


def _estimate_clipped_sd(values: Array) -> float:
    """Estimate the sd of a normal distribution whose tails are spoiled."""
    scale = float(np.sqrt(np.mean(values**2)))
    for _ in range(20):
        kept = values[np.abs(values) <= 2.2 * scale]
        scale = float(np.sqrt(np.mean(kept**2))) / 0.9162 if len(kept) > 5 else scale
    return scale


def weight_slow_noise(evidence: ReducedSeries) -> ReducedSeries:
    """Give a series the weights that its slow trajectories deserve."""
    k = evidence.correlation
    if k <= 1.0:
        return evidence
    factors, W = measure_slow_noise(evidence)
    e = evidence.weighted(1.0 / k)
    return weight_jumps_down(e, factors / k, W) or e


def measure_slow_noise(evidence: ReducedSeries) -> tuple[Array, Array]:
    """Measure the variance of slow trajectories over white noise (P,), in combinations W (P, P).

    The combinations are orthonormal under the mean normal matrix.

    From what clusters of neighbouring targets leave over together in slow trajectories; what the
    fit has taken off a cluster's residuals is put back, so that white noise gives 1.
    """
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
        left, V = np.linalg.eigh(np.eye(len(M)) - A.T @ (A * mean[rows].reshape(-1, 1)))
        pull = (trajectories @ v[:, rows].reshape(len(v), -1)) @ A
        # what a cluster determines alone cannot be told from its residuals at all
        pull = pull @ (V / np.sqrt(np.maximum(left, 0.05))) @ V.T
        total += pull.T @ pull / len(trajectories)
    total[~good] = 0.0
    total[:, ~good] = 0.0
    factors, turn = np.linalg.eigh(total)
    return factors, W @ turn


def _group_targets(evidence: ReducedSeries) -> list[NDArray[np.int64]]:
    """Group neighbouring targets of the field, markers whole: some thirty clusters."""
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
