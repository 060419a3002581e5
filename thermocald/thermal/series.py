"""The evidence of one series: every epoch reduced to normal equations, once; on blocks if long.

The unknowns of an epoch are the 16 parameters of the camera and three scales of the test field.
A hypothesis about the whole series is then a sum over 19 × 19 matrices, and no image point is
touched again; `reduction` makes the evidence, `condensing` puts the epochs of long series together.

Where a long series needs short blocks: greedy halving where most happens within a block.

What happens is χ² of the cameras of a block's epochs about their mean: first of all what does not
follow the temperature in a straight line, where an effect hides that the base model lacks; to a
hundredth of its weight all movement, where lags and delays show.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.linalg import best_level, explained, unit_diagonal
from thermocald.physics.history import History
from thermocald.physics.model import Distortion, distortion_along, follow_angle

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid, Partials
    from thermocald.thermal.random_effects import HiddenTargets, Movement
    from thermocald.thermal.thermometer import Thermometer

FIELD_SCALES = ("scale_X", "scale_Y", "scale_Z")
COLUMNS = PARAMETER_NAMES + FIELD_SCALES


@dataclass(frozen=True, eq=False)
class SeriesInput:
    """What was recorded.

    frame_times (E,) s; reading_times (R,) s; readings {channel: (R,)} °C, the first the reference;
    resolutions {channel: K or None}; grid: image points on epochs × targets; numbers (E,): the
    epochs' own numbers; series: its name; interior: what is known of the camera, for a start;
    columns {name: (E,)}: what else was recorded with each frame, NaN where it is missing; counts
    (E,): of how many epochs each row is the mean, None where rows are epochs; noises {channel:
    (R,)} K: standard deviations of readings that are means, None where they are not.
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
    series: str = ""
    interior: InteriorOrientation | None = None
    columns: Mapping[str, Array] | None = None
    counts: NDArray[np.int64] | None = None
    noises: Mapping[str, Array] | None = None

    def polygons(self) -> dict[str, tuple[Array, Array]]:
        """Return times s from the start and values of each column that was recorded often
        enough.
        """
        t = self.frame_times - self.frame_times[0]
        out = {}
        for name, values in (self.columns or {}).items():
            there = np.isfinite(values)
            if there.mean() > 0.5:
                out[name] = (t[there], values[there])
        return out

    def epochs(self, rows: NDArray[np.bool_]) -> int:
        """Count the epochs that some rows (E,) stand for."""
        return int(rows.sum() if self.counts is None else self.counts[rows].sum())

    @property
    def per_row(self) -> Array:
        """Of how many epochs each row (E,) is the mean."""
        ones: Array = np.ones(len(self.frame_times))
        return ones if self.counts is None else self.counts.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Neighbouring epochs of a long series as one row.

    average (B, E): weights of the epochs in each block; pool (K, S): knots to states, the readings
    of a block being one; within_free: degrees of freedom of the epochs about their blocks; first
    (B,): index of each block's first epoch.
    """

    average: csr_array
    pool: csr_array
    within_free: float
    first: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ReducedSeries:
    """One series, reduced.

    source: what was recorded; times (E,) s from its start; history: smoothed readings;
    thermometers: the columns as instruments; at: linearisation; scale (19,): px per unit of each
    column; columns (T, 2, 19): ∂ image points / ∂ scaled columns; distortion: what it follows in
    the column of c, which takes A and B along (`angle`) or leaves them.

    N (E, 19, 19), b (E, 19): normal equations in px-scaled columns, weighted by the noise found; yy
    (E,): bᵀN⁻¹b; values (E, 19): the free camera of each epoch, scaled; residuals (E, T, 2) px:
    what the free camera leaves, offsets (T, 2) px taken out, NaN where unseen or gross; weights (E,
    T, 3) px⁻²; n (E,) image points; sigma0 (E,).

    variance: factor by which the given variances were too small; correlation: how much larger the
    variance of slow trajectories is than that of white noise; gross: rejected points; excluded:
    rows of targets left out; blocks: the epochs behind each row of a long series, or None; hidden,
    movement: what the likelihood integrates out (`random_effects`), or None; tremble (P, t):
    directions in which each epoch moves by itself, of unit variance; bend (E, T, 2) px: curvature
    of the projection that was taken off the observations, or None; slope_jumps (E,) K/s: where the
    images show that the temperature's slope jumps, None where they were not asked.
    """

    source: SeriesInput
    times: Array
    history: History
    thermometers: Mapping[str, Thermometer]
    at: Partials
    scale: Array
    columns: Array
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
    blocks: Blocks | None = None
    hidden: HiddenTargets | None = None
    movement: Movement | None = None
    tremble: Array | None = None
    bend: Array | None = None
    distortion: Distortion = "angle"
    slope_jumps: Array | None = None

    @property
    def readings_history(self) -> History:
        """The temperature as it was read, without smoothing, at the rows' times."""
        s = self.source
        there = np.isfinite(s.reading_times)
        readings = {n: np.asarray(r, dtype=float)[there] for n, r in s.readings.items()}
        times = s.reading_times[there] - s.frame_times[0]
        frames = s.frame_times - s.frame_times[0]
        columns = self.history.columns
        return History(frames, times, readings, self.history.reference, self.T0, columns)

    def rescaled(self, scale: Array) -> ReducedSeries:
        """Change the px per unit of each column (19,)."""
        return self._in_columns(np.diag(self.scale / scale), scale=scale)

    def _in_columns(self, M: Array, **changes: Any) -> ReducedSeries:
        """Express movements in other columns: M (19, 19) takes new values to present ones."""
        return replace(
            self,
            columns=self.columns @ M,
            N=M.T @ self.N @ M,
            b=self.b @ M,
            values=self.values @ np.linalg.inv(M).T,
            hidden=replace(self.hidden, vectors=self.hidden.vectors @ M) if self.hidden else None,
            **changes,
        )

    @property
    def along(self) -> Array:
        """∂ camera and field scales / ∂ columns (19, 19), both scaled."""
        return scaled_basis(self.at.iop, self.scale, self.distortion)

    def in_basis(self, distortion: Distortion) -> ReducedSeries:
        """Let the distortion follow the angle, or the image."""
        if distortion == self.distortion:
            return self
        new = scaled_basis(self.at.iop, self.scale, distortion)
        M = np.asarray(np.linalg.solve(self.along, new), dtype=float)
        return self._in_columns(M, distortion=distortion)

    def orientations(self, parameters: Array) -> Array:
        """Return the interior orientations (E, 10) of movements (E, 19) in the columns' units."""
        linear = self.at.iop + parameters[:, :10]
        return follow_angle(linear, self.at.iop[0]) if self.distortion == "angle" else linear

    def weighted(self, factor: Array | float) -> ReducedSeries:
        """Multiply the weight of each epoch by a factor (E,), or of all by one.

        The weights of the image points stay as they are.
        """
        f: Array = np.broadcast_to(factor, self.yy.shape)
        hidden = self.hidden.scaled(f) if self.hidden else None
        N, b = self.N * f[:, None, None], self.b * f[:, None]
        return replace(self, N=N, b=b, yy=self.yy * f, hidden=hidden)

    def squares(self, rest: Array) -> Array:
        """Square a movement (E, P) of the parameters, less one level, in image noise: (E,)."""
        r = rest - best_level(self.N, np.einsum("epq,eq->ep", self.N, rest))
        squares: Array = np.einsum("ep,epq,eq->e", r, self.N, r)
        return squares

    def with_values(self, values: Array) -> ReducedSeries:
        """Replace the free cameras by others (E, 19)."""
        b = np.einsum("epq,eq->ep", self.N, values)
        return replace(self, values=values, b=b, yy=np.einsum("ep,ep->e", values, b))

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The number of the epoch of each row; of a block, of its first epoch."""
        every = self.source.numbers
        return every if self.blocks is None else every[self.blocks.first]

    def states(self, channel: str, operator: csr_array) -> Array:
        """Return ∂ trajectory / ∂ independent errors, dense, from ∂ trajectory / ∂ knots (epochs,
        K).
        """
        result = operator @ self.thermometers[channel].mixing
        if self.blocks is not None:
            result = self.blocks.average @ result @ self.blocks.pool
        return np.asarray(result.toarray())

    def state_sd(self, channel: str) -> Array:
        """Return the standard deviations of the independent errors, K."""
        sd = self.thermometers[channel].sd
        if self.blocks is None:
            return sd
        pool = self.blocks.pool  # the sd of the mean over the knots of a state
        return np.asarray(np.sqrt(pool.T @ sd**2) / pool.sum(axis=0))

    def state_deviation(self, channel: str) -> Array:
        """Return readings minus smooth trajectory as far as the independent errors hold it, K."""
        deviation = self.thermometers[channel].deviation
        if self.blocks is None:
            return deviation
        pool = self.blocks.pool
        return np.asarray((pool.T @ deviation) / pool.sum(axis=0))

    def averaged(self, trajectory: Array) -> Array:
        """Average a trajectory (epochs, …) over the rows of the normal equations."""
        return trajectory if self.blocks is None else np.asarray(self.blocks.average @ trajectory)

    def locate(self, time: float) -> tuple[int, float, float]:
        """Find an event from a time s on: the first row after it, its time and its sd, s."""
        first = int(np.searchsorted(self.times, time - 1e-6))
        before = float(self.times[max(first - 1, 0)])
        return first, 0.5 * (before + time), max(time - before, 1e-3) / float(np.sqrt(12.0))

    @property
    def T0(self) -> float:
        """The reference temperature, °C."""
        return self.history.T0

    @property
    def rank(self) -> float:
        """How many levels of the parameters the series determines."""
        size = np.linalg.eigvalsh(self.N.sum(axis=0))
        return float(np.sum(size > 1e-9 * size[-1]))

    @property
    def sigma_px(self) -> float:
        """The noise of an image coordinate, px, as the weights have it."""
        weights = self.weights[..., :2]
        return float(1.0 / np.sqrt(np.mean(weights[weights > 0])))


def scaled_basis(iop: Array, scale: Array, distortion: Distortion) -> Array:
    """Return ∂ camera and field scales / ∂ columns (19, 19), both px-scaled, at an orientation."""
    out = np.eye(len(scale))
    if distortion == "angle":
        out[:10, :10] = distortion_along(iop)
    return out * scale[:, None] / scale


def unit_directions(names: Sequence[str]) -> Array:
    """Return unit vectors (P, k) along some columns."""
    out = np.zeros((len(COLUMNS), len(names)))
    out[[COLUMNS.index(name) for name in names], np.arange(len(names))] = 1.0
    return out


def solve(N: Array, b: Array) -> Array:
    """Solve in batches; a camera of too few targets is held by a weak prior of 1000 px."""
    k = N.shape[-1]
    return np.asarray(np.linalg.solve(N + 1e-6 * np.eye(k), b[..., None])[..., 0], dtype=float)


_ALL_MOVEMENT = 0.01
_DAY_S = 86_400.0
_DAYS = 30.0  # of a series whose long blocks are whole days: what a day repeats averages out


def choose_blocks(evidence: ReducedSeries, rows: int) -> NDArray[np.int64]:
    """Choose the first epochs (B,) of at most `rows` blocks."""
    E = len(evidence.times)
    apart = _scatter(evidence, _remove_rates(evidence))
    every = _scatter(evidence, evidence.values)

    def worth(start: int, stop: int) -> float:
        return apart(start, stop) + _ALL_MOVEMENT * every(start, stop)

    first = _cut_evenly(evidence.times, rows // 2)
    heap: list[tuple[float, int, int]] = []
    for start, stop in zip(first, np.append(first[1:], E), strict=True):
        heapq.heappush(heap, (-worth(int(start), int(stop)), int(start), int(stop)))
    done: list[int] = []
    while heap and len(heap) + len(done) < rows:
        _, start, stop = heapq.heappop(heap)
        if stop - start < 2:
            done.append(start)
            continue
        times = evidence.times[start:stop]  # halved in time; one epoch at least on either side
        half = np.searchsorted(times, 0.5 * (times[0] + times[-1]))
        middle = start + int(np.clip(half, 1, len(times) - 1))
        for part in ((start, middle), (middle, stop)):
            heapq.heappush(heap, (-worth(*part), *part))
    return np.array(sorted([*done, *(start for _, start, _ in heap)]), dtype=np.int64)


def _cut_evenly(times: Array, most: int) -> NDArray[np.int64]:
    """Return the first epochs of blocks of equal times; of a series of months, of whole days."""
    span = float(times[-1] - times[0])
    length = span / max(most, 1)
    if span > _DAYS * _DAY_S:
        length = np.ceil(length / _DAY_S) * _DAY_S
    number = np.floor((times - times[0]) / max(length, 1e-9))
    return np.flatnonzero(np.diff(number, prepend=-1.0) > 0)


def _remove_rates(evidence: ReducedSeries) -> Array:
    """Take levels and rates of the temperature off the cameras (E, P), by least squares."""
    N, T = evidence.N, evidence.history.temperature() - evidence.T0
    P = N.shape[1]
    A = np.empty((2 * P, 2 * P))
    A[:P, :P] = N.sum(axis=0)
    A[:P, P:] = A[P:, :P] = np.einsum("e,epq->pq", T, N)
    A[P:, P:] = np.einsum("e,epq->pq", T * T, N)
    c = np.concatenate([evidence.b.sum(axis=0), T @ evidence.b])
    scaled, scale = unit_diagonal(A)
    x = scale * np.linalg.lstsq(scaled, c * scale, rcond=1e-10)[0]
    left: Array = evidence.values - x[:P] - np.outer(T, x[P:])
    return left


def _scatter(evidence: ReducedSeries, values: Array) -> Callable[[int, int], float]:
    """χ² of cameras about the mean of a run of epochs `start` to `stop`, less its expectation."""

    def running(each: Array) -> Array:  # (E + 1, …) sums of all before each epoch
        out = np.zeros((len(each) + 1, *each.shape[1:]))
        np.cumsum(each, axis=0, out=out[1:])
        return out

    right = np.einsum("epq,eq->ep", evidence.N, values)
    square = np.einsum("ep,ep->e", right, values)
    sums = [running(x) for x in (evidence.N, right, square, (evidence.n > 0).astype(float))]
    rank = evidence.rank

    def within(start: int, stop: int) -> float:
        N, b, total, count = (x[stop] - x[start] for x in sums)
        if count < 2:
            return 0.0
        return float(total - explained(N, b, 1e-9) - rank * (count - 1))

    return within


def in_blocks(evidence: ReducedSeries, rows: int = 720) -> ReducedSeries:
    """Put a long series on at most `rows` blocks of neighbouring epochs; leave a short one.

    Heat is slow: over twelve epochs of 10 s a trajectory of parameters loses what is faster than
    some minutes, and nothing else. Trajectories are computed on all epochs and then averaged. The
    blocks of a series of weeks and more are short where the camera moves fast, and days elsewhere.
    """
    from scipy.sparse import csr_array

    E = len(evidence.times)
    if rows >= E:
        return evidence
    size = int(np.ceil(E / rows))
    first = np.arange(0, E, size)
    if evidence.source.counts is not None:
        first = choose_blocks(evidence, rows)
    block = np.repeat(np.arange(len(first)), np.diff(first, append=E))
    B = int(block[-1]) + 1
    weight = evidence.n * evidence.source.per_row
    total = np.bincount(block, weight, minlength=B)
    share = weight / np.where(total > 0, total, 1.0)[block]
    average = csr_array((share, (block, np.arange(E))), shape=(B, E))
    N = np.add.reduceat(evidence.N, first, axis=0)
    b = np.add.reduceat(evidence.b, first, axis=0)
    values = solve(N, b)
    yy = np.einsum("ek,ek->e", values, b)
    rank = float(np.sum(np.linalg.eigvalsh(N.sum(axis=0)) > 1e-9 * np.trace(N.sum(axis=0))))
    knots = next(iter(evidence.thermometers.values())).times
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
            first,
        ),
        hidden=evidence.hidden.in_blocks(first) if evidence.hidden else None,
        slope_jumps=None,
    )
