"""Monte-Carlo: what a drifting interior orientation does to points on an object plane.

Sets of IOP are drawn from a normal distribution with given standard deviations and correlations;
every image point of a grid is projected with every set on a plane parallel to the sensor, and its
distance to the expected point is clustered (Elias et al. 2020, sections 3.2 and 4.4). Drawing,
projection and clustering go through the sets in chunks, so memory does not grow with their number.
Seeded: the same seed gives the same sets, whatever the chunks.

It answers for the drawn distribution only. IOP that drift with the temperature are not normally
distributed, and x0 and y0 that drift together are drawn with the adjustments' correlation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study.object_plane import on_plane, plane_jacobian
from thermocald.errors import GeometryError
from thermocald.parallel import in_order
from thermocald.photogrammetry.camera.camera_model import image_to_mm

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["CLUSTERS_MM", "MonteCarlo", "draw_root", "plane_errors", "simulate_errors"]

CLUSTERS_MM = (15.0, 50.0, 100.0)
_CHUNK = 1024
_SAMPLE = 1500
_STEPS = 30
_CONVERGED = 1e-12  # of the distance: 1e-8 mm at 10 m


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Distances on the plane, per grid point (k,), mm.

    image_points (k, 2) px; expected (k, 2) mm; counts (k, m+1): sets per cluster, limits
    `clusters_mm`; mean, largest (k,); mean_error (k, 2): second-order bias; covariance (k, 2, 2)
    mm²; sample (s, k, 2): errors of the first sets; folded: sets without a ray, left out.
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

    @property
    def fractions(self) -> Array:
        """Fraction of all distances per cluster (m+1,)."""
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
    """A matrix (k, 10) with rootᵀ root = the covariance of sds (10,) and correlation (10, 10).

    k is the number of parameters with sd > 0, so that held ones cost nothing. A correlation matrix
    that element-wise medians left indefinite is taken to the nearest by its eigenvalues, its
    diagonal restored.
    """
    free = np.flatnonzero(sds > 0)
    r = correlation[np.ix_(free, free)]
    values, vectors = np.linalg.eigh(0.5 * (r + r.T))
    # The symmetric root: unlike other roots it depends neither on the signs nor on the order of the
    # eigenvectors, so that nearly the same matrix gives nearly the same draws.
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
    *,
    sets: int = 50_000,
    seed: int = 0,
    distance_mm: float = 10_000.0,
    grid: int = 3,
    clusters_mm: tuple[float, ...] = CLUSTERS_MM,
    progress: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> MonteCarlo:
    """Draw IOP about `iop` (10,) and cluster the errors on the plane.

    sds (10,) in the units of the IOP, correlation (10, 10); progress receives how many sets were
    done; jobs: processes that project them, with the same bits for any number. Raises
    GeometryError where the expected point of a grid point does not exist.
    """
    points = image_grid(sensor, grid)
    root = draw_root(sds, correlation)
    project = _PlaneErrors(sensor, iop, points, distance_mm)
    k = len(points)
    limits = np.asarray(clusters_mm)
    counts = np.zeros((k, len(limits) + 1), dtype=np.int64)
    total, largest = np.zeros(k), np.zeros(k)
    first, second = np.zeros((k, 2)), np.zeros((k, 2, 2))
    sample: list[Array] = []
    rng = np.random.default_rng(seed)
    folded = 0
    draws = (
        (rng.standard_normal((min(_CHUNK, sets - done), len(root))), max(_SAMPLE - done, 0))
        for done in range(0, sets, _CHUNK)
    )
    for part in in_order(_simulated, (project, iop, root, limits), draws, jobs):
        folded += part.folded
        counts += part.counts
        total += part.total
        np.maximum(largest, part.largest, out=largest)
        first += part.first
        second += part.second
        if part.sample.size:
            sample.append(part.sample)
        if progress is not None:
            progress(part.sets)
    used = sets - folded
    if used < 2:
        raise GeometryError(
            f"{folded} of {sets} drawn sets of IOP fold the image over itself: the standard "
            "deviations of the distortion parameters are too large to simulate with"
        )
    mean_error = first / used
    second[:, 1, 0] = second[:, 0, 1]
    covariance = second / used - mean_error[:, :, None] * mean_error[:, None, :]
    return MonteCarlo(
        sets,
        seed,
        distance_mm,
        clusters_mm,
        points,
        project.expected,
        counts,
        total / used,
        largest,
        mean_error,
        covariance,
        np.concatenate(sample),
        folded,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Some of the sets, as in `MonteCarlo`; total, first, second: sums, not means."""

    sets: int
    folded: int
    counts: NDArray[np.int64]
    total: Array
    largest: Array
    first: Array
    second: Array
    sample: Array


def _simulated(known: tuple[_PlaneErrors, Array, Array, Array], draws: tuple[Array, int]) -> _Part:
    """Sets from standard normal numbers (n, r), and how many of them a sample still needs.

    known: the projection, the mean IOP (10,), the root (r, 10) of their covariance, the clusters.
    """
    (project, iop, root, limits), (normal, wanted) = known, draws
    dx, dy, ok = project(iop + normal @ root)
    folded = int(np.count_nonzero(~ok))
    if folded:
        dx, dy = dx[:, ok], dy[:, ok]
    k = len(dx)
    distance = np.sqrt(dx * dx + dy * dy)
    beyond = [np.count_nonzero(distance >= limit, axis=1) for limit in limits]
    edges = np.stack([np.full(k, distance.shape[1]), *beyond, np.zeros(k, dtype=np.int64)])
    second = np.zeros((k, 2, 2))
    second[:, 0, 0] = np.einsum("ij,ij->i", dx, dx)
    second[:, 1, 1] = np.einsum("ij,ij->i", dy, dy)
    second[:, 0, 1] = np.einsum("ij,ij->i", dx, dy)
    return _Part(
        len(normal), folded, -np.diff(edges, axis=0).T, distance.sum(axis=1),
        distance.max(axis=1, initial=0.0), np.stack([dx.sum(axis=1), dy.sum(axis=1)], axis=1),
        second, np.stack([dx[:, :wanted], dy[:, :wanted]], axis=-1).swapaxes(0, 1),
    )  # fmt: skip


def plane_errors(
    sensor: Sensor, iop: Array, sets: Array, points: Array, distance_mm: float
) -> Array:
    """Errors (n, k, 2) mm of image points (k, 2) px under sets (n, 10) against `iop` (10,)."""
    dx, dy, ok = _PlaneErrors(sensor, iop, points, distance_mm)(sets)
    errors = np.stack([dx.T, dy.T], axis=-1)
    errors[~ok] = np.nan
    return errors


class _PlaneErrors:
    """Errors of fixed image points under many sets of IOP.

    The ideal point of each set starts at its first-order value, where its Jacobian is evaluated
    once; two or three steps then are enough. A general inversion would start at the image point.
    """

    def __init__(self, sensor: Sensor, iop: Array, points: Array, distance_mm: float) -> None:
        self.expected = on_plane(sensor, iop, points, distance_mm)
        self._distance = distance_mm
        self._mm = image_to_mm(sensor, points)
        self._iop = iop
        scale = iop[0] / distance_mm
        self._tolerance = _CONVERGED * iop[0]
        self._ideal = self.expected * scale
        by_iop = plane_jacobian(sensor, iop, points, distance_mm) * scale
        # x̄ = X c / D: its own dependence on c joins that of the plane point.
        by_iop[:, :, 0] += self.expected / distance_mm
        self._by_iop = by_iop

    # a set that folds the image may run away; it has no rays
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def __call__(self, sets: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Sets (n, 10) → errors in X and Y (k, n) mm, and which sets have rays at all (n,)."""
        step = (sets - self._iop).T
        x = self._ideal[:, :1] + self._by_iop[:, 0] @ step
        y = self._ideal[:, 1:] + self._by_iop[:, 1] @ step
        distortion = _Distortion(sets)
        xm = self._mm[:, :1] - sets[:, 1]
        ym = self._mm[:, 1:] - sets[:, 2]
        ok = np.ones(len(sets), dtype=bool)
        rx, ry = distortion.residual(x, y, xm, ym)
        jxx, jxy, jyx, jyy = distortion.jacobian(x, y)
        inverse = 1.0 / (jxx * jyy - jxy * jyx)
        ok &= (inverse > 0).all(axis=0)
        jxx, jxy, jyx, jyy = jyy * inverse, jxy * inverse, jyx * inverse, jxx * inverse
        for _ in range(_STEPS):
            x += jxx * rx - jxy * ry
            y += jyy * ry - jyx * rx
            rx, ry = distortion.residual(x, y, xm, ym)
            if max(rx.max(), -rx.min(), ry.max(), -ry.min()) <= self._tolerance:
                break
        else:
            ok &= ((np.abs(rx) <= self._tolerance) & (np.abs(ry) <= self._tolerance)).all(axis=0)
        scale = self._distance / sets[:, 0]
        return x * scale - self.expected[:, :1], y * scale - self.expected[:, 1:], ok


class _Distortion:
    """The distortion of sets of IOP (n, 10) at points (k, n) mm; leaves out terms that are zero."""

    def __init__(self, sets: Array) -> None:
        columns = np.ascontiguousarray(sets.T)
        _, _, _, self._a1, self._a2, self._a3, self._b1, self._b2, self._c1, self._c2 = columns
        self._order = 3 if self._a3.any() else 2
        self._decentred = bool(self._b1.any() or self._b2.any())
        self._affine = bool(self._c1.any() or self._c2.any())

    def residual(self, x: Array, y: Array, xm: Array, ym: Array) -> tuple[Array, Array]:
        """Measured points (xm, ym), about the principal point, minus the distorted (x, y)."""
        self._r2 = r2 = x * x + y * y
        radial = r2 * self._a3 if self._order == 3 else np.zeros_like(r2)
        radial += self._a2
        radial *= r2
        radial += self._a1
        radial *= r2
        radial += 1
        self._one = radial
        if self._decentred:
            # B1 (r² + 2x²) + 2 B2 xy = 2x (B1 x + B2 y) + B1 r², and so for y.
            cross = self._b1 * x
            cross += self._b2 * y
            cross *= 2
            self._cross = cross
            radial = radial + cross
        rx, ry = xm - x * radial, ym - y * radial
        if self._decentred:
            rx -= self._b1 * r2
            ry -= self._b2 * r2
        if self._affine:
            rx -= self._c1 * x + self._c2 * y
        return rx, ry

    def jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """∂(distorted)/∂(x, y) at the points of the last `residual`."""
        slope = self._r2 * (6 * self._a3) if self._order == 3 else np.zeros_like(x)
        slope += 4 * self._a2
        slope *= self._r2
        slope += 2 * self._a1
        sx = slope * x
        jxx, jyy = self._one + sx * x, self._one + slope * y * y
        jxy = sx * y
        if self._decentred:
            b1, b2 = 2 * self._b1, 2 * self._b2
            jxx += self._cross + 2 * b1 * x
            jyy += self._cross + 2 * b2 * y
            jxy += b2 * x + b1 * y
        if not self._affine:
            return jxx, jxy, jxy, jyy
        return jxx + self._c1, jxy + self._c2, jxy, jyy
