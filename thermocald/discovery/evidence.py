"""The evidence of one series: every epoch reduced to small normal equations, once.

The unknowns of an epoch are the 16 parameters of the camera and three scales of the test field.
What is constant over the series says nothing about heat: the level of every parameter and one
offset per target (errors of the field's coordinates) are taken out here, so that a target that is
hidden now and then does not pass for a drift. After that a hypothesis about the whole series is
a sum over 19 × 19 matrices and no image point is touched again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.thermometer import Channel, extend, latent_times, smooth_channel
from thermocald.errors import DataError
from thermocald.photogrammetry.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
)
from thermocald.photogrammetry.orientation import approximate_orientation, plane_fit
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.photogrammetry.camera_model import Sensor
    from thermocald.photogrammetry.normals import Partials
    from thermocald.photogrammetry.testfield import TestField

    Array = NDArray[np.float64]

__all__ = [
    "COLUMNS",
    "FIELD_SCALES",
    "Blocks",
    "Evidence",
    "SeriesInput",
    "condensed",
    "gather",
    "reweighted",
    "without_targets",
]

FIELD_SCALES = ("scale_X", "scale_Y", "scale_Z")
COLUMNS = PARAMETER_NAMES + FIELD_SCALES
_GROSS = 4.5  # standard deviations beyond which a point is a gross error
_MIN_EPOCHS = 20
_MIN_TARGETS = 12
_MIN_DURATION = 120.0  # s


@dataclass(frozen=True, eq=False)
class SeriesInput:
    """What was recorded.

    frame_times (E,) s; reading_times (R,) s; readings {channel: (R,)} °C, the first the reference;
    resolutions {channel: K or None}; grid: image points on epochs × targets; numbers (E,): the
    epochs' own numbers.
    """

    name: str
    camera: str
    sensor: Sensor
    field: TestField
    principal_distance: float | None
    frame_times: Array
    reading_times: Array
    readings: Mapping[str, Array]
    resolutions: Mapping[str, float | None]
    grid: ObservationGrid
    numbers: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Neighbouring epochs of a long series as one row.

    average (B, E): weights of the epochs in each block; pool (K, S): knots to states, the readings
    of a block being one; within_free: degrees of freedom of the epochs about their blocks.
    """

    average: csr_array
    pool: csr_array
    within_free: float

    def pooled_mean(self, values: Array) -> Array:
        """Mean over the knots of each state."""
        return np.asarray((self.pool.T @ values) / self.pool.sum(axis=0))

    def pooled_sd(self, sd: Array) -> Array:
        """Standard deviation of the mean over the knots of each state."""
        return np.asarray(np.sqrt(self.pool.T @ sd**2) / self.pool.sum(axis=0))


@dataclass(frozen=True, eq=False)
class Evidence:
    """One series, reduced.

    times (E,) s from its begin; history: smoothed readings; channels: as instruments;
    at: linearisation; scale (19,): px per unit of each column, N (E, 19, 19) and b (E, 19) are in
    px-scaled columns and weighted by the noise found; yy (E,): bᵀN⁻¹b; values (E, 19): the free
    camera of each epoch, scaled; residuals (E, T, 2) px: what the free camera leaves, offsets taken
    out, NaN where unseen or gross; n (E,) image points; sigma0 (E,); variance: factor by which the
    given variances were too small.
    """

    source: SeriesInput
    times: Array
    history: History
    channels: Mapping[str, Channel]
    at: Partials
    scale: Array
    N: Array
    b: Array
    yy: Array
    values: Array
    residuals: Array
    weights: Array
    offsets: Array
    n: NDArray[np.int64]
    sigma0: Array
    variance: float
    correlation: float
    gross: int
    excluded: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    columns: Array = field(default_factory=lambda: np.zeros(0))
    blocks: Blocks | None = None

    def states(self, channel: str, operator: csr_array) -> Array:
        """∂ course / ∂ knots (epochs, K), sparse → ∂ course / ∂ independent errors, dense."""
        result = operator @ self.channels[channel].mixing
        if self.blocks is not None:
            result = self.blocks.average @ result @ self.blocks.pool
        return np.asarray(result.toarray())

    def state_sd(self, channel: str) -> Array:
        """Standard deviations of the independent errors, K."""
        sd = self.channels[channel].sd
        return sd if self.blocks is None else self.blocks.pooled_sd(sd)

    def state_deviation(self, channel: str) -> Array:
        """Readings minus smooth course as far as the independent errors hold it, K."""
        deviation = self.channels[channel].deviation
        return deviation if self.blocks is None else self.blocks.pooled_mean(deviation)

    def averaged(self, course: Array) -> Array:
        """A course (epochs, …) on the rows of the normal equations."""
        return course if self.blocks is None else np.asarray(self.blocks.average @ course)

    @property
    def T0(self) -> float:
        return self.history.T0

    @property
    def dof(self) -> float:
        """Image coordinates that the free cameras do not use up."""
        return float(np.sum(2 * self.n - self.N.shape[1]))


def gather(source: SeriesInput, T0: float | None = None, scale: Array | None = None) -> Evidence:
    """Check a series and reduce it; `T0` and `scale` are M1's for M2.

    Raises DataError where the data cannot carry a discovery: it says what is missing.
    """
    _require(source)
    times = source.frame_times - source.frame_times[0]
    reading_times = source.reading_times - source.frame_times[0]
    usable = np.isfinite(reading_times)
    reading_times = reading_times[usable]
    present = {
        name: np.asarray(r, dtype=float)[usable]
        for name, r in source.readings.items()
        if np.isfinite(np.asarray(r, dtype=float)[usable]).sum() >= _MIN_EPOCHS
    }
    reference = next(iter(source.readings))
    if reference not in present:
        raise DataError(_no_temperature(source, reference))
    knots, channels = _instruments(reading_times, present, source.resolutions)
    course = channels[reference].course
    course = course[np.isfinite(course)]
    history = History(
        times,
        knots,
        {name: c.course for name, c in channels.items()},
        reference,
        float(np.mean(course)) if T0 is None else T0,
    )
    if float(np.ptp(course)) < max(1.0, 8.0 * channels[reference].noise):
        raise DataError(
            f"{source.name}: the temperature {reference!r} is constant within "
            f"{float(np.ptp(course)):.2f} K; what follows it cannot be told from what does not. "
            "Record a series in which it changes by 5 K or more"
        )
    return _reduce(source, times, history, channels, scale)


def _instruments(
    times: Array, readings: Mapping[str, Array], resolutions: Mapping[str, float | None]
) -> tuple[Array, dict[str, Channel]]:
    """All columns on common knots: the readings' instants and the latent ones of each column."""
    latent = {name: latent_times(times, r, resolutions.get(name)) for name, r in readings.items()}
    knots, first = np.unique(np.concatenate([times, *latent.values()]), return_index=True)
    from_reading = first < len(times)
    channels = {}
    for name, r in readings.items():
        on_knots = np.full(len(knots), np.nan)
        on_knots[from_reading] = r[first[from_reading]]
        own = np.isin(knots, latent[name])
        here = from_reading | own
        part = smooth_channel(knots[here], on_knots[here], own[here], resolutions.get(name))
        channels[name] = extend(_spread(part, knots, here))
    return next(iter(channels.values())).times, channels


def _spread(channel: Channel, knots: Array, here: NDArray[np.bool_]) -> Channel:
    """A column's instrument on all knots; those of other columns are NaN and carry nothing."""
    from scipy.sparse import csr_array

    K, rows = len(knots), np.flatnonzero(here)
    course, deviation, sd = np.full(K, np.nan), np.zeros(K), np.full(K, 1e-6)
    real = np.zeros(K, dtype=bool)
    course[here], deviation[here], sd[here] = channel.course, channel.deviation, channel.sd
    real[here] = channel.real
    part = channel.mixing.tocoo()
    others = np.flatnonzero(~here)
    mixing = csr_array(
        (
            np.concatenate([part.data, np.ones(len(others))]),
            (
                np.concatenate([rows[part.row], others]),
                np.concatenate([rows[part.col], others]),
            ),
        ),
        shape=(K, K),
    )
    return Channel(knots, course, deviation, sd, mixing, real, channel.noise)


def _no_temperature(source: SeriesInput, reference: str) -> str:
    return (
        f"{source.name}: the recording has no temperature: the column {reference!r} holds fewer "
        f"than {_MIN_EPOCHS} readings. Discovery compares the camera with a thermometer; record one"
    )


def _require(source: SeriesInput) -> None:
    if not source.readings:
        raise DataError(
            f"{source.name}: the recording has no temperature column. Discovery compares the "
            "camera with a thermometer; record one"
        )
    reference = next(iter(source.readings))
    if np.isfinite(source.readings[reference]).sum() < _MIN_EPOCHS and (
        len(source.frame_times) >= _MIN_EPOCHS
    ):
        raise DataError(_no_temperature(source, reference))
    seen = source.grid.observed.sum(axis=1)
    good = int(np.sum(seen >= _MIN_TARGETS))
    if good < _MIN_EPOCHS:
        raise DataError(
            f"{source.name}: {good} of {len(seen)} epochs have {_MIN_TARGETS} targets or more; "
            f"discovery needs {_MIN_EPOCHS} such epochs, better 100"
        )
    duration = float(source.frame_times[-1] - source.frame_times[0])
    if duration < _MIN_DURATION:
        raise DataError(
            f"{source.name}: the recording lasts {duration:.0f} s; heat needs minutes to reach a "
            f"camera, and what moves faster is no thermal effect. Record {_MIN_DURATION:.0f} s at "
            "least, better half an hour"
        )
    rows = source.grid.observed.any(axis=0)
    if plane_fit(source.field.points[rows])[2]:
        raise DataError(
            f"{source.name}: the {int(rows.sum())} targets seen lie in one plane; principal point "
            "and tilt cannot be told apart on it. Use a field with depth, such as a corner"
        )


def _running_median(values: Array, width: int = 5) -> Array:
    """Median over time (axis 0) of up to `width` neighbours, NaN ignored."""
    half = width // 2
    padded = np.pad(values, ((half, half), *((0, 0),) * (values.ndim - 1)), constant_values=np.nan)
    stack = np.stack([padded[k : k + len(values)] for k in range(width)])
    stack.sort(axis=0)  # NaN go to the end
    count = np.isfinite(stack).sum(axis=0)
    low = np.maximum(count - 1, 0) // 2
    high = np.minimum(count // 2, width - 1)
    pick = np.take_along_axis
    middle: Array = 0.5 * (pick(stack, low[None], 0)[0] + pick(stack, high[None], 0)[0])
    return middle


def _spikes(misclosure: Array, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points that leap out of their own neighbours in time while the others do not.

    Found before any adjustment, where a gross error of many pixels would hide itself and others.
    """
    import warnings

    d = misclosure - _running_median(misclosure)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        d = d - np.nanmedian(d, axis=1, keepdims=True)  # the whole image may move
        own = 1.4826 * np.nanmedian(np.abs(d), axis=(1, 2))
    level = float(np.nanmedian(own)) if np.isfinite(own).any() else 0.0
    limit = 7.0 * np.fmax(np.nan_to_num(own), level)
    bad: NDArray[np.bool_] = seen & (np.max(np.abs(np.nan_to_num(d)), axis=2) > limit[:, None])
    return bad


def _adjusted(source: SeriesInput) -> Partials:
    """The linearisation: one camera for the mean image of the series, robust."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        mean = np.nanmedian(source.grid.points, axis=0)
    # targets seen in half of the epochs carry the orientation
    often = source.grid.observed.sum(axis=0) >= 0.5 * len(source.frame_times)
    rows = np.flatnonzero(np.isfinite(mean[:, 0]) & often)
    interior, exterior, _ = approximate_orientation(
        source.sensor, source.field.points[rows], mean[rows], source.principal_distance
    )
    p = np.concatenate([interior.as_array(), exterior.as_array()])
    c = p[0]
    prior = np.array(
        [0.2 * c, 0.1 * c, 0.1 * c, 0.3 / c**2, 0.3 / c**4, 0.3 / c**6, 0.02 / c, 0.02 / c]
        + [0.02, 0.02]
        + [np.inf] * 6
    )
    start = p.copy()
    start[3:10] = 0.0
    weight = np.zeros(len(mean))
    weight[rows] = 1.0
    at = linearise(source.sensor, source.field, p[:10], p[10:])
    for _ in range(15):
        misclosure = np.where(weight[:, None] > 0, mean - at.predicted, 0.0)
        misclosure = np.nan_to_num(misclosure)
        size = np.linalg.norm(misclosure, axis=1)
        spread = max(1.5 * float(np.median(size[rows])), 1e-3)
        w = weight / np.maximum(size / (2 * spread), 1.0) / spread**2
        A = at.A.reshape(-1, 16)
        W = np.repeat(w, 2)
        N = A.T @ (A * W[:, None]) + np.diag(1.0 / prior**2)
        right = A.T @ (W * misclosure.ravel()) + (start - p) / prior**2
        d = np.sqrt(np.diag(N))
        step = np.linalg.solve(N / np.outer(d, d) + 1e-12 * np.eye(16), right / d) / d
        p = p + step
        at = linearise(source.sensor, source.field, p[:10], p[10:])
        if np.max(np.abs(at.A.reshape(-1, 16) @ step)) < 1e-4:
            break
    return at


def _solve(N: Array, b: Array) -> Array:
    """Batched solution; a camera of too few targets is held by a weak prior of 1000 px."""
    k = N.shape[-1]
    return np.asarray(np.linalg.solve(N + 1e-6 * np.eye(k), b[..., None])[..., 0], dtype=float)


def _reduce(
    source: SeriesInput,
    times: Array,
    history: History,
    channels: Mapping[str, Channel],
    scale: Array | None,
) -> Evidence:
    at = _adjusted(source)
    X = source.field.points
    A = np.concatenate([at.A, at.B * X[:, None, :]], axis=-1)
    used = source.grid.observed.any(axis=0)
    if scale is None:
        scale = np.sqrt(np.mean(np.sum(A[used] ** 2, axis=1), axis=0))
    A = A / scale
    misclosure = source.grid.points - at.predicted
    weights = source.grid.weights
    seen = source.grid.observed
    bad = _spikes(misclosure, seen)
    offsets = np.zeros((len(X), 2))
    values = np.zeros((len(times), len(scale)))
    v = misclosure
    s0: float = 1.0
    for turn in range(5):
        w = np.where(bad[..., None], 0.0, weights)
        N = normal_matrices(w, A)
        b, _ = right_hand_sides(w, misclosure - offsets, A)
        values = _solve(N, b)
        v = misclosure - offsets - (values @ A.reshape(-1, len(scale)).T).reshape(misclosure.shape)
        change = _offset_change(w[..., :2], np.nan_to_num(v), N, A)
        offsets = offsets + change
        b, _ = right_hand_sides(w, misclosure - offsets, A)
        values = _solve(N, b)
        v = misclosure - offsets - (values @ A.reshape(-1, len(scale)).T).reshape(misclosure.shape)
        if turn >= 1:
            normal = np.abs(np.nan_to_num(v)) * np.sqrt(weights[..., :2])
            s0 = 1.4826 * float(np.median(normal[seen & ~bad]))
            local = np.nan_to_num(v - _running_median(np.where(bad[..., None], np.nan, v)))
            # noise may grow with heat: each epoch is judged by its own spread
            spread = np.array(
                [1.4826 * np.median(x[k]) if k.any() else s0
                 for x, k in zip(normal, seen & ~bad, strict=True)]
            )  # fmt: skip
            limit = _GROSS * np.maximum(spread, s0)[:, None]
            outlying = np.max(np.abs(local) * np.sqrt(weights[..., :2]), axis=2)
            bad = seen & (outlying > limit)
    w = np.where(bad[..., None], 0.0, weights)
    N = normal_matrices(w, A)
    b, _ = right_hand_sides(w, misclosure - offsets, A)
    values = _solve(N, b)
    v = misclosure - offsets - (values @ A.reshape(-1, len(scale)).T).reshape(misclosure.shape)
    offsets = offsets + _offset_change(w[..., :2], np.nan_to_num(v), N, A)
    b, lPl = right_hand_sides(w, misclosure - offsets, A)
    values = _solve(N, b)
    yy = np.einsum("ek,ek->e", values, b)
    count = (seen & ~bad).sum(axis=1)
    free = np.maximum(2 * count - len(scale), 1)
    # one offset per target is estimated too
    loss = 1.0 - 2 * used.sum() / max(2 * count.sum(), 1)
    sigma0 = np.sqrt(np.maximum(lPl - yy, 0) / free / loss)
    enough = count >= _MIN_TARGETS
    variance = float(np.median(sigma0[enough]) ** 2)
    v = misclosure - offsets - (values @ A.reshape(-1, len(scale)).T).reshape(misclosure.shape)
    v = np.where((seen & ~bad)[..., None], v, np.nan)
    weak = ~enough
    N[weak], b[weak], yy[weak], count[weak] = 0.0, 0.0, 0.0, 0
    return Evidence(
        source, times, history, channels, at, scale,
        N / variance, b / variance, yy / variance, values, v, w / variance, offsets,
        count, sigma0 / np.sqrt(variance), variance, _slowness(v), int(bad.sum()), columns=A,
    )  # fmt: skip


def _offset_change(weights: Array, v: Array, N: Array, A: Array, turns: int = 60) -> Array:
    """One offset per target (T, 2) that residuals v (E, T, 2) of free cameras ask for.

    Targets hidden for long pull at the cameras of the other epochs: offsets and cameras are solved
    together, by conjugate gradients on the offsets alone.
    """
    k = A.shape[-1]
    flat = A.reshape(-1, k)
    total = weights.sum(axis=0)
    inverse = 1.0 / np.where(total > 0, total, np.inf)

    def normal(p: Array) -> Array:
        camera = _solve(N, (weights * p).reshape(len(N), -1) @ flat)
        return np.asarray(np.sum(weights * (p - (camera @ flat.T).reshape(v.shape)), axis=0))

    out = np.zeros(total.shape)
    r = np.sum(weights * v, axis=0)
    z = inverse * r
    p, rz = z, float(np.sum(r * z))
    for _ in range(turns):
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


def condensed(evidence: Evidence, rows: int = 720) -> Evidence:
    """A long series on at most `rows` blocks of neighbouring epochs; a short one as it is.

    Heat is slow: over twelve epochs of 10 s a course of parameters loses what is faster than some
    minutes, and nothing else. Courses are computed on all epochs and then averaged.
    """
    from scipy.sparse import csr_array

    E = len(evidence.times)
    if rows >= E:
        return evidence
    size = int(np.ceil(E / rows))
    block = np.arange(E) // size
    B = int(block[-1]) + 1
    weight = evidence.n.astype(float)
    total = np.bincount(block, weight, minlength=B)
    share = weight / np.where(total > 0, total, 1.0)[block]
    average = csr_array((share, (block, np.arange(E))), shape=(B, E))
    N = np.add.reduceat(evidence.N, np.arange(0, E, size), axis=0)
    b = np.add.reduceat(evidence.b, np.arange(0, E, size), axis=0)
    values = _solve(N, b)
    yy = np.einsum("ek,ek->e", values, b)
    rank = float(np.sum(np.linalg.eigvalsh(N.sum(axis=0)) > 1e-9 * np.trace(N.sum(axis=0))))
    knots = next(iter(evidence.channels.values())).times
    inside = (knots >= evidence.history.times[0] - 30.0) & (
        knots <= evidence.history.times[-1] + 30.0
    )
    near = np.clip(np.searchsorted(evidence.history.times, knots), 0, E - 1)
    state = np.where(inside, block[near], 0)
    state[~inside] = B + np.arange(int((~inside).sum()))
    _, state = np.unique(state, return_inverse=True)
    pool = csr_array(
        (np.ones(len(knots)), (np.arange(len(knots)), state)),
        shape=(len(knots), int(state.max()) + 1),
    )
    first = np.arange(0, E, size)
    there = np.maximum(np.add.reduceat((evidence.n > 0).astype(float), first), 1.0)
    return replace(
        evidence,
        times=average @ evidence.times + (total == 0) * evidence.times[first],
        N=N,
        b=b,
        yy=yy,
        values=values,
        n=np.add.reduceat(evidence.n, first),
        sigma0=np.sqrt(np.add.reduceat(evidence.sigma0**2, first) / there),
        blocks=Blocks(
            average,
            pool,
            rank * float((evidence.n > 0).sum() - (total > 0).sum()),
        ),
    )


def reweighted(evidence: Evidence, noise: Array) -> Evidence:
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
    )


def without_targets(evidence: Evidence, rows: NDArray[np.int64]) -> Evidence:
    """The same series as if some targets of the field had never been observed."""
    source = evidence.source
    mask = np.zeros(source.grid.observed.shape, dtype=bool)
    mask[:, rows] = True
    reduced = _reduce(
        replace(source, grid=source.grid.reject(mask)),
        evidence.times,
        evidence.history,
        evidence.channels,
        evidence.scale,
    )
    return replace(reduced, source=source, excluded=np.union1d(evidence.excluded, rows))
