"""Observations of many epochs, and their normal equations at one common linearisation point.

A static camera sees the same field in every epoch, so that the partial derivatives are one array
for the whole series, and epochs differ only in weights and residuals. All normal matrices are then
one matrix product: (epochs × targets) · (targets × products of partials). Series adjustment, filter
and discovery work on these sums.

In memory the coordinates come before the epochs, so that all x, or all weights of x, are
contiguous; callers see the documented shapes.

Source: Luhmann et al. (2014), section 2.4.4; the reduction of common unknowns as Mikhail and
Ackermann (1976), Observations and Least Squares, chapter 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, IOP, Sensor, partials, project
from thermocald.photogrammetry.field.testfield import FAR_ELSEWHERE, find_misplaced
from thermocald.photogrammetry.linalg import median_known, stacked_inverses

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField


_SAMPLE = 60  # epochs from which misplaced targets are found
_OFTEN = 0.2  # share of them that must show a target
_CHUNK_POINTS = 20_000  # processed at a time, to stay in the processor's cache


@dataclass(frozen=True, eq=False)
class ObservationGrid:
    """The observations of many epochs on one grid of epochs × targets of the test field.

    points (E, T, 2) px: NaN if a target was not observed; weights (E, T, 3) px⁻²: the elements xx,
    yy, xy of each point's inverse covariance, 0 if it was not observed, is rejected, or repeats an
    earlier epoch.
    """

    points: Array
    weights: Array

    @classmethod
    def from_observations(
        cls, field: TestField, epochs: Sequence[Observations | None]
    ) -> ObservationGrid:
        """Build the grid of the epochs' observations; an epoch that is None stays empty."""
        present = [(e, obs) for e, obs in enumerate(epochs) if obs is not None and len(obs)]
        shape = (len(epochs), len(field))
        if not present:
            return cls(np.full((*shape, 2), np.nan), np.zeros((*shape, 3)))
        xy = [np.zeros(len(o)) if o.covariances is None else o.covariances for _, o in present]
        return cls.from_rows(
            shape,
            np.repeat([e for e, _ in present], [len(obs) for _, obs in present]),
            np.concatenate([obs.targets for _, obs in present]),
            np.concatenate([obs.points for _, obs in present]),
            np.concatenate([obs.sigmas for _, obs in present]),
            np.concatenate(xy),
        )

    @classmethod
    def from_rows(
        cls,
        shape: tuple[int, int],
        epochs: Index,
        targets: Index,
        measured: Array,
        sigmas: Array,
        covariances: Array | None = None,
    ) -> ObservationGrid:
        """Build the grid of n image points; an epoch that repeats an earlier one has no weight.

        shape: numbers of epochs and targets; epochs, targets (n,): of the points; measured, sigmas
        (n, 2) px; covariances (n,) px²: of x and y.
        """
        points, weights = planes(2, *shape), planes(3, *shape)
        points[...] = np.nan
        weights[...] = 0.0
        xy = np.zeros(len(epochs)) if covariances is None else covariances
        points[epochs, targets] = measured
        weights[epochs, targets] = inverses_of(sigmas[:, 0] ** 2, sigmas[:, 1] ** 2, xy)
        grid = cls(points, weights)
        weights[grid.repeated] = 0.0
        return grid

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: slice | Index) -> ObservationGrid:
        return ObservationGrid(self.points[rows], self.weights[rows])

    def blocks(
        self, windows: Sequence[slice] | None = None, size: int = 1000
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield grids of at most `size` consecutive epochs, each after its first epoch (from 0).

        windows: only the epochs of these slices, ascending.
        """
        for rows in runs(len(self), size, windows):
            yield rows.start, self[rows]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with one component after the other, so that the copy has the same order."""
        parts = (np.ascontiguousarray(np.moveaxis(a, -1, 0)) for a in (self.points, self.weights))
        return _of_planes, tuple(parts)

    @property
    def observed(self) -> Mask:
        """Mask (E, T) of the points with a weight."""
        return self.weights[..., 0] > 0

    @property
    def repeated(self) -> Mask:
        """Mask (E,) of the epochs with the image points of an earlier one."""
        keys = [hash(points.tobytes()) for points in self.points]
        later = np.ones(len(keys), dtype=bool)
        later[np.unique(keys, return_index=True)[1]] = False
        return later & np.isfinite(self.points[..., 0]).any(axis=1)

    def targets(self, columns: Index) -> ObservationGrid:
        """Return the grid of some targets."""
        if len(columns) == self.points.shape[1]:
            return self
        return ObservationGrid(self.points[:, columns], self.weights[:, columns])

    def reject(self, mask: Mask) -> ObservationGrid:
        """Return the grid with the observations of a mask (E, T) or (T,) without weight."""
        if not mask.any():
            return self
        weights = self.weights.copy(order="K")
        weights[np.broadcast_to(mask, weights.shape[:2])] = 0.0
        return ObservationGrid(self.points, weights)


def inverses_of(xx: Array, yy: Array, xy: Array) -> Array:
    """Invert covariances of image points (n,); return the weights (n, 3) xx, yy, xy."""
    return np.asarray(np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None])


def as_matrices(elements: Array) -> Array:
    """Return matrices (n, 2, 2) from their elements (n, 3) xx, yy, xy."""
    return np.stack([elements[:, [0, 2]], elements[:, [2, 1]]], axis=1)


def _of_planes(points: Array, weights: Array) -> ObservationGrid:
    """Unpickle a grid: points (2, E, T), weights (3, E, T)."""
    return ObservationGrid(np.moveaxis(points, 0, -1), np.moveaxis(weights, 0, -1))


@dataclass(frozen=True, eq=False)
class Partials:
    """A linearisation: iop (10,), eop (6,), predicted (T, 2) px, A (T, 2, 16), B (T, 2, 3)."""

    iop: Array
    eop: Array
    predicted: Array
    A: Array
    B: Array


def linearise(sensor: Sensor, field: TestField, iop: ArrayLike, eop: ArrayLike) -> Partials:
    """Compute the partials of all targets for one camera; 0 for targets behind it."""
    i, e = np.asarray(iop, dtype=float), np.asarray(eop, dtype=float)
    predicted, A, B = partials(sensor, i, e, field.points)
    seen = np.isfinite(predicted[:, 0])
    A[~seen], B[~seen] = 0.0, 0.0
    return Partials(i, e, predicted, A, B)


def normal_matrices(weights: Array, A: Array) -> Array:
    """Return Σ Aᵀ P A (E, k, k) of every epoch, for weights (E, T, 3) and A (T, 2, k)."""
    k = A.shape[-1]
    rows, columns = np.triu_indices(k)
    xx, yy, xy = products(A)
    if np.array_equal(weights[..., 0], weights[..., 1]):
        flat = weights[..., 0] @ (xx + yy)
    else:
        flat = weights[..., 0] @ xx + weights[..., 1] @ yy
    if np.any(weights[..., 2]):
        flat += weights[..., 2] @ xy
    pair = np.empty((k, k), dtype=np.int64)  # an element's column in `flat`
    pair[rows, columns] = pair[columns, rows] = np.arange(len(rows))
    return np.take(flat, pair, axis=1)


def products(A: Array) -> tuple[Array, Array, Array]:
    """Multiply partials (T, 2, k) for each pair of parameters: x by x, y by y, and x by y.

    Returns three arrays (T, k(k+1)/2); the pairs are those of `np.triu_indices(k)`.
    """
    rows, columns = np.triu_indices(A.shape[-1])
    x, y = np.ascontiguousarray(A[:, 0].T), np.ascontiguousarray(A[:, 1].T)
    xy = x[rows] * y[columns]
    xy += y[rows] * x[columns]
    return (x[rows] * x[columns]).T, (y[rows] * y[columns]).T, xy.T


def planes(components: int, epochs: int, targets: int) -> Array:
    """Allocate an array (epochs, targets, components) with one component after the other."""
    return np.moveaxis(np.empty((components, epochs, targets)), 0, -1)


def runs(count: int, size: int, windows: Sequence[slice] | None = None) -> Iterator[slice]:
    """Yield the rows of `count` epochs, at most `size` at a time.

    windows: only the rows of these slices, ascending; each starts a new run.
    """
    for window in windows or (slice(0, count),):
        for first in range(window.start, window.stop, size):
            yield slice(first, min(first + size, window.stop))


def chunks(epochs: int, targets: int) -> Iterator[slice]:
    """Yield the epochs in parts whose points stay in the processor's cache.

    Temporary arrays of a whole long series would also cost a page fault for every page.
    """
    return runs(epochs, max(_CHUNK_POINTS // max(targets, 1), 1))


def right_hand_sides(weights: Array, residuals: Array, A: Array, use: Mask | None = None) -> Array:
    """Return Aᵀ P l (E, k) of every epoch.

    use (E, T): mask of points, by default all with a weight; their residuals must not be NaN.
    """
    E, T = residuals.shape[:2]
    b = np.empty((E, A.shape[-1]))
    for part in chunks(E, T):
        x, y = _weighted(weights[part], residuals[part], None if use is None else use[part])
        np.matmul(x, A[:, 0], out=b[part])
        b[part] += y @ A[:, 1]
    return b


def sums_of_squares(weights: Array, residuals: Array, use: Mask | None = None) -> Array:
    """Return vᵀ P v (E,) of every epoch; use: as in `right_hand_sides`."""
    E, T = residuals.shape[:2]
    total = np.empty(E)
    for part in chunks(E, T):
        v = residuals[part]
        x, y = _weighted(weights[part], v, None if use is None else use[part])
        x *= v[..., 0]
        y *= v[..., 1]
        x += y
        x.sum(axis=1, out=total[part])
        # NaN of unobserved targets is excluded only if there is any: a test would cost a sum
        if np.isnan(total[part]).any():
            np.nansum(x, axis=1, out=total[part])
    return total


def sums_of_targets(weights: Array, residuals: Array, use: Mask) -> Array:
    """Return P v (T, 2) of every target, summed over the epochs of a mask `use` (E, T)."""
    total = np.zeros((residuals.shape[1], 2))
    for part in chunks(*residuals.shape[:2]):
        total += _weighted(weights[part], residuals[part], use[part]).sum(axis=1).T
    return total


def _weighted(weights: Array, residuals: Array, use: Mask | None) -> Array:
    """Return P v (2, E, T) of every point, 0 if it is not in use."""
    out = np.empty((2, *residuals.shape[:2]))
    correlated = weights[..., 2].any()
    for k in range(2):
        np.multiply(weights[..., k], residuals[..., k], out=out[k])
        if correlated:
            out[k] += weights[..., 2] * residuals[..., 1 - k]
    unused = weights[..., 0] == 0 if use is None else ~use
    if unused.any():
        out[:, unused] = 0.0
    return out


def cofactors(N: Array) -> tuple[Array, Mask]:
    """Invert matrices (E, p, p) in chunks, as `stacked_inverses` does."""
    inverse, good = np.empty(N.shape), np.empty(len(N), dtype=bool)
    for part in chunks(len(N), N.shape[-1] ** 2):
        inverse[part], good[part] = stacked_inverses(N[part])
    return inverse, good


def among_all(Q: Array, own: Index) -> Array:
    """Expand matrices (E, p, p) of some parameters to all (E, 16, 16), 0 for the others."""
    whole = np.zeros((len(Q), 16, 16))
    whole[:, own[:, None], own] = Q
    return whole


class ObservationBlocks(Protocol):
    """A source of the observations of consecutive epochs, on all targets of the field."""

    def __len__(self) -> int: ...

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield grids of consecutive epochs, each after its first epoch (from 0).

        windows: only the epochs of these slices, ascending.
        """
        ...


@dataclass(frozen=True, eq=False)
class WithoutTargets:
    """A source as if some targets (rows of the field) had never been observed."""

    source: ObservationBlocks
    targets: Index

    def __len__(self) -> int:
        return len(self.source)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield the blocks without the targets."""
        for first, grid in self.source.blocks(windows):
            yield first, grid.reject(np.isin(np.arange(grid.points.shape[1]), self.targets))


def often_shown(misclosure: Array) -> Array:
    """Return the median of misclosures (E, T, 2) over epochs, NaN for targets that few epochs show.

    Such a target may be where no other one determines the distortion.
    """
    shown = np.isfinite(misclosure[..., 0]).mean(axis=0)
    return np.where(shown[:, None] < _OFTEN, np.nan, median_known(misclosure))


def misplaced_targets(
    sensor: Sensor, testfield: TestField, grid: ObservationGrid, cameras: Array
) -> Mask:
    """Return a mask (T,) of targets far from their places as predicted by the epochs' cameras.

    cameras (E, 16): NaN for an unknown one.
    """
    rows = np.flatnonzero(np.isfinite(cameras).all(axis=1))
    rows = rows[:: max(len(rows) // _SAMPLE, 1)]
    if not len(rows):
        return np.zeros(len(testfield), dtype=bool)
    expected = project(sensor, cameras[rows, IOP], cameras[rows, EOP], testfield.points)
    misclosure = np.where(grid.observed[rows, :, None], grid.points[rows] - expected, np.nan)
    offsets = often_shown(misclosure)
    c_px = float(np.median(cameras[rows, 0])) / sensor.pixel_pitch
    return find_misplaced(offsets, c_px, FAR_ELSEWHERE)


def spread_windows(epochs: int, most: int, count: int = 12) -> tuple[slice, ...]:
    """Return `count` evenly spread runs of consecutive epochs, with `most` epochs in all.

    If there are no more epochs than that, one run has them all.
    """
    if epochs <= most:
        return (slice(0, epochs),)
    length = max(most // count, 1)
    starts = np.linspace(0, epochs - length, count).round().astype(int)
    return tuple(slice(int(start), int(start) + length) for start in starts)


def gathered(source: ObservationBlocks, windows: Sequence[slice] | None = None) -> ObservationGrid:
    """Read the epochs of some windows, by default all, into one grid."""
    if isinstance(source, ObservationGrid) and windows is None:
        return source
    return joined([grid for _, grid in source.blocks(windows)])


def joined(grids: Sequence[ObservationGrid]) -> ObservationGrid:
    """Return the grid of the epochs of several grids, one after the other."""
    if not grids:
        return ObservationGrid(planes(2, 0, 0), planes(3, 0, 0))
    points, weights = ([getattr(g, name) for g in grids] for name in ("points", "weights"))
    return ObservationGrid(np.concatenate(points), np.concatenate(weights))


def recut(
    blocks: Iterable[tuple[int, ObservationGrid]], length: int
) -> Iterator[tuple[int, ObservationGrid]]:
    """Yield the epochs of blocks `length` at a time, so that blocks do not depend on the reader."""
    begin, parts = 0, list[ObservationGrid]()
    for first, grid in blocks:
        if not parts:
            begin = first
        parts.append(grid)
        if sum(map(len, parts)) < length:
            continue
        whole = joined(parts)
        end = len(whole) // length * length
        for rows in runs(end, length):
            yield begin + rows.start, whole[rows]
        begin, parts = begin + end, [whole[end:]] if end < len(whole) else []
    if parts:
        yield begin, joined(parts)
