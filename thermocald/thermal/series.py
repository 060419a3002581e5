"""The evidence of a series: every epoch reduced once to normal equations, or blocks of epochs.

The unknowns of an epoch are the 16 parameters of the camera and three scales of the test field.
For a hypothesis about the whole series it then suffices to sum 19 × 19 matrices, without the image
points; `reduce` makes the evidence, `source` condenses the epochs of a long series.

A long series has short blocks where the camera moves fast: a block with a large χ² of its epochs'
cameras about their mean is halved, the largest first. This χ² is that of the movement that is not
linear in the temperature, in which effects beyond the base model show, plus a hundredth of that of
all movement, in which lags and delays show.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.linalg import best_level, explained, scaled_solve
from thermocald.physics.history import History
from thermocald.physics.model import Distortion, distortion_along

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid, Partials
    from thermocald.thermal.thermometer import Thermometer

FIELD_SCALES = ("scale_X", "scale_Y", "scale_Z")
COLUMNS = PARAMETER_NAMES + FIELD_SCALES


@dataclass(frozen=True, eq=False)
class SeriesInput:
    """The recorded data of a series.

    name: of the recording or store; frame_times (E,) s; reading_times (R,) s; readings {channel:
    (R,)} °C, the first is the reference; resolutions {channel: K or None}; grid: image points,
    epochs × targets; numbers (E,): of the epochs; series: its name; interior: a start value;
    columns {name: (E,)}: other recorded quantities at each frame, NaN where missing; counts (E,):
    numbers of epochs averaged in the rows, None if rows are epochs; noises {channel: (R,)} K:
    standard deviations of readings that are means, else None.
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
        """Return the times, s from the start, and values of each column with enough values."""
        t, columns = self.frame_times - self.frame_times[0], self.columns or {}
        known = {name: np.isfinite(values) for name, values in columns.items()}
        return {n: (t[k], columns[n][k]) for n, k in known.items() if k.mean() > 0.5}

    @property
    def per_row(self) -> Array:
        """The number of epochs in each row (E,)."""
        counts = np.ones(len(self.frame_times)) if self.counts is None else self.counts
        return counts.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The blocks of neighbouring epochs that are the rows of a long series.

    average (B, E): weights of the epochs in each block; pool (K, S): knots to states, where the
    readings of a block have one state; within_free: degrees of freedom of the epochs about their
    blocks; first (B,): index of each block's first epoch.
    """

    average: csr_array
    pool: csr_array
    within_free: float
    first: NDArray[np.int64]


class Carried(NamedTuple):
    """What the readings of a thermometer do to a trajectory.

    states (E, S): its derivatives by independent errors; shift (E,): what the readings' deviation
    from a smooth trajectory adds; sd (E,): of the errors that the states of blocks do not have.
    """

    states: Array
    shift: Array
    sd: Array


_OFTEN = 0.9  # share of the epochs with a target from which its offset needs no unknown
_SEEN = 0.05  # variance of an amplitude, in units of the image noise, from which it is an unknown
_LOOSE = 1e-4  # px⁻², prior weight of an offset


@dataclass(frozen=True, eq=False)
class HiddenTargets:
    """The offsets of hidden targets, as S combinations that the camera's parameters could absorb.

    patterns (G, E) px⁻²: weights of the targets that are seen at the same epochs; members: for each
    pattern the targets' rows (n,) and the combinations (2n, s) of their coordinates; group (S,):
    the pattern of each combination; vectors (S, P): its products with the scaled parameters' design
    matrix; right (S, E): its products with the weighted misclosures.
    """

    patterns: Array
    members: tuple[tuple[NDArray[np.int64], Array], ...]
    group: NDArray[np.int64]
    vectors: Array
    right: Array

    @property
    def cross(self) -> Array:
        """The normal equations' block (S, E, P) with the epochs' parameters."""
        return np.asarray(self.patterns[self.group][:, :, None] * self.vectors[:, None, :])

    @property
    def normal(self) -> Array:
        """The diagonal (S,) of the offsets' own normal matrix."""
        return np.asarray(self.patterns.sum(axis=1)[self.group] + _LOOSE)

    def turned(self, T: Array, values: Array) -> HiddenTargets:
        """Transform the offsets with normal matrices to T N Tᵀ, about the epochs' values (E, P)."""
        vectors = self.vectors @ T.T
        change = (vectors - self.vectors) @ values.T
        right = self.right + self.patterns[self.group] * change
        return replace(self, vectors=vectors, right=right)

    def less(self, change: Array) -> HiddenTargets:
        """Subtract changes (E, T, 2) px from the image points."""
        parts = [
            self.patterns[k] * (change[:, rows].reshape(len(change), -1) @ U).T
            for k, (rows, U) in enumerate(self.members)
        ]
        return replace(self, right=self.right - np.concatenate(parts))


def group_hidden_targets(w: Array, left: Array, A: Array) -> HiddenTargets | None:
    """Group the targets that are hidden for long by the epochs that show them; None if none is.

    w (E, T, 3) px⁻²: weights; left (E, T, 2) px: misclosures; A (T, 2, P): partial derivatives.
    """
    there = w[..., 0] > 0
    epochs = there.any(axis=1)
    rows = np.flatnonzero(there.any(axis=0) & (there[epochs].mean(axis=0) < _OFTEN))
    if not len(rows):
        return None
    together: dict[bytes, list[int]] = {}
    for row in rows.tolist():
        together.setdefault(np.packbits(there[:, row]).tobytes(), []).append(row)
    patterns, members, group, vectors = [], [], [], []
    for number, targets in enumerate(together.values()):
        U, s, V = np.linalg.svd(A[targets].reshape(2 * len(targets), -1), full_matrices=False)
        kept = s > 1e-9 * s[0]
        patterns.append(w[:, targets, :2].mean(axis=(1, 2)))
        members.append((np.array(targets), U[:, kept]))
        group.append(np.full(int(kept.sum()), number))
        vectors.append(s[kept, None] * V[kept])
    empty = HiddenTargets(
        np.stack(patterns), tuple(members), np.concatenate(group), np.concatenate(vectors),
        np.zeros((sum(U.shape[1] for _, U in members), len(w))),
    )  # fmt: skip
    return empty.less(-np.where(there[..., None], left, 0.0))


@dataclass(frozen=True, eq=False)
class Movement:
    """A slow movement of the epochs' parameters that no hypothesis explains.

    directions (P, m): in px-scaled columns; trajectories (E, K): orthonormal cosines; sd (m, K): of
    their amplitudes, in units of the image noise. Amplitudes below the noise are left out.
    """

    directions: Array
    trajectories: Array
    sd: Array

    @cached_property
    def states(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The direction and the cosine of each amplitude that counts, indices (F,) each."""
        seen = self.sd**2 > _SEEN
        if not seen.any():
            seen[-1, 0] = True
        mode, wave = np.nonzero(seen)
        return mode, wave

    @property
    def operators(self) -> list[tuple[Array, Array]]:
        """The directions (P,) that count, each with its trajectories (E, ·) of unit variance."""
        mode, wave = self.states
        return [
            (self.directions[:, i], self.trajectories[:, k] * self.sd[i, k])
            for i in np.unique(mode)
            for k in [wave[mode == i]]
        ]

    def moments(self, mean: Array, root: Array) -> tuple[Array, Array]:
        """Return the amplitudes' products and their gain in precision, (m, m), summed over cosines.

        mean (F,), root (·, F): of the amplitudes and of their covariance, given the data; the
        amplitudes that are left out have mean 0 and variance 1.
        """
        mode, wave = self.states
        m, K = self.sd.shape
        amplitudes = np.zeros((m, K))
        amplitudes[mode, wave] = mean
        known = np.zeros((m, m))
        for k in np.unique(wave):
            own = np.flatnonzero(wave == k)
            part = root[:, own]
            known[np.ix_(mode[own], mode[own])] += np.eye(len(own)) - part.T @ part
        return amplitudes @ amplitudes.T, known


def waves(times: Array, count: int) -> Array:
    """Return cosines (E, K) over a series, orthonormal for epochs at even intervals."""
    E = len(times)
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    u = (u * (E - 1) + 0.5) / E
    return np.asarray(np.sqrt(2.0 / E) * np.cos(np.pi * np.arange(1, count + 1) * u[:, None]))


def cosines(times: Array, orders: int) -> Array:
    """Return smooth trajectories (orders, E) over a series; order 1 is half a wave."""
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    rows: Array = np.cos(np.pi * np.arange(1, orders + 1)[:, None] * u[None])
    rows -= rows.mean(axis=1, keepdims=True)
    return rows


@dataclass(frozen=True, eq=False)
class ReducedSeries:
    """A series, reduced to normal equations.

    source: the recorded data; times (E,) s from the start; history: smoothed readings;
    thermometers: the temperature columns as instruments; at: linearisation; scale (19,): px per
    unit of each column; columns (T, 2, 19): ∂ image points / ∂ scaled columns; distortion: whether
    the column of c changes A and B too (`angle`) or not (`image`).

    N (E, 19, 19), b (E, 19): normal equations in px-scaled columns, weighted by the estimated
    noise; yy (E,): bᵀN⁻¹b; values (E, 19): the free camera of each epoch, scaled; residuals (E, T,
    2) px: of the free camera, without the targets' offsets, NaN where unseen or gross; weights (E,
    T, 3) px⁻²; n (E,): numbers of image points; sigma0 (E,).

    variance: factor by which the given variances were too small; correlation: variance of slow
    trajectories over that of white noise; excluded: rows of targets left out; blocks: the epochs in
    each row of a long series, or None; hidden, movement: random effects, or None; tremble (P, t):
    directions of each epoch's random movement, of unit variance, or None; bend (E, T, 2) px:
    curvature of the projection that was subtracted from the observations, or None; slope_jumps (E,)
    K/s: jumps of the temperature's slope as measured by the images, or None; touched (E,): the
    epochs without weight because the camera was elsewhere for a moment.
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
    n: NDArray[np.int64]
    sigma0: Array
    variance: float
    correlation: float
    excluded: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    blocks: Blocks | None = None
    hidden: HiddenTargets | None = None
    movement: Movement | None = None
    tremble: Array | None = None
    bend: Array | None = None
    distortion: Distortion = "angle"
    slope_jumps: Array | None = None
    touched: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def readings_history(self) -> History:
        """The history of the temperature as read, without smoothing, at the rows' times."""
        s = self.source
        there = np.isfinite(s.reading_times)
        readings = {n: np.asarray(r, dtype=float)[there] for n, r in s.readings.items()}
        times = s.reading_times[there] - s.frame_times[0]
        frames = s.frame_times - s.frame_times[0]
        columns = self.history.columns
        return History(frames, times, readings, self.history.reference, self.T0, columns)

    def rescaled(self, scale: Array) -> ReducedSeries:
        """Return the series with other px per unit of each column (19,)."""
        return self._in_columns(np.diag(self.scale / scale), scale=scale)

    def _in_columns(self, M: Array, **changes: Any) -> ReducedSeries:
        """Return the series in other columns; M (19, 19) converts new values to present ones."""
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
        """Return the series with a distortion that follows the `angle` or the `image`."""
        if distortion == self.distortion:
            return self
        new = scaled_basis(self.at.iop, self.scale, distortion)
        M = np.asarray(np.linalg.solve(self.along, new), dtype=float)
        return self._in_columns(M, distortion=distortion)

    def weighted(self, factor: Array | float) -> ReducedSeries:
        """Return the series with the epochs' weights multiplied by a factor, or by factors (E,).

        The image points' weights are unchanged.
        """
        f: Array = np.broadcast_to(factor, self.yy.shape)
        h = self.hidden
        hidden = h and replace(h, patterns=h.patterns * f, right=h.right * f)
        N, b = self.N * f[:, None, None], self.b * f[:, None]
        return replace(self, N=N, b=b, yy=self.yy * f, hidden=hidden)

    def squares(self, rest: Array) -> Array:
        """Return the squares (E,) of a movement (E, P) without its level, per image noise."""
        r = rest - best_level(self.N, np.einsum("epq,eq->ep", self.N, rest))
        return np.asarray(np.einsum("ep,epq,eq->e", r, self.N, r))

    def left_by_cameras(self, rows: NDArray[np.int64]) -> Array:
        """Return targets' residuals about the free cameras, (E, n, 2) px, used in them or not."""
        misclosure = self.source.grid.points[:, rows] - self.at.predicted[rows]
        return np.asarray(misclosure - np.einsum("ek,tik->eti", self.values, self.columns[rows]))

    def with_values(self, values: Array) -> ReducedSeries:
        """Return the series with other free cameras (E, 19)."""
        b = np.einsum("epq,eq->ep", self.N, values)
        return replace(self, values=values, b=b, yy=np.einsum("ep,ep->e", values, b))

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Each row's epoch number; for a block, that of its first epoch."""
        every = self.source.numbers
        return every if self.blocks is None else every[self.blocks.first]

    def carry(self, channel: str, operator: csr_array) -> Carried:
        """Return what readings do to a trajectory, from ∂ its averages / ∂ knots (B, K)."""
        instrument = self.thermometers[channel]
        result = operator @ instrument.mixing
        if self.blocks is None:
            states = np.asarray(result[:, instrument.erring].toarray())
            return Carried(states, states @ self.state_deviation(channel), np.zeros(len(states)))
        states = np.asarray((result @ self.blocks.pool).toarray())
        whole = result.power(2) @ instrument.sd**2
        unshared = whole - states**2 @ self.state_sd(channel) ** 2
        return Carried(states, result @ instrument.deviation, np.sqrt(unshared.clip(0.0)))

    def state_sd(self, channel: str) -> Array:
        """Return the standard deviations of the independent errors, K."""
        sd = self.thermometers[channel].sd
        if self.blocks is None:
            return sd[self.thermometers[channel].erring]
        pool = self.blocks.pool  # a state's sd is that of the mean over its knots
        return np.asarray(np.sqrt(pool.T @ sd**2) / pool.sum(axis=0))

    def state_deviation(self, channel: str) -> Array:
        """Return the independent errors' part of readings minus smooth trajectory, K."""
        deviation = self.thermometers[channel].deviation
        if self.blocks is None:
            return deviation[self.thermometers[channel].erring]
        pool = self.blocks.pool
        return np.asarray((pool.T @ deviation) / pool.sum(axis=0))

    @property
    def averages(self) -> csr_array | None:
        """The weights (B, E) of the epochs in each row, None if rows are epochs."""
        return self.blocks and self.blocks.average

    def averaged(self, trajectory: Array) -> Array:
        """Return the averages of a trajectory (epochs, …) over the rows of the normal equations."""
        return trajectory if self.blocks is None else np.asarray(self.blocks.average @ trajectory)

    def locate(self, time: float) -> tuple[int, float, float]:
        """Return the first row after an event, the event's time and its sd, s.

        time: of the first row after it, s.
        """
        first = int(np.searchsorted(self.times, time - 1e-6))
        before = float(self.times[max(first - 1, 0)])
        return first, 0.5 * (before + time), max(time - before, 1e-3) / float(np.sqrt(12.0))

    @property
    def T0(self) -> float:
        """The reference temperature, °C."""
        return self.history.T0

    @property
    def rank(self) -> float:
        """The number of the parameters' levels that the series determines."""
        size = np.linalg.eigvalsh(self.N.sum(axis=0))
        return float(np.sum(size > 1e-9 * size[-1]))

    @property
    def sigma_px(self) -> float:
        """The noise of an image coordinate, px, according to the weights."""
        weights = self.weights[..., :2]
        return float(1.0 / np.sqrt(np.mean(weights[weights > 0])))


def scaled_basis(iop: Array, scale: Array, distortion: Distortion) -> Array:
    """Return ∂ camera and field scales / ∂ columns (19, 19), both px-scaled, at `iop`."""
    out = np.eye(len(scale))
    if distortion == "angle":
        out[:10, :10] = distortion_along(iop)
    return out * scale[:, None] / scale


def unit_directions(names: Sequence[str]) -> Array:
    """Return unit vectors (P, k) along the named columns."""
    out = np.zeros((len(COLUMNS), len(names)))
    out[[COLUMNS.index(name) for name in names], np.arange(len(names))] = 1.0
    return out


def solve(N: Array, b: Array) -> Array:
    """Solve all epochs at once; a prior of 1000 px constrains a camera with too few targets."""
    k = N.shape[-1]
    return np.asarray(np.linalg.solve(N + 1e-6 * np.eye(k), b[..., None])[..., 0], dtype=float)


_ALL_MOVEMENT = 0.01
_DAY_S = 86_400.0
_DAYS = 30.0  # from which a series' long blocks are whole days, as daily cycles average out


def choose_blocks(evidence: ReducedSeries, rows: int) -> NDArray[np.int64]:
    """Choose at most `rows` blocks; return their first epochs (B,)."""
    E = len(evidence.times)
    N, T = evidence.N, evidence.history.temperature() - evidence.T0
    P, by_T = N.shape[1], np.einsum("e,epq->pq", T, N)
    A = np.block([[N.sum(axis=0), by_T], [by_T, np.einsum("e,epq->pq", T * T, N)]])
    c = np.concatenate([evidence.b.sum(axis=0), T @ evidence.b])
    rates = np.outer(T, scaled_solve(A, c, 1e-10)[P:])
    nonlinear = _scatter(evidence, evidence.values - rates)
    every = _scatter(evidence, evidence.values)

    def gain(start: int, stop: int) -> float:
        return nonlinear(start, stop) + _ALL_MOVEMENT * every(start, stop)

    # first blocks of equal duration, in whole days for a long series
    span = float(evidence.times[-1] - evidence.times[0])
    length = span / max(rows // 2, 1)
    if span > _DAYS * _DAY_S:
        length = np.ceil(length / _DAY_S) * _DAY_S
    number = np.floor((evidence.times - evidence.times[0]) / max(length, 1e-9))
    first: list[int] = np.flatnonzero(np.diff(number, prepend=-1.0) > 0).tolist()
    heap: list[tuple[float, int, int]] = []
    for start, stop in zip(first, [*first[1:], E], strict=True):
        heapq.heappush(heap, (-gain(start, stop), start, stop))
    done: list[int] = []
    while heap and len(heap) + len(done) < rows:
        _, start, stop = heapq.heappop(heap)
        if stop - start < 2:
            done.append(start)
            continue
        times = evidence.times[start:stop]  # halved in time, with at least one epoch on either side
        half = np.searchsorted(times, 0.5 * (times[0] + times[-1]))
        middle = start + int(np.clip(half, 1, len(times) - 1))
        for part in ((start, middle), (middle, stop)):
            heapq.heappush(heap, (-gain(*part), *part))
    return np.array(sorted([*done, *(start for _, start, _ in heap)]), dtype=np.int64)


def _scatter(evidence: ReducedSeries, values: Array) -> Callable[[int, int], float]:
    """Return a function of `start` and `stop`: these epochs' χ² about their mean, minus its
    expectation.
    """
    right = np.einsum("epq,eq->ep", evidence.N, values)
    square = np.einsum("ep,ep->e", right, values)
    each = (evidence.N, right, square, (evidence.n > 0).astype(float))
    # (E + 1, …) sums of all epochs before each
    sums = [np.cumsum(np.concatenate([np.zeros_like(x[:1]), x]), axis=0) for x in each]
    rank = evidence.rank

    def within(start: int, stop: int) -> float:
        N, b, total, count = (x[stop] - x[start] for x in sums)
        if count < 2:
            return 0.0
        return float(total - explained(N, b, 1e-9) - rank * (count - 1))

    return within


def in_blocks(evidence: ReducedSeries, rows: int = 720) -> ReducedSeries:
    """Return a long series in at most `rows` blocks of neighbouring epochs, a short one unchanged.

    Heat is slow: averaged over twelve epochs of 10 s, a trajectory of parameters loses only what is
    faster than some minutes. Trajectories are computed for all epochs and then averaged. In a
    series of weeks or more, blocks are short where the camera moves fast, and up to days elsewhere.
    """
    from scipy.sparse import csr_array

    E, hidden = len(evidence.times), evidence.hidden
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
    free = evidence.rank * float((evidence.n > 0).sum() - (total > 0).sum())
    return replace(
        evidence,
        times=average @ evidence.times + (total == 0) * evidence.times[first],
        N=N, b=b, yy=np.einsum("ek,ek->e", values, b), values=values,
        n=np.add.reduceat(evidence.n, first),
        sigma0=np.sqrt(np.add.reduceat(evidence.sigma0**2, first) / there),
        blocks=Blocks(average, pool, free, first),
        hidden=hidden and replace(
            hidden, patterns=np.add.reduceat(hidden.patterns, first, axis=1),
            right=np.add.reduceat(hidden.right, first, axis=1),
        ),
    )  # fmt: skip
