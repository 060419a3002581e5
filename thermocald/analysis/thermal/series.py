"""A series as the fit of a thermal model needs it: normal equations per epoch, and its readings.

Every epoch is reduced once, at the series' mean orientation, to a normal matrix over the camera's
16 parameters, the scale of the object coordinates along three axes, and a common displacement of
some targets. No image point is touched again, whatever is fitted (DESIGN idea 2), but when the
projection's curvature is brought up to date.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES, project
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
    sums_of_squares,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import Partials
    from thermocald.simulation.history import History
    from thermocald.simulation.model import Prediction

    Array = NDArray[np.float64]

__all__ = ["N_PARAMETERS", "ModelSeries"]

N_PARAMETERS = 22
"""16 parameters of the camera, 3 scales of the object coordinates, 3 of a displacement (mm)."""


@dataclass(frozen=True, eq=False)
class ModelSeries:
    """One series of one camera, reduced.

    name, camera; sensor; field; grid: the image points without gross errors; start (16,): the
    linearisation point; N (E, 22, 22), b (E, 22), lPl (E,): normal equations there; count (E,):
    image points; history: `times` are the frames'; resolution {channel: K}; moving (k,): rows of
    the targets that the displacement's columns are of.
    """

    name: str
    camera: str
    sensor: Sensor
    field: TestField
    grid: ObservationGrid
    start: Array
    N: Array
    b: Array
    lPl: Array
    count: NDArray[np.int64]
    history: History
    resolution: dict[str, float]
    source: str = ""
    moving: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.lPl)

    @cached_property
    def at(self) -> Partials:
        """The projection and its derivatives by camera and object points at the start."""
        return linearise(self.sensor, self.field, self.start[:10], self.start[10:])

    @cached_property
    def partials(self) -> Array:
        """∂ image points / ∂ parameters at the linearisation point, (T, 2, 22) px."""
        at = self.at
        A = np.zeros((len(self.field), 2, N_PARAMETERS))
        A[:, :, : len(PARAMETER_NAMES)] = at.A
        A[:, :, 16:19] = at.B * self.field.points[:, None, :]
        if self.moving is not None:
            A[self.moving, :, 19:22] = at.B[self.moving]
        return A

    def reduced(self, prediction: Prediction | None = None) -> ModelSeries:
        """The same with its normal equations computed anew.

        prediction: near which the projection's curvature is taken into account; without it the
        projection counts as linear around the mean orientation.
        """
        at, A, weights = self.at, self.partials, self.grid.weights
        misclosure = self.grid.points - at.predicted
        if prediction is not None:
            linear = np.einsum("tcp,ep->etc", A, self.corrections(prediction))
            misclosure = misclosure - (self._projected(prediction) - at.predicted - linear)
        b = right_hand_sides(weights, misclosure, A)
        lPl = sums_of_squares(weights, misclosure)
        return replace(self, N=normal_matrices(weights, A), b=b, lPl=lPl)

    def displacing(self, targets: tuple[str, ...]) -> ModelSeries:
        """The same with columns for the displacement of some targets."""
        rows = np.array([self.field.index[t] for t in targets if t in self.field.index], dtype=int)
        return replace(self, moving=rows).reduced()

    def without_offsets(self, prediction: Prediction, noise: Array | None = None) -> ModelSeries:
        """The same with what a prediction leaves of each target on average taken off.

        A constant per target is the field's coordinates (or a lens that no polynomial describes),
        and no drift. Of targets that move, what was before counts. noise (E,): how the epochs
        weigh in the average. The normal equations are renewed near the prediction.
        """
        left = self.residuals(prediction)
        for d in prediction.displacements:
            left[np.ix_(d.active, d.rows)] = np.nan
        seen = np.isfinite(left)
        weight = seen if noise is None else seen / noise[:, None, None] ** 2
        total = np.maximum(weight.sum(axis=0), 1e-300)
        offsets = (weight * np.where(seen, left, 0.0)).sum(axis=0) / total
        grid = ObservationGrid(self.grid.points - offsets, self.grid.weights)
        return replace(self, grid=grid).reduced(prediction)

    def epochs(self, keep: NDArray[np.bool_]) -> ModelSeries:
        """Some of the epochs; the temperature history stays whole."""
        grid = ObservationGrid(self.grid.points[keep], self.grid.weights[keep])
        return replace(
            self,
            grid=grid,
            N=self.N[keep],
            b=self.b[keep],
            lPl=self.lPl[keep],
            count=self.count[keep],
            history=self.history.at(self.history.times[keep]),
        )

    def corrections(self, prediction: Prediction) -> Array:
        """Predicted parameters minus the linearisation point, (E, 22)."""
        d = np.zeros((len(prediction.iop), N_PARAMETERS))
        d[:, :10] = prediction.iop - self.start[:10]
        d[:, 10:16] = prediction.eop - self.start[10:]
        d[:, 16:19] = prediction.scale - 1.0
        for displacement in prediction.displacements:
            d[:, 19:22] += displacement.active[:, None] * displacement.vector
        return d

    def residuals(self, prediction: Prediction) -> Array:
        """Measured minus predicted (E, T, 2) px, NaN where nothing was measured."""
        predicted = self._projected(prediction)
        found: Array = np.where(self.grid.observed[..., None], self.grid.points - predicted, np.nan)
        return found

    def _projected(self, prediction: Prediction) -> Array:
        still = self.field.points
        points = prediction.points(still) if prediction.moves_points else still
        return project(self.sensor, prediction.iop, prediction.eop, points)
