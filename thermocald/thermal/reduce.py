"""The reduction of a series: linearisation, gross errors, offsets of targets, normal equations.

A recording is first checked for what a discovery or a fit requires; an error states what is
missing.

Whatever is constant over the series has no information about heat. One offset per target (from
errors of the field's coordinates) is eliminated together with the cameras, so that a target that is
hidden now and then is not mistaken for a drift.

Gross errors are detected in time: a target leaps away from its own neighbours.

The series is linearised at one camera, adjusted to its mean image. The partial derivatives of the
normal equations refer to this camera, so that its errors become errors of the rates; it is as
precise as the mean image. If the distortion follows the angle, the image is linear in the principal
distance.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust, cold_start
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.field.testfield import FAR_ELSEWHERE, Observations, find_misplaced
from thermocald.photogrammetry.linalg import MAD_TO_SD, median_known, orthonormal_combinations
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    Partials,
    linearise,
    normal_matrices,
    often_shown,
    right_hand_sides,
    sums_of_squares,
)
from thermocald.physics.history import History
from thermocald.thermal import criteria
from thermocald.thermal.series import (
    ReducedSeries,
    SeriesInput,
    group_hidden_targets,
    scaled_basis,
    solve,
)
from thermocald.thermal.thermometer import Thermometer, thermometers

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.physics.model import Distortion


def require(source: SeriesInput, strict: bool) -> None:
    """Raise DataError if temperature, epochs, duration or field do not suffice for a discovery.

    Without `strict`, they need only suffice for the fit of a thermal model.
    """
    if not source.readings:
        raise DataError(
            f"{source.name}: the recording has no temperature column. Discovery compares the "
            "camera with a thermometer; record one"
            if strict
            else f"{source.name}: has no temperature column; a thermal model needs one"
        )
    seen = source.grid.observed.sum(axis=1)
    if not strict:
        if np.sum(seen >= criteria.MIN_TARGETS) < criteria.LEAST_EPOCHS:
            raise DataError(
                f"{source.name}: fewer than {criteria.LEAST_EPOCHS} epochs show "
                f"{criteria.MIN_TARGETS} targets or more"
            )
        return
    reference = next(iter(source.readings))
    good = int(np.sum(seen >= criteria.MIN_TARGETS))
    if good < criteria.MIN_EPOCHS:
        raise DataError(
            f"{source.name}: {good} of {len(seen)} epochs have {criteria.MIN_TARGETS} targets or "
            f"more; discovery needs {criteria.MIN_EPOCHS} such epochs, better 100"
        )
    if np.isfinite(source.readings[reference]).sum() < criteria.MIN_EPOCHS:
        raise _no_temperature(source, reference)
    duration = float(source.frame_times[-1] - source.frame_times[0])
    if duration < criteria.MIN_DURATION:
        raise DataError(
            f"{source.name}: the recording lasts {duration:.0f} s; heat needs minutes to reach a "
            "camera, and a faster movement is not a thermal effect. Record at least "
            f"{criteria.MIN_DURATION:.0f} s, better half an hour"
        )
    rows = source.grid.observed.any(axis=0)
    if plane_fit(source.field.points[rows])[2]:
        raise DataError(
            f"{source.name}: the {int(rows.sum())} targets seen lie in one plane; principal point "
            "and tilt cannot be separated on it. Use a field with depth, such as a corner"
        )


def _no_temperature(source: SeriesInput, reference: str) -> DataError:
    """Make the error for a reference temperature with too few readings."""
    return DataError(
        f"{source.name}: the recording has no temperature: the column {reference!r} holds fewer "
        f"than {criteria.MIN_EPOCHS} readings. Record the camera's temperature with its frames"
    )


_HALF = 2  # neighbours on either side
_AROUND = 4  # changes on either side of a touch that show how the camera moves otherwise
_LAGS = 20  # epochs, of autocorrelations
_ITERATIONS = 60  # of conjugate gradients
_TURNS = 5  # of the search for outliers


def running_median(values: Array, half: int, *, itself: bool = True) -> Array:
    """Return the running median over 2 half + 1 epochs, along the first axis, ignoring NaN.

    itself: whether the epoch itself is among them.
    """
    known = np.where(np.isfinite(values), values, np.inf)
    padded = np.pad(known, ((half, half), (0, 0), (0, 0)), constant_values=np.inf)
    near = [padded[k : k + len(values)] for k in range(2 * half + 1) if itself or k != half]
    ordered, least = np.stack(near), np.empty_like(known)
    for last in range(len(near) - 1, 0, -1):  # whole arrays are sorted faster than each epoch
        for low, high in pairwise(ordered[: last + 1]):
            np.minimum(low, high, out=least)
            np.maximum(low, high, out=high)
            low[...] = least
    out = 0.5 * (ordered[(len(near) - 1) // 2] + ordered[len(near) // 2])
    few = np.isinf(ordered[-1])
    some = ordered[:, few]
    out[few] = median_known(np.where(np.isinf(some), np.nan, some))
    return np.asarray(out)


def find_spikes(misclosure: Array, seen: Mask) -> Mask:
    """Find points (E, T) that leap away from their own neighbours in time while others do not.

    This precedes any adjustment, in which a gross error of many pixels would mask itself and
    others.
    """
    # without the epoch itself: in a steady movement it would be its own median, and the usual
    # deviation would be zero
    d = misclosure - running_median(misclosure, _HALF, itself=False)
    d -= median_known(d, 1)[:, None]  # the whole image may move
    own = MAD_TO_SD * median_known(np.abs(d).reshape(len(d), -1), 1)
    size = np.max(np.abs(np.nan_to_num(d)), axis=2)
    finite = own[np.isfinite(own)]
    level = float(np.median(finite)) if len(finite) else 0.0
    limit = criteria.SPIKE * np.fmax(np.nan_to_num(own), level)
    return np.asarray(seen & (size > limit[:, None]))


def find_outliers(v: Array, weights: Array, seen: Mask, bad: Mask) -> Mask:
    """Find points (E, T) with residuals v (E, T, 2) px far from their neighbours' in time.

    bad: the points found so far, which are ignored. As noise may grow with heat, the limit is
    relative to the epoch's own spread, or to the series' if that is larger.
    """
    root = np.sqrt(weights[..., :2])
    kept = np.where((seen & ~bad)[..., None], np.abs(np.nan_to_num(v)) * root, np.nan)
    own = MAD_TO_SD * median_known(kept.reshape(len(kept), -1), 1)
    around = running_median(np.where(bad[..., None], np.nan, v), _HALF)
    size = np.max(np.abs(np.nan_to_num(v - around)) * root, axis=2)
    level = MAD_TO_SD * float(np.median(kept[np.isfinite(kept)]))
    limit = criteria.GROSS * np.fmax(np.nan_to_num(own), level)
    return np.asarray(seen & (size > limit[:, None]))


def find_touches(movement: Array) -> Mask:
    """Find the epochs (E,) in which the camera was elsewhere, as a tripod is that someone touches.

    movement (E, m): in units of its noise. The camera leaves and is back after at most
    `criteria.BRIEF` epochs, both by far more than the epochs around move; what heat moves does not.
    What happens often is no touch.
    """
    touched = np.zeros(len(movement), dtype=bool)
    changes = np.diff(movement, axis=0)
    for brief in range(1, criteria.BRIEF + 1):
        length = 2 * _AROUND + brief + 1
        if len(changes) < length:
            break
        window = np.lib.stride_tricks.sliding_window_view(changes, length, axis=0)
        away = slice(_AROUND, _AROUND + brief + 1)
        near = np.delete(window, away, axis=2)
        drift = np.median(near, axis=2, keepdims=True)
        usual = np.linalg.norm(near - drift, axis=1).max(axis=1)
        inside = window[..., away] - drift
        leaps = np.linalg.norm(inside[..., [0, -1]], axis=1).min(axis=1)
        back = np.linalg.norm(inside.sum(axis=2), axis=1) < 0.5 * leaps
        found = leaps > criteria.TOUCH * np.maximum(usual, np.sqrt(2.0 * movement.shape[1]))
        for first in np.flatnonzero(found & back) + _AROUND + 1:
            touched[first : first + brief] = True
    often = touched.sum() > max(criteria.BRIEF, criteria.SELDOM * len(touched))
    return np.zeros_like(touched) if often else touched


_MEAN_IMAGE_PX, _SHARPEST_PX = 0.1, 1e-4  # standard deviation of the mean image's points


def _make_settings(source: SeriesInput, names: tuple[str, ...]) -> AdjustmentSettings:
    """Return settings that free some interior parameters, with priors near zero for weak ones."""
    c = source.principal_distance or source.sensor.width * source.sensor.pixel_pitch
    spreads = (0.3 / c**2, 0.3 / c**4, 0.3 / c**6, 0.02 / c, 0.02 / c, 0.02, 0.02)
    priors = {n: (0.0, sd) for n, sd in zip(IOP_NAMES[3:], spreads, strict=True) if n in names}
    return AdjustmentSettings(names, priors, max_rejected=0.9, correlation_bound=None)


def linearise_series(source: SeriesInput) -> Partials:
    """Linearise a series at the camera that is adjusted to its mean image."""
    mean = median_known(source.grid.points)
    # the orientation uses targets that are in at least half of the epochs with any
    looked = int(source.grid.observed.any(axis=1).sum())
    often = source.grid.observed.sum(axis=0) >= 0.5 * max(looked, 1)
    rows = np.flatnonzero(np.isfinite(mean[:, 0]) & often)
    seen = Observations(rows, mean[rows], np.full((len(rows), 2), _MEAN_IMAGE_PX))
    # all parameters first: with C1 and C2 fixed, the principal point absorbs them, and the partials
    # are those of another camera; but for a single wall, all together may not converge
    settings, held = _make_settings(source, IOP_NAMES), _make_settings(source, IOP_NAMES[:-2])
    c = source.principal_distance
    found = cold_start(source.sensor, source.field, seen, settings, c)
    if found.interior is None:
        found = cold_start(source.sensor, source.field, seen, held, c, source.interior)
    if found.interior is None or found.exterior is None:
        raise DataError(
            f"{source.name}: the camera cannot be oriented on its mean image: {found.reason}"
        )
    # with the actual precision, or the weak priors would bias the camera: 1e-4 of a year's rates
    rejected = np.isin(seen.targets, found.rejected)
    left = float(np.sqrt(np.mean(np.square(found.residuals[~rejected]))))
    sigmas = np.full((len(rows), 2), np.clip(left, _SHARPEST_PX, _MEAN_IMAGE_PX))
    better = adjust(
        source.sensor, source.field, replace(seen, sigmas=sigmas), found.interior, found.exterior,
        replace(settings, snooping_alpha=0.0), rejected,
    )  # fmt: skip
    if better.interior is not None and better.exterior is not None:
        found = better
    return linearise(source.sensor, source.field, found.values[:10], found.values[10:])


def reduce_series(
    source: SeriesInput,
    T0: float | None = None,
    scale: Array | None = None,
    *,
    strict: bool = True,
) -> ReducedSeries:
    """Check a series and reduce it.

    T0 °C: the reference temperature, by default the mean of the series; scale (19,): px per unit of
    the columns, of another series of the camera; strict: whether the series must suffice for a
    discovery, not only for a fit.

    Raises DataError, which states what is missing, if the data do not suffice.
    """
    least = criteria.MIN_EPOCHS if strict else criteria.LEAST_EPOCHS
    require(source, strict)
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
        raise _no_temperature(source, reference)
    noises = source.noises and {name: source.noises[name][usable] for name in present}
    knots, instruments = thermometers(reading_times, present, source.resolutions, noises)
    # without the knots on curves between readings
    known = instruments[reference]
    trajectory = known.trajectory[known.erring]
    trajectory = trajectory[np.isfinite(trajectory)]
    history = History(
        times, knots, {name: c.trajectory for name, c in instruments.items()}, reference,
        float(np.mean(trajectory)) if T0 is None else T0, source.polygons(),
    )  # fmt: skip
    change = float(np.ptp(trajectory))
    least_change = max(criteria.LEAST_CHANGE_K, criteria.LEAST_CHANGE * known.noise)
    if strict and change < least_change:
        raise DataError(
            f"{source.name}: the temperature {reference!r} is constant within "
            f"{change:.2f} K; thermal effects cannot be separated from others. "
            "Record a series in which it changes by 5 K or more"
        )
    at = linearise_series(source)
    offsets = mean_misclosure(source, at)
    bad = find_misplaced(offsets, at.iop[0] / source.sensor.pixel_pitch, FAR_ELSEWHERE)
    if bad.any():
        source = replace(source, grid=source.grid.reject(source.grid.observed & bad))
    return _reduce(source, times, history, instruments, at, scale)


def mean_misclosure(source: SeriesInput, at: Partials) -> Array:
    """Return each target's misclosure (T, 2) px against the mean camera."""
    return often_shown(source.grid.points - at.predicted)  # points without weight included


def reduce_together(inputs: Sequence[SeriesInput], T0: float | None = None) -> list[ReducedSeries]:
    """Reduce series in common units; T0 °C is by default the mean of the first series."""
    first = reduce_series(inputs[0], T0)
    out = [first, *(reduce_series(i, first.T0, first.scale) for i in inputs[1:])]
    for e in out[1:]:
        if not 0.9 < e.at.iop[0] / first.at.iop[0] < 1.1:
            raise DataError(
                f"{e.source.name}: the principal distance is {e.at.iop[0]:.3f} mm, in "
                f"{first.source.name} {first.at.iop[0]:.3f} mm: another camera, or refocused"
            )
    return out


def _reduce(
    source: SeriesInput, times: Array, history: History, instruments: Mapping[str, Thermometer],
    at: Partials, scale: Array | None, distortion: Distortion = "angle",
) -> ReducedSeries:  # fmt: skip
    X = source.field.points
    A = np.concatenate([at.A, at.B * X[:, None, :]], axis=-1)
    used = source.grid.observed.any(axis=0)
    if scale is None:
        scale = np.sqrt(np.mean(np.sum(A[used] ** 2, axis=1), axis=0))
    A = (A / scale) @ scaled_basis(at.iop, scale, distortion)
    misclosure = source.grid.points - at.predicted
    weights = source.grid.weights
    seen = source.grid.observed
    bad = find_spikes(misclosure, seen)
    offsets = np.zeros((len(X), 2))
    for turn in range(_TURNS):
        w = source.grid.reject(bad).weights
        N = normal_matrices(w, A)
        v = _solve_cameras(w, N, A, misclosure - offsets)[2]
        offsets = offsets + _solve_offsets(w[..., :2], np.nan_to_num(v), N, A)
        b, values, v = _solve_cameras(w, N, A, misclosure - offsets)
        found = find_outliers(v, weights, seen, bad) if turn + 1 < _TURNS else bad
        if np.array_equal(found, bad):
            break
        bad = found
    lPl = sums_of_squares(w, misclosure - offsets)
    yy = np.einsum("ek,ek->e", values, b)
    count = (seen & ~bad).sum(axis=1)
    free = np.maximum(2 * count - len(scale), 1)
    # one offset per target is estimated too
    loss = 1.0 - 2 * int(used.sum()) / max(2 * int(count.sum()), 1)
    sigma0 = np.sqrt(np.maximum(lPl - yy, 0) / free / loss)
    enough = count >= criteria.MIN_TARGETS
    if not enough.any():
        raise DataError(
            f"{source.name}: without gross errors, no epoch has {criteria.MIN_TARGETS} targets or "
            "more; use a field with more targets in the image"
        )
    variance = float(np.median(sigma0[enough]) ** 2)
    v = np.where((seen & ~bad)[..., None], v, np.nan)
    mean = N[enough].mean(axis=0) / variance
    W, good = orthonormal_combinations(mean)
    touched = np.zeros(len(N), dtype=bool)
    touched[enough] = find_touches(values[enough] @ mean @ W[:, good])
    weak = ~enough | touched
    N[weak], b[weak], yy[weak], count[weak], w[weak], v[weak] = 0.0, 0.0, 0.0, 0, 0.0, np.nan
    return ReducedSeries(
        source=source, times=times, history=history, thermometers=instruments, at=at, scale=scale,
        columns=A, N=N / variance, b=b / variance,
        yy=yy / variance, values=values, residuals=v, weights=w / variance, n=count,
        sigma0=sigma0 / np.sqrt(variance), variance=variance, correlation=_measure_correlation(v),
        hidden=group_hidden_targets(w / variance, misclosure - offsets, A), distortion=distortion,
        touched=touched,
    )  # fmt: skip


def _solve_cameras(w: Array, N: Array, A: Array, left: Array) -> tuple[Array, Array, Array]:
    """Return right-hand sides (E, k), values (E, k) and residuals (E, T, 2) px of free cameras."""
    b = right_hand_sides(w, left, A)
    values = solve(N, b)
    return b, values, left - (values @ A.reshape(-1, A.shape[-1]).T).reshape(left.shape)


def _solve_offsets(weights: Array, v: Array, N: Array, A: Array) -> Array:
    """Solve for one offset per target (T, 2) from residuals v (E, T, 2) of free cameras.

    As targets that are hidden for long bias the cameras, offsets and cameras are solved together,
    by conjugate gradients on the offsets alone.
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
    for _ in range(_ITERATIONS):
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


def _measure_correlation(v: Array) -> float:
    """Return the variance of slow noise over white noise: 1 + 2 Σ autocorrelations.

    The residuals of all targets are used together; their means have been removed as offsets.
    """
    E = len(v)
    lags = min(_LAGS, E // 4)
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


def reweight(evidence: ReducedSeries, noise: Array) -> ReducedSeries:
    """Return the series weighted for a measuring noise that is `noise` (E,) times the usual."""
    free = np.maximum(2.0 * evidence.n - evidence.N.shape[1], 0.0)
    level = np.sum(free * (evidence.sigma0 / noise) ** 2) / max(float(free.sum()), 1.0)
    noise = noise * np.sqrt(level)
    factor = 1.0 / noise**2
    return replace(
        evidence.weighted(factor),
        weights=evidence.weights * factor[:, None, None],
        sigma0=evidence.sigma0 / noise,
    )


def without_targets(evidence: ReducedSeries, rows: NDArray[np.int64]) -> ReducedSeries:
    """Reduce the series as if some targets of the field, by their rows, had not been observed."""
    mask = np.zeros(evidence.source.grid.observed.shape, dtype=bool)
    mask[:, rows] = True
    reduced = with_points(evidence, evidence.source.grid.reject(mask))
    return replace(reduced, source=evidence.source, excluded=np.union1d(evidence.excluded, rows))


def with_points(evidence: ReducedSeries, grid: ObservationGrid) -> ReducedSeries:
    """Reduce the series with other image points, at the same linearisation."""
    return _reduce(
        replace(evidence.source, grid=grid), evidence.times, evidence.history,
        evidence.thermometers, evidence.at, evidence.scale, evidence.distortion,
    )  # fmt: skip
