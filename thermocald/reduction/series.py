"""The evidence of one series: every epoch reduced to small normal equations, once.

The unknowns of an epoch are the 16 parameters of the camera and three scales of the test field.
A hypothesis about the whole series is then a sum over 19 × 19 matrices, and no image point is
touched again; `reduction` makes the evidence, `condensing` puts the epochs of long series together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid, Partials
    from thermocald.reduction.random_effects import HiddenTargets, Movement
    from thermocald.reduction.thermometer import Thermometer

__all__ = ["COLUMNS", "FIELD_SCALES", "Blocks", "ReducedSeries", "SeriesInput", "solve"]

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
        """Times s from the start and values of each column that was recorded often enough."""
        t = self.frame_times - self.frame_times[0]
        out = {}
        for name, values in (self.columns or {}).items():
            there = np.isfinite(values)
            if there.mean() > 0.5:
                out[name] = (t[there], values[there])
        return out

    def epochs(self, rows: NDArray[np.bool_]) -> int:
        """How many epochs some rows (E,) stand for."""
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

    def pooled_mean(self, values: Array) -> Array:
        """Mean over the knots of each state."""
        return np.asarray((self.pool.T @ values) / self.pool.sum(axis=0))

    def pooled_sd(self, sd: Array) -> Array:
        """Standard deviation of the mean over the knots of each state."""
        return np.asarray(np.sqrt(self.pool.T @ sd**2) / self.pool.sum(axis=0))


@dataclass(frozen=True, eq=False)
class ReducedSeries:
    """One series, reduced.

    source: what was recorded; times (E,) s from its start; history: smoothed readings;
    thermometers: the columns as instruments; at: linearisation; scale (19,): px per unit of each
    column; columns (T, 2, 19): ∂ image points / ∂ scaled columns.

    N (E, 19, 19), b (E, 19): normal equations in px-scaled columns, weighted by the noise found; yy
    (E,): bᵀN⁻¹b; values (E, 19): the free camera of each epoch, scaled; residuals (E, T, 2) px:
    what the free camera leaves, offsets (T, 2) px taken out, NaN where unseen or gross; weights (E,
    T, 3) px⁻²; n (E,) image points; sigma0 (E,).

    variance: factor by which the given variances were too small; correlation: how much larger the
    variance of slow trajectories is than that of white noise; gross: rejected points; excluded:
    rows of targets left out; blocks: the epochs behind each row of a long series, or None; hidden,
    movement: what the likelihood integrates out (`random_effects`), or None; tremble (P, t):
    directions in which each epoch moves by itself, of unit variance; bend (E, T, 2) px: curvature
    of the projection that was taken off the observations, or None.
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
        """The same in other px per unit of each column (19,)."""
        f = self.scale / scale  # a scaled value is unit × scale
        return replace(
            self,
            scale=scale,
            columns=self.columns * f,
            N=self.N * np.outer(f, f),
            b=self.b * f,
            values=self.values / f,
            hidden=replace(self.hidden, vectors=self.hidden.vectors * f) if self.hidden else None,
        )

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The number of the epoch of each row; of a block, of its first epoch."""
        every = self.source.numbers
        return every if self.blocks is None else every[self.blocks.first]

    def states(self, channel: str, operator: csr_array) -> Array:
        """∂ trajectory / ∂ independent errors, dense, from ∂ trajectory / ∂ knots (epochs, K)."""
        result = operator @ self.thermometers[channel].mixing
        if self.blocks is not None:
            result = self.blocks.average @ result @ self.blocks.pool
        return np.asarray(result.toarray())

    def state_sd(self, channel: str) -> Array:
        """Standard deviations of the independent errors, K."""
        sd = self.thermometers[channel].sd
        return sd if self.blocks is None else self.blocks.pooled_sd(sd)

    def state_deviation(self, channel: str) -> Array:
        """Readings minus smooth trajectory as far as the independent errors hold it, K."""
        deviation = self.thermometers[channel].deviation
        return deviation if self.blocks is None else self.blocks.pooled_mean(deviation)

    def averaged(self, trajectory: Array) -> Array:
        """A trajectory (epochs, …) on the rows of the normal equations."""
        return trajectory if self.blocks is None else np.asarray(self.blocks.average @ trajectory)

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

    @property
    def dof(self) -> float:
        """Image coordinates that the free cameras do not use up."""
        return float(np.sum(2 * self.n - self.N.shape[1]))


def solve(N: Array, b: Array) -> Array:
    """Batched solution; a camera of too few targets is held by a weak prior of 1000 px."""
    k = N.shape[-1]
    return np.asarray(np.linalg.solve(N + 1e-6 * np.eye(k), b[..., None])[..., 0], dtype=float)
