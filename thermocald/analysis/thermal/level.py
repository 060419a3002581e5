"""The level of a thermal model: interior orientation at T₀, exterior orientation of each series.

The drifts do not contribute and are removed. Each target's mean over a series, compared with the
model's projection, determines the interior orientation that all series share and one exterior
orientation per series. The affinity is the stated one, or none, unless the targets contradict it;
its uncertainty is in the covariance.

If the user names targets that have moved, the time and the vector of their movement are estimated,
relative to the camera that the other targets determine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.normals import linearise
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.thermal.reduce import running_median
from thermocald.thermal.scan import event_threshold

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.effect import Prediction
    from thermocald.physics.model import ThermalModel
    from thermocald.thermal.series import ReducedSeries


AFFINITY_SD = 3e-3  # of C1 and C2: fx and fy of phones differ by 1e-4 to 3e-3
_AFFINITY = [IOP_NAMES.index("C1"), IOP_NAMES.index("C2")]
_SHOWN = 13.8  # χ² with two degrees of freedom, 0.1 %: below it C1 and C2 keep the stated values
_ITERATIONS = 8


def average_residuals(
    series: ReducedSeries, prediction: Prediction
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the weighted mean of measured minus predicted image points (T, 2) px.

    Also returns its weights (T, 2), and which targets (T,) the model moves; of these only the
    epochs before their movement count.
    """
    moved = np.zeros(len(series.source.field), dtype=bool)
    use = series.weights[..., :2]
    for rows, _, active in prediction.displacements:
        moved[rows] = True
        if active.any():
            use = use.copy()
            use[np.ix_(active, rows)] = 0.0
    left = series.source.grid.points - project_targets(series, prediction)
    total = np.einsum("etc,etc->tc", use, np.where(use > 0, left, 0.0))
    weight = use.sum(axis=0)
    return total / np.where(weight > 0, weight, 1.0), weight, moved


def project_targets(series: ReducedSeries, prediction: Prediction) -> Array:
    """Return the model's image points (E, T, 2) px."""
    points = series.source.field.points
    if prediction.moves_points:
        points = prediction.points(points, slice(None))
    return project(series.source.sensor, prediction.iop, prediction.eop, points)


def estimate_level(
    series: Sequence[ReducedSeries], models: Sequence[ThermalModel], interior: bool = True
) -> tuple[tuple[ThermalModel, ...], Array]:
    """Estimate the level from the targets' means, by Gauss-Newton.

    models: one per series, with initial values; interior: estimate the interior orientation too,
    not only the series' exterior orientations. Returns the models with both, and the covariance
    (10, 10) that the test field's coordinates add to the interior orientation.
    """
    n = len(IOP_NAMES) if interior else 0
    shared = models[0].interior.as_array()
    eops = []
    for m in models:
        assert m.exterior is not None
        eops.append(m.exterior.as_array())
    size = n + 6 * len(series)
    field = series[0].source.field
    inverse, lever = np.zeros((size, size)), np.zeros((size, field.points.size))

    def placed(model: ThermalModel, k: int) -> ThermalModel:
        return replace(
            model,
            interior=InteriorOrientation.from_array(shared),
            exterior=ExteriorOrientation.from_array(eops[k]),
        )

    for _ in range(_ITERATIONS):
        M, g = np.zeros((size, size)), np.zeros(size)
        lever[:] = 0.0
        for k, (s, m) in enumerate(zip(series, models, strict=True)):
            now = placed(m, k)
            prediction = now.predict(s.history, s.source.field)
            mean, weight, _ = average_residuals(s, prediction)
            at = linearise(s.source.sensor, s.source.field, prediction.iop.mean(axis=0), eops[k])
            columns = np.concatenate([np.arange(n), n + 6 * k + np.arange(6)])
            A = at.A[:, :, 10 - n :]
            PA = A * weight[..., None]
            M[np.ix_(columns, columns)] += np.einsum("tci,tcj->ij", PA, A)
            g[columns] += np.einsum("tci,tc->i", PA, mean)
            lever[columns] += np.einsum("tci,tcx->itx", PA, at.B).reshape(len(columns), -1)
        if interior:
            M[_AFFINITY, _AFFINITY] += AFFINITY_SD**-2
            g[_AFFINITY] -= shared[_AFFINITY] / AFFINITY_SD**2
        inverse = inverse_of_determined(M)
        step = inverse @ g
        shared[:n] += step[:n]
        eops = [e + d for e, d in zip(eops, step[n:].reshape(-1, 6), strict=True)]
        if step @ M @ step < 1e-4:  # a hundredth of a standard deviation
            break
    moved = inverse[:n] @ (lever * field.sigmas.ravel())
    of_field = moved @ moved.T
    if interior:
        stated = series[0].source.interior or models[0].interior.with_values(C1=0.0, C2=0.0)
        off = shared[_AFFINITY] - stated.as_array()[_AFFINITY]
        noise = inverse[np.ix_(_AFFINITY, _AFFINITY)]
        if off @ np.linalg.solve(noise + of_field[np.ix_(_AFFINITY, _AFFINITY)], off) < _SHOWN:
            step = -inverse[:, _AFFINITY] @ np.linalg.solve(noise, off)
            shared[:n] += step[:n]
            shared[_AFFINITY] = stated.as_array()[_AFFINITY]  # exactly
            eops = [e + d for e, d in zip(eops, step[n:].reshape(-1, 6), strict=True)]
    return tuple(placed(m, k) for k, m in enumerate(models)), of_field


_GROSS = 6.0  # standard deviations from the neighbours in time
_NEIGHBOURS = 4  # epochs on either side


@dataclass(frozen=True, eq=False)
class Moved:
    """A step of targets: time s; vector (3,) mm with covariance, zeros if none was found."""

    time: float
    vector: Array
    covariance: Array

    def effect(self, listed: ModelEffect) -> ModelEffect:
        """Return the effect that names the targets, with the time and vector of their movement."""
        kind = catalogue.get(listed.name)
        time = {n: self.time for n, p in kind.nonlinear.items() if p.role == "event"}
        vector = dict(zip(kind.linear, self.vector.tolist(), strict=True))
        return ModelEffect(listed.name, {**listed.values, **vector, **time})


def estimate_step(others: ReducedSeries, rows: NDArray[np.int64]) -> Moved:
    """Estimate the step of some targets by one vector; others: the series reduced without them.

    A direction that the rays do not determine stays 0 and has no variance.
    """
    left = others.left_by_cameras(rows)
    seen = (others.source.grid.weights[:, rows, 0] > 0) & (others.n > 0)[:, None]
    left[~seen] = np.nan
    sd = others.sigma_px
    near = np.nan_to_num(running_median(left, _NEIGHBOURS))
    seen &= (np.abs(np.nan_to_num(left - near)) < _GROSS * sd).all(axis=2)
    v = np.where(seen[..., None], left, 0.0)
    before = np.cumsum(seen, axis=0)[:-1].astype(float)
    after = seen.sum(axis=0) - before
    sums = np.cumsum(v, axis=0)
    step = (sums[-1] - sums[:-1]) / np.maximum(after, 1)[..., None]
    step = step - sums[:-1] / np.maximum(before, 1)[..., None]
    weight = before * after / np.maximum(before + after, 1) / sd**2
    B = others.at.B[rows]
    N = np.einsum("et,tci,tcj->eij", weight, B, B)
    g = np.einsum("et,tci,etc->ei", weight, B, step)
    vectors = np.einsum("eij,ej->ei", np.linalg.pinv(N, rcond=1e-9, hermitian=True), g)
    gain = np.einsum("ei,ei->e", g, vectors)
    best = int(np.argmax(gain))
    _, time, _ = others.locate(float(others.times[best + 1]))
    if gain[best] < event_threshold(others, 3):
        return Moved(time, np.zeros(3), np.zeros((3, 3)))
    return Moved(time, vectors[best], inverse_of_determined(N[best]))
