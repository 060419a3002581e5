"""Effects of a drifting interior orientation on an object plane parallel to the sensor.

The plane is at a distance in front of the projection centre; a point is the intersection of an
image point's ray with it, (X, Y) mm in camera axes. First-order errors are the lengths of a
bivariate normal variable (Hoyt 1947, Proc. IRE 35, 652-657).

Monte-Carlo simulation: sets of IOP are drawn from a normal distribution with given standard
deviations and correlations; every image point of a grid is projected with every set onto the plane,
and its distance from the expected point is clustered (Elias et al. 2020, sections 3.2 and 4.4).
Sets are processed in chunks, so memory does not grow with their number. The same seed gives the
same sets, whatever the chunks.

The simulation holds for the drawn distribution only. IOP that drift with the temperature are not
normally distributed, and x0 and y0 that drift together are drawn with the adjustments' correlation.
Therefore every epoch's interior orientation itself is also compared with three that a user may hold
fixed: that of the first epoch, the mean of the series, and that of the last.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.analysis.camera.undistortion import ideal_points, image_grid, solve_distortion
from thermocald.analysis.statistics.dependence import pearson_matrix
from thermocald.arrays import spread_rows
from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, image_to_mm, partials

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.analysis.study.measured import MeasuredSeries, StudySettings
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor


_ANGLES = 720


def shares_within(axes: Array, distance: ArrayLike) -> Array:
    """Return P(|d| < distance), (k, m), of centred bivariate normal errors d; distance (m,) mm.

    axes (k, 2): standard deviations along the two axes of each point's ellipse, mm.
    """
    r2 = np.square(np.asarray(distance, dtype=float))
    theta = (np.arange(_ANGLES) + 0.5) * (np.pi / _ANGLES)
    spread = (axes[:, :1] * np.cos(theta)) ** 2 + (axes[:, 1:] * np.sin(theta)) ** 2
    with np.errstate(divide="ignore", over="ignore"):
        inside = -np.expm1(-r2[None, :, None] / (2 * spread[:, None, :]))
    return np.asarray(np.mean(inside, axis=-1))


def mean_and_largest(axes: Array, draws: int) -> tuple[Array, Array]:
    """Return E|d| (k,) mm and the expected largest |d| of `draws` errors; axes (k, 2)."""
    from scipy.special import ellipe

    small, large = np.sort(axes, axis=1).T
    ratio = np.divide(small, large, out=np.zeros_like(small), where=large > 0)
    steps = np.linspace(0.0, 8.0, 1601)
    largest = np.zeros(len(large))
    for k in np.flatnonzero(large > 0):
        missing = 1 - shares_within(axes[k : k + 1], steps * large[k])[0] ** draws
        largest[k] = large[k] * float(np.sum((missing[1:] + missing[:-1]) * np.diff(steps)) / 2)
    return np.asarray(np.sqrt(2 / np.pi) * large * ellipe(1 - ratio**2)), largest


def on_plane(sensor: Sensor, iop: ArrayLike, points: Array, distance_mm: float) -> Array:
    """Project image points (k, 2) px to the plane (k, 2) mm. Raises GeometryError without a ray."""
    return distance_mm * ideal_points(sensor, iop, points)


def plane_jacobian(sensor: Sensor, iop: ArrayLike, points: Array, distance_mm: float) -> Array:
    """Return ∂(X, Y)/∂iop (k, 2, 10) of image points (k, 2) px, mm per unit of each IOP."""
    plane = on_plane(sensor, iop, points, distance_mm)
    object_points = np.column_stack([plane, np.full(len(plane), -distance_mm)])
    _, by_parameter, by_object = partials(sensor, iop, np.zeros(6), object_points)
    solved = np.linalg.solve(by_object[:, :, :2], by_parameter[:, :, :10])
    return np.asarray(-solved, dtype=np.float64)


def plane_covariance(jacobian: Array, root: Array) -> Array:
    """Propagate the covariance of a root (m, 10) by ∂(X, Y)/∂iop (k, 2, 10) to (k, 2, 2) mm²."""
    return np.asarray(jacobian @ (root.T @ root) @ np.swapaxes(jacobian, 1, 2))


_CHUNK = 512
_CONVERGED = 1e-6  # px, a last step that leaves an error far below


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """The covariance of the Monte-Carlo simulation propagated to first order, per grid point, mm.

    covariance (k, 2, 2) mm²; mean (k,); expected_largest (k,): for the number of draws of the
    simulation; fractions (m+1,): of the clusters over all points.
    """

    covariance: Array
    mean: Array
    expected_largest: Array
    fractions: Array


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """The distances on the plane from a Monte-Carlo simulation, per grid point, mm.

    image_points (k, 2) px; expected (k, 2) mm; counts (k, m+1): sets per cluster with the limits
    `clusters_mm`; mean, largest (k,); mean_error (k, 2): second-order bias; covariance (k, 2, 2)
    mm²; sample (s, k, 2): errors of the first chunk; folded: sets left out as they have no ray;
    jacobian (k, 2, 10): ∂(X, Y)/∂iop; root (m, 10): of the covariance of the draws.
    """

    sets: int
    seed: int
    distance_mm: float
    clusters_mm: tuple[float, ...]
    image_points: Array
    expected: Array
    counts: NDArray[np.int64]
    mean: Array
    largest: Array
    mean_error: Array
    covariance: Array
    sample: Array
    folded: int
    jacobian: Array
    root: Array

    @cached_property
    def first_order(self) -> FirstOrder:
        """What the same covariance gives to first order."""
        covariance = plane_covariance(self.jacobian, self.root)
        axes = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
        below = np.mean(shares_within(axes, self.clusters_mm), axis=0)
        shares = np.diff(below, prepend=0.0, append=1.0)
        return FirstOrder(covariance, *mean_and_largest(axes, self.sets), shares)

    @property
    def fractions(self) -> Array:
        """Fraction of all distances in each cluster (m+1,)."""
        return np.asarray(self.counts.sum(axis=0) / self.counts.sum())

    @property
    def overall_mean(self) -> float:
        """Mean distance over all sets and points, mm."""
        return float(self.mean.mean())

    @property
    def mean_largest(self) -> float:
        """Mean of the points' largest distances, mm."""
        return float(self.largest.mean())


def draw_root(sds: Array, correlation: Array) -> Array:
    """Return a root (k, 10) of the covariance from sds (10,) and correlation (10, 10).

    k is the number of parameters with sd > 0, so that held ones cost nothing. A correlation matrix
    that element-wise medians made indefinite loses its negative eigenvalues, and its diagonal is
    restored.
    """
    free = np.flatnonzero(sds > 0)
    r = correlation[np.ix_(free, free)]
    values, vectors = np.linalg.eigh(0.5 * (r + r.T))
    # unlike other roots, the symmetric one depends neither on the signs nor on the order of the
    # eigenvectors: nearly the same matrix gives nearly the same draws
    factor = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    factor /= np.linalg.norm(factor, axis=1, keepdims=True)
    root = np.zeros((len(free), len(sds)))
    root[:, free] = (factor * sds[free, None]).T
    return root


def simulate_errors(
    sensor: Sensor,
    iop: Array,
    sds: Array,
    correlation: Array,
    settings: StudySettings,
    progress: Callable[[int], None] | None = None,
) -> MonteCarlo:
    """Draw IOP about `iop` (10,) and cluster the errors on the plane.

    sds (10,) in the units of the IOP, correlation (10, 10); progress receives the number of sets
    done. Raises GeometryError if a grid point has no expected point, or if fewer than two sets have
    rays.
    """
    points, sets, limits = image_grid(sensor, settings.grid), settings.sets, settings.clusters_mm
    root = draw_root(sds, correlation)
    expected = on_plane(sensor, iop, points, settings.distance_mm)
    jacobian = plane_jacobian(sensor, iop, points, settings.distance_mm)
    first_order = np.moveaxis(jacobian @ root.T, 1, 0)
    k = len(points)
    beyond = np.zeros((k, len(limits)), dtype=np.int64)
    largest, sums = np.zeros(k), np.zeros((k, 6))
    sample = np.empty((0, k, 2))
    rng = np.random.default_rng(settings.seed)
    used = 0
    for done in range(0, sets, _CHUNK):
        normal = rng.standard_normal((min(_CHUNK, sets - done), len(root)))
        errors = plane_errors(
            sensor, iop + normal @ root, points, expected, settings.distance_mm,
            first_order @ normal.T,
        )  # fmt: skip
        dx, dy = errors if np.isfinite(errors).all() else errors[:, :, np.isfinite(errors[0, 0])]
        distance = np.sqrt(dx * dx + dy * dy)
        used += distance.shape[1]
        beyond += np.stack([np.count_nonzero(distance >= one, axis=1) for one in limits], axis=1)
        np.maximum(largest, distance.max(axis=1, initial=0.0), out=largest)
        squares = [np.einsum("ij,ij->i", a, b) for a, b in ((dx, dx), (dy, dy), (dx, dy))]
        rows = [distance.sum(axis=1), dx.sum(axis=1), dy.sum(axis=1), *squares]
        sums += np.stack(rows, axis=1)
        if not done:
            sample = np.stack([dx.T, dy.T], axis=-1)
        if progress is not None:
            progress(len(normal))
    folded = sets - used
    if used < 2:
        raise GeometryError(
            f"{folded} of {sets} drawn interior orientations fold the image over itself: the "
            "standard deviations of the distortion parameters are too large to simulate with"
        )
    counts = -np.diff(beyond, axis=1, prepend=used, append=0)
    means = sums / used
    mean_error = means[:, 1:3]
    second = means[:, [3, 5, 5, 4]].reshape(k, 2, 2)
    covariance = second - mean_error[:, :, None] * mean_error[:, None, :]
    return MonteCarlo(
        sets, settings.seed, settings.distance_mm, settings.clusters_mm, points, expected,
        counts, means[:, 0], largest, mean_error, covariance, sample, folded,
        jacobian, root,
    )  # fmt: skip


def plane_errors(
    sensor: Sensor, sets: Array, points: Array, expected: Array, distance_mm: float,
    start: Array | None = None,
) -> Array:  # fmt: skip
    """Return the errors in X and Y (2, k, n) mm of image points (k, 2) px for sets (n, 10).

    expected (k, 2): points on the plane, mm, as `on_plane` gives them; start (2, k, n): approximate
    errors, mm. A set that has no ray for one of the points has NaN for all.
    """
    sets, middle = np.asfortranarray(sets), expected.T[..., None]
    scale = distance_mm / sets[:, 0]
    # (k, n, 1): one point per camera at a time, as the camera model broadcasts
    ideal = ((middle if start is None else middle + start) / scale)[..., None]
    measured = image_to_mm(sensor, points).T[..., None, None]
    solved = solve_distortion(sets, measured, ideal, _CONVERGED * sensor.pixel_pitch)
    errors = ideal[..., 0]
    errors[:, :, ~solved.all(axis=(0, 2))] = np.nan  # they may be so large that a product overflows
    errors *= scale
    errors -= middle
    return np.asarray(errors)


_MOST_EPOCHS = 2000  # per series, evenly spread


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The errors on the plane over all epochs of all series, relative to a fixed orientation.

    reference: first, mean or last; fractions (m+1,): of the distances of all epochs and image
    points in each cluster; mean mm; mean_largest: mean of the image points' largest distances, mm;
    epochs: number used.
    """

    JSON: ClassVar = {"mean": "mean_mm", "mean_largest": "mean_of_maxima_mm"}

    reference: str
    fractions: Array
    mean: float
    mean_largest: float
    epochs: int


def trajectories(
    series: Sequence[MeasuredSeries], distance_mm: float, size: int, clusters_mm: Sequence[float]
) -> tuple[Trajectory, ...]:
    """Compare one camera's epochs with its first, mean and last interior orientation.

    size: image points per row and column; each series has references of its own. Raises
    GeometryError if a reference has no ray for an image point.
    """
    found = []
    series = [one for one in series if len(one) > 1]
    for reference in ("first", "mean", "last") if series else ():
        distances = []
        for one in series:
            rows = spread_rows(len(one), _MOST_EPOCHS)
            fixed = {"first": one.values[0], "mean": one.mean, "last": one.values[-1]}[reference]
            points = image_grid(one.sensor, size)
            expected = on_plane(one.sensor, fixed, points, distance_mm)
            errors = plane_errors(one.sensor, one.values[rows], points, expected, distance_mm)
            away = np.hypot(*errors).T
            distances.append(away[np.isfinite(away[:, 0])])
        every = np.concatenate(distances)
        below = [float(np.mean(every < limit)) for limit in clusters_mm]
        found.append(
            Trajectory(
                reference,
                np.diff(below, prepend=0.0, append=1.0),
                float(every.mean()),
                float(np.mean([d.max(axis=0).mean() for d in distances])),
                len(every),
            )
        )
    return tuple(found)


def correlations_over_time(series: Sequence[MeasuredSeries]) -> Array:
    """Return Pearson's r (10, 10) of the IOP over the epochs, about each series' own mean.

    NaN for parameters that were held or did not change.
    """
    columns = []
    for name in IOP_NAMES:
        known = [
            one.column(name)[0] if name in one.free else np.full(len(one), np.nan) for one in series
        ]
        columns.append(np.concatenate([values - values.mean() for values in known]))
    return pearson_matrix(columns)
