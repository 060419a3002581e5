"""The reduction of a series: linearisation, gross errors, offsets of targets, normal equations.

What is constant over the series says nothing about heat: one offset per target (errors of the
field's coordinates) is taken out here, together with the cameras, so that a target that is hidden
now and then is not mistaken for a drift.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.series.normals import (
    normal_matrices,
    right_hand_sides,
    sums_of_squares,
)
from thermocald.reduction.gross_errors import outlying, spikes
from thermocald.reduction.linearisation import curvature, linearised
from thermocald.reduction.random_effects import hidden_targets
from thermocald.reduction.requirements import (
    LEAST_EPOCHS,
    MIN_EPOCHS,
    MIN_TARGETS,
    no_temperature,
    require,
    require_change,
    require_for_fit,
)
from thermocald.reduction.series import ReducedSeries, SeriesInput, solve
from thermocald.reduction.thermometer import Thermometer, thermometers
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.series.normals import ObservationGrid, Partials

__all__ = ["reduce_series", "reduce_together", "reweighted", "with_points", "without_targets"]


def reduce_series(
    source: SeriesInput,
    T0: float | None = None,
    scale: Array | None = None,
    *,
    affinity: bool = True,
    strict: bool = True,
) -> ReducedSeries:
    """Check a series and reduce it.

    T0 °C: the reference temperature, by default the mean of the series; scale (19,): px per unit of
    the columns, of another series of the camera; affinity: whether C1 and C2 are free where the
    projection is linearised; strict: whether the series must carry a discovery, else only a fit.

    Raises DataError where the data cannot carry it: it says what is missing.
    """
    least = MIN_EPOCHS if strict else LEAST_EPOCHS
    if strict:
        require(source)
    else:
        require_for_fit(source)
    times = source.frame_times - source.frame_times[0]
    reading_times = source.reading_times - source.frame_times[0]
    usable = np.isfinite(reading_times)
    reading_times = reading_times[usable]
    present = {
        name: np.asarray(r, dtype=float)[usable]
        for name, r in source.readings.items()
        if np.isfinite(np.asarray(r, dtype=float)[usable]).sum() >= least
    }
    reference = next(iter(source.readings))
    if reference not in present:
        raise DataError(no_temperature(source, reference))
    noises = None
    if source.noises is not None:
        noises = {name: source.noises[name][usable] for name in present}
    knots, instruments = thermometers(reading_times, present, source.resolutions, noises)
    trajectory = instruments[reference].trajectory
    trajectory = trajectory[np.isfinite(trajectory)]
    history = History(
        times,
        knots,
        {name: c.trajectory for name, c in instruments.items()},
        reference,
        float(np.mean(trajectory)) if T0 is None else T0,
        source.polygons(),
    )
    if strict:
        require_change(source, reference, instruments[reference])
    return _reduce(source, times, history, instruments, linearised(source, affinity), scale)


def reduce_together(inputs: Sequence[SeriesInput], T0: float | None = None) -> list[ReducedSeries]:
    """Reduce series in common units; T0 is the mean of the first unless a model has one."""
    first = reduce_series(inputs[0], T0)
    out = [first, *(reduce_series(i, first.T0, first.scale) for i in inputs[1:])]
    for e in out[1:]:
        low = float(np.min(e.at.iop[0] / first.at.iop[0]))
        if not 0.9 < low < 1.1:
            raise DataError(
                f"{e.source.name}: the principal distance is {e.at.iop[0]:.3f} mm, in "
                f"{first.source.name} {first.at.iop[0]:.3f} mm: another camera, or refocused"
            )
    return out


def _reduce(
    source: SeriesInput,
    times: Array,
    history: History,
    instruments: Mapping[str, Thermometer],
    at: Partials,
    scale: Array | None,
) -> ReducedSeries:
    X = source.field.points
    A = np.concatenate([at.A, at.B * X[:, None, :]], axis=-1)
    used = source.grid.observed.any(axis=0)
    if scale is None:
        scale = np.sqrt(np.mean(np.sum(A[used] ** 2, axis=1), axis=0))
    A = A / scale
    misclosure = source.grid.points - at.predicted
    weights = source.grid.weights
    seen = source.grid.observed
    bad = spikes(misclosure, seen)
    misclosure -= curvature(source, at, source.grid.reject(bad).weights, misclosure)
    offsets = np.zeros((len(X), 2))
    for turn in range(5):
        w = source.grid.reject(bad).weights
        N = normal_matrices(w, A)
        offsets, b, values, v = _offsets_and_cameras(w, N, A, misclosure, offsets)
        if turn >= 1:
            bad = outlying(v, weights, seen, bad)
    w = source.grid.reject(bad).weights
    N = normal_matrices(w, A)
    offsets, b, values, v = _offsets_and_cameras(w, N, A, misclosure, offsets)
    lPl = sums_of_squares(w, misclosure - offsets)
    yy = np.einsum("ek,ek->e", values, b)
    count = (seen & ~bad).sum(axis=1)
    free = np.maximum(2 * count - len(scale), 1)
    # one offset per target is estimated too
    loss = 1.0 - 2 * int(used.sum()) / max(2 * int(count.sum()), 1)
    sigma0 = np.sqrt(np.maximum(lPl - yy, 0) / free / loss)
    enough = count >= MIN_TARGETS
    variance = float(np.median(sigma0[enough]) ** 2)
    v = np.where((seen & ~bad)[..., None], v, np.nan)
    weak = ~enough
    N[weak], b[weak], yy[weak], count[weak] = 0.0, 0.0, 0.0, 0
    return ReducedSeries(
        source=source,
        times=times,
        history=history,
        thermometers=instruments,
        at=at,
        scale=scale,
        columns=A,
        N=N / variance,
        b=b / variance,
        yy=yy / variance,
        values=values,
        residuals=v,
        weights=w / variance,
        offsets=offsets,
        n=count,
        sigma0=sigma0 / np.sqrt(variance),
        variance=variance,
        correlation=_slowness(v),
        gross=int(bad.sum()),
        hidden=hidden_targets(w / variance, misclosure - offsets, A),
    )


def _offsets_and_cameras(
    w: Array, N: Array, A: Array, misclosure: Array, offsets: Array
) -> tuple[Array, Array, Array, Array]:
    """Offsets (T, 2) px improved by one step, then the right-hand sides (E, k), the values (E, k)
    and the residuals (E, T, 2) px that go with them.
    """

    def cameras(offsets: Array) -> tuple[Array, Array, Array]:
        left = misclosure - offsets
        b = right_hand_sides(w, left, A)
        values = solve(N, b)
        return b, values, left - (values @ A.reshape(-1, A.shape[-1]).T).reshape(left.shape)

    _, _, v = cameras(offsets)
    offsets = offsets + _offset_change(w[..., :2], np.nan_to_num(v), N, A)
    return (offsets, *cameras(offsets))


def _offset_change(weights: Array, v: Array, N: Array, A: Array, max_iterations: int = 60) -> Array:
    """One offset per target (T, 2) that residuals v (E, T, 2) of free cameras ask for.

    Targets hidden for long pull at the cameras of the other epochs: offsets and cameras are solved
    together, by conjugate gradients on the offsets alone.
    """
    k = A.shape[-1]
    flat = A.reshape(-1, k)
    total = weights.sum(axis=0)
    inverse = 1.0 / np.where(total > 0, total, np.inf)

    def normal(p: Array) -> Array:
        camera = solve(N, (weights * p).reshape(len(N), -1) @ flat)
        return np.asarray(np.sum(weights * (p - (camera @ flat.T).reshape(v.shape)), axis=0))

    out = np.zeros(total.shape)
    r = np.sum(weights * v, axis=0)
    z = inverse * r
    p, rz = z, float(np.sum(r * z))
    for _ in range(max_iterations):
        if np.max(np.abs(z)) < 1e-5:
            break
        q = normal(p)
        pq = float(np.sum(p * q))
        if pq <= 0:
            break
        out = out + rz / pq * p
        r = r - rz / pq * q
        z = inverse * r
        p, rz = z + float(np.sum(r * z)) / rz * p, float(np.sum(r * z))
    return out


def _slowness(v: Array, lags: int = 20) -> float:
    """By how much slow variances exceed those of white noise: 1 + 2 Σ autocorrelations.

    From the residuals of all targets together; the mean of each target has been taken out.
    """
    E = len(v)
    lags = min(lags, E // 4)
    x = v - np.nan_to_num(np.nanmean(v)) if np.isfinite(v).any() else v
    filled = np.nan_to_num(x)
    there = np.isfinite(x).astype(float)
    power = float(np.sum(filled**2) / max(there.sum(), 1.0))
    total = 1.0
    for k in range(1, lags + 1):
        pairs = float(np.sum(there[k:] * there[:-k]))
        if pairs > 0 and power > 0:
            r = float(np.sum(filled[k:] * filled[:-k])) / pairs / power
            total += 2.0 * (r + 1.0 / E)
    return max(total, 1.0) if total > 1.08 else 1.0


def reweighted(evidence: ReducedSeries, noise: Array) -> ReducedSeries:
    """The same series when the measuring noise of each epoch is `noise` (E,) times the usual."""
    free = np.maximum(2.0 * evidence.n - evidence.N.shape[1], 0.0)
    level = np.sum(free * (evidence.sigma0 / noise) ** 2) / max(float(free.sum()), 1.0)
    noise = noise * np.sqrt(level)
    factor = 1.0 / noise**2
    return replace(
        evidence,
        N=evidence.N * factor[:, None, None],
        b=evidence.b * factor[:, None],
        yy=evidence.yy * factor,
        weights=evidence.weights * factor[:, None, None],
        sigma0=evidence.sigma0 / noise,
        hidden=evidence.hidden.scaled(factor) if evidence.hidden else None,
    )


def without_targets(evidence: ReducedSeries, rows: NDArray[np.int64]) -> ReducedSeries:
    """The same series as if some targets of the field had never been observed."""
    mask = np.zeros(evidence.source.grid.observed.shape, dtype=bool)
    mask[:, rows] = True
    reduced = with_points(evidence, evidence.source.grid.reject(mask))
    return replace(reduced, source=evidence.source, excluded=np.union1d(evidence.excluded, rows))


def with_points(evidence: ReducedSeries, grid: ObservationGrid) -> ReducedSeries:
    """The same series with other image points, at the same linearisation."""
    return _reduce(
        replace(evidence.source, grid=grid),
        evidence.times,
        evidence.history,
        evidence.thermometers,
        evidence.at,
        evidence.scale,
    )
