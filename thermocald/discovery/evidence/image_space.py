"""Effects in image space: single targets that moved, and a measuring noise that grows.

They are looked for in what a free camera per epoch leaves, so that nothing the camera itself does
can pass for them, and taken out before the trajectories of parameters are examined.

Source: a step at an unknown time as Page (1955), Biometrika 42, 523-527; variances as a
generalised linear model, McCullagh and Nelder (1989), Generalized Linear Models, chapter 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.adequacy import cosines
from thermocald.reduction.reduce import without_targets

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from thermocald.reduction.series import ReducedSeries

    Array = NDArray[np.float64]

__all__ = ["Displaced", "NoiseGrowth", "displaced_targets", "noise_growth"]

_GAIN = 60.0  # χ² of a step, for 147 targets × 180 times a chance of 1e-8
_STEP_PX = 0.02
_LEAST = 0.005  # share of the noise at T0 that is left where it is coldest
_SHARE = 0.6  # of a target's slow movement that the step has to explain


@dataclass(frozen=True, eq=False)
class Displaced:
    """Targets that moved together: rows of the field, time s ± s from the series' begin,
    displacement (k, 3) mm as far as an image shows it (across the ray), sd (k, 3), step (k, 2) px.
    """

    rows: NDArray[np.int64]
    time: float
    sd_time: float
    vectors: Array
    sd_vectors: Array
    steps: Array
    gain: float


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


def _steps(evidence: ReducedSeries) -> tuple[Array, NDArray[np.int64], Array]:
    """Best step of each target: gain (T,), index of the first epoch after it, share of movement."""
    w = np.sqrt(evidence.weights[..., :2])
    r = evidence.residuals * w
    # noise may grow with heat: each epoch in units of its own spread
    own = np.array([np.nanmedian(np.abs(x)) if np.isfinite(x).any() else 1.0 for x in r])
    r = np.nan_to_num(r / np.maximum(1.4826 * own, 0.3)[:, None, None])
    there = np.isfinite(evidence.residuals[..., 0]).astype(float)
    count = np.cumsum(there, axis=0)
    total = count[-1]
    before = count[:-1]
    after = total - before
    sums = np.cumsum(r, axis=0)
    s0, s1 = sums[:-1], sums[-1] - sums[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = s1 / after[..., None] - s0 / before[..., None]
        gain = np.sum(difference**2, axis=2) * before * after / total
    gain = np.where((before >= 4) & (after >= 4), np.nan_to_num(gain), 0.0)
    best = np.argmax(gain, axis=0)
    columns = np.arange(gain.shape[1])
    top = gain[best, columns]
    # how much of all slow movement is this one step?
    slow = cosines(evidence.times, 14)
    slow = slow / np.linalg.norm(slow, axis=1, keepdims=True)
    step = (np.arange(len(r))[:, None] > best[None]).astype(float)
    mean = np.sum(r * there[..., None], axis=0) / np.maximum(total, 1)[:, None]
    high = s1[best, columns] / np.maximum(after[best, columns], 1)[:, None] - mean
    low = s0[best, columns] / np.maximum(before[best, columns], 1)[:, None] - mean
    model = np.where(step[..., None] > 0, high, low) * there[..., None]
    left = np.einsum("je,etk->jtk", slow, r - model)
    rest = np.maximum(np.sum(left**2, axis=(0, 2)) - 2 * len(slow), 0.0)
    return top, best + 1, top / np.maximum(top + rest, 1e-9)


def displaced_targets(evidence: ReducedSeries) -> tuple[list[Displaced], ReducedSeries]:
    """Targets that jumped, and the series without them.

    A marker jumps as a whole: where a few of its corners jump, it was badly seen, and is left out.
    """
    found: dict[int, tuple[int, float]] = {}
    limit = _GAIN * evidence.correlation
    cleaned = evidence
    for _ in range(8):
        gain, first, share = _steps(cleaned)
        w = cleaned.weights[..., 0]
        sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
        there = np.isfinite(cleaned.residuals[..., 0]).sum(axis=0)
        size = 2.0 * sigma * np.sqrt(gain / np.maximum(there, 1))
        # real targets have a life of their own: what many of them do is no displacement
        common = 8.0 * float(np.percentile(gain[there > 0], 85)) if (there > 0).any() else 0.0
        top = float(gain.max(initial=0.0))
        # one moved target drags the camera and with it all others: the largest go first
        chosen = np.flatnonzero(
            (gain > max(limit, common, 0.3 * top)) & (share > _SHARE) & (size > _STEP_PX)
        )
        if not len(chosen):
            break
        for row in chosen:
            found[int(row)] = (int(first[row]), float(gain[row]))
        if len(found) > 0.2 * evidence.source.grid.observed.any(axis=0).sum():
            return [], evidence  # so many do not jump by themselves: it is the camera
        cleaned = without_targets(evidence, _with_their_markers(evidence, found))
    if not found:
        return [], evidence
    whole = _whole_markers(evidence, found)
    return _grouped(cleaned, whole) if whole else [], cleaned


def _with_their_markers(evidence: ReducedSeries, found: Iterable[int]) -> NDArray[np.int64]:
    groups = evidence.source.field.groups
    return np.flatnonzero(np.isin(groups, groups[sorted(found)]))


def _whole_markers(
    evidence: ReducedSeries, found: dict[int, tuple[int, float]]
) -> dict[int, tuple[int, float]]:
    """The jumps without those that other corners of their marker did not make with them."""
    groups = evidence.source.field.groups
    seen = evidence.source.grid.observed.any(axis=0)
    out = {}
    for row, (first, gain) in found.items():
        corners = np.flatnonzero((groups == groups[row]) & seen)
        together = [r for r in corners.tolist() if r in found and abs(found[r][0] - first) <= 1]
        if 4 * len(together) >= 3 * len(corners):
            out[row] = (first, gain)
    return out


def _grouped(cleaned: ReducedSeries, found: dict[int, tuple[int, float]]) -> list[Displaced]:
    """Measure the steps against the camera that the other targets give; one group per time."""
    rows = np.array(sorted(found))
    A = cleaned.columns[rows]
    misclosure = cleaned.source.grid.points[:, rows] - cleaned.at.predicted[rows]
    v = misclosure - np.einsum("ek,tik->eti", cleaned.values, A)
    w = cleaned.weights[..., 0]
    sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
    v = np.where(np.abs(v - np.nanmedian(v, axis=0)).max(axis=2, keepdims=True) < 1e6, v, np.nan)
    firsts = np.array([_best_step(v[:, k]) for k in range(len(rows))])
    groups: list[list[int]] = []
    for k in np.argsort(firsts):
        if groups and firsts[k] - firsts[groups[-1][-1]] <= 1:
            groups[-1].append(int(k))
        else:
            groups.append([int(k)])
    out = []
    for group in groups:
        first = int(np.median(firsts[group]))
        steps, vectors, sds = [], [], []
        for k in group:
            b, a = v[:first, k], v[first:, k]
            b, a = b[np.isfinite(b[:, 0])], a[np.isfinite(a[:, 0])]
            step = np.median(a, axis=0) - np.median(b, axis=0)
            variance = (np.pi / 2) * sigma**2 * (1 / max(len(a), 1) + 1 / max(len(b), 1))
            B = cleaned.at.B[rows[k]]
            inverse = np.linalg.pinv(B)
            steps.append(step)
            vectors.append(inverse @ step)
            sds.append(np.sqrt(np.diag(inverse @ inverse.T) * variance))
        t = cleaned.times
        out.append(
            Displaced(
                rows[group],
                float(0.5 * (t[first - 1] + t[first])),
                float((t[first] - t[first - 1]) / np.sqrt(12.0)),
                np.array(vectors),
                np.array(sds),
                np.array(steps),
                sum(found[int(rows[k])][1] for k in group),
            )
        )
    return out


def _best_step(v: Array) -> int:
    """First epoch after the step of one target (E, 2); gross errors clipped."""
    there = np.isfinite(v[:, 0])
    x = np.where(there[:, None], v, 0.0)
    spread = np.nanmedian(np.abs(np.diff(v[there], axis=0))) * 6 + 1e-9
    low, high = np.nanpercentile(v[there], [3, 97], axis=0)
    x = np.clip(x, low - spread, high + spread) * there[:, None]
    n0 = np.cumsum(there)[:-1].astype(float)
    n1 = there.sum() - n0
    s = np.cumsum(x, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        d = (s[-1] - s[:-1]) / n1[:, None] - s[:-1] / n0[:, None]
        gain = np.nan_to_num(np.sum(d**2, axis=1) * n0 * n1)
    return int(np.argmax(gain)) + 1


def noise_growth(series: Sequence[ReducedSeries]) -> NoiseGrowth | None:
    """Does the measuring noise follow the reference temperature? None where it does not change.

    The variances of the epochs' adjustments are χ² distributed about (1 + k (T - T0))².
    """
    data = []
    for e in series:
        ok = e.n > 0
        free = np.maximum(2.0 * e.n - e.N.shape[1], 1.0)
        data.append((ok, free, e.sigma0**2))
    temperature = [e.history.temperature() - e.T0 for e in series]
    k, gain, sd = _slope(temperature, data)
    others: list[tuple[float, str]] = []
    for name in series[0].history.readings:
        if name != series[0].history.reference and all(name in e.history.readings for e in series):
            trajectory = [e.history.temperature(name) for e in series]
            others.append((_slope([c - c.mean() for c in trajectory], data)[1], name))
    time = [(e.times - e.times.mean()) / max(float(np.ptp(e.times)), 1.0) for e in series]
    others.append((_slope(time, data)[1], "time"))
    other_gain, other = max(others)
    if gain < 40.0 or gain < other_gain + 10.0:
        return None
    rough = _roughness(temperature, data, k)
    gain, other_gain, sd = gain / rough, other_gain / rough, sd * float(np.sqrt(rough))
    if gain < 40.0:
        return None
    noise = tuple(np.maximum(1.0 + k * t, _LEAST) for t in temperature)
    return NoiseGrowth(k, sd, gain, other_gain, other, noise)


def _roughness(
    trajectories: Sequence[Array], data: Sequence[tuple[NDArray[np.bool_], Array, Array]], k: float
) -> float:
    """By how much the variances scatter more, and slower, than χ² lets them; at least 1."""
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


def _slope(
    trajectories: Sequence[Array],
    data: Sequence[tuple[NDArray[np.bool_], Array, Array]],
) -> tuple[float, float, float]:
    """k, gain in -2 log L, and sd of k for the noise 1 + k trajectory, with a level per series."""
    from scipy.optimize import minimize_scalar

    def objective(k: float) -> float:
        total = 0.0
        for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
            s2 = np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
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
