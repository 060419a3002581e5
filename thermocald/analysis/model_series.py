"""A series as the fit of a thermal model needs it: normal equations per epoch, and its readings.

Every epoch is reduced once, at the series' mean orientation, to a normal matrix over the camera's
16 parameters, the scale of the object coordinates along three axes, and a common displacement of
some targets. No image point is touched again, whatever is fitted (DESIGN idea 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.camera_model import PARAMETER_NAMES, project
from thermocald.photogrammetry.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
)
from thermocald.photogrammetry.orientation import approximate_orientation
from thermocald.photogrammetry.series import SeriesSettings, adjust_series
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.normals import Partials
    from thermocald.photogrammetry.testfield import TestField
    from thermocald.simulation.model import Prediction
    from thermocald.store.head import Head
    from thermocald.store.recording import Recording

    Array = NDArray[np.float64]

__all__ = ["N_PARAMETERS", "ModelSeries", "load_model_series", "model_series", "reduce_series"]

N_PARAMETERS = 22
"""16 parameters of the camera, 3 scales of the object coordinates, 3 of a displacement (mm)."""

_ENOUGH = 20  # image points without which an epoch says too little
_GROSS = 4.5  # standard deviations
_SAMPLE = 40  # epochs that tell the mean orientation
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class ModelSeries:
    """One series of one camera, reduced.

    name, camera; sensor; field; grid: the image points without gross errors; start (16,): the
    linearisation point; N (E, 22, 22), b (E, 22), lPl (E,): normal equations there; count (E,):
    image points; history: `times` are the frames'; resolution {channel: K}.
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

    def __len__(self) -> int:
        return len(self.lPl)

    def displacing(self, targets: tuple[str, ...]) -> ModelSeries:
        """The same with columns for the displacement of some targets."""
        rows = np.array([self.field.index[t] for t in targets if t in self.field.index], dtype=int)
        return _reduced(self, rows)

    def without_offsets(self, prediction: Prediction, noise: Array | None = None) -> ModelSeries:
        """The same with what a prediction leaves of each target on average taken off.

        A constant per target is the field's coordinates (or a lens that no polynomial describes),
        and no drift. Of targets that move, what was before counts. noise (E,): how the epochs
        weigh in the average.
        """
        left = self.residuals(prediction)
        moving = [d.rows for d in prediction.displacements]
        for d in prediction.displacements:
            left[np.ix_(d.active, d.rows)] = np.nan
        seen = np.isfinite(left)
        weight = seen if noise is None else seen / noise[:, None, None] ** 2
        total = np.maximum(weight.sum(axis=0), 1e-300)
        offsets = (weight * np.where(seen, left, 0.0)).sum(axis=0) / total
        rows = np.concatenate(moving) if moving else np.zeros(0, dtype=np.int64)
        grid = ObservationGrid(self.grid.points - offsets, self.grid.weights)
        return _reduced(replace(self, grid=grid), rows)

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
        d = np.zeros((len(self), N_PARAMETERS))
        d[:, :10] = prediction.iop - self.start[:10]
        d[:, 10:16] = prediction.eop - self.start[10:]
        d[:, 16:19] = prediction.scale - 1.0
        for displacement in prediction.displacements:
            d[:, 19:22] += displacement.active[:, None] * displacement.vector
        return d

    def residuals(self, prediction: Prediction) -> Array:
        """Measured minus predicted (E, T, 2) px, NaN where nothing was measured."""
        still = self.field.points
        points = prediction.points(still) if prediction.moves_points else still
        predicted = project(self.sensor, prediction.iop, prediction.eop, points)
        found: Array = np.where(self.grid.observed[..., None], self.grid.points - predicted, np.nan)
        return found


def load_model_series(path: Path) -> list[ModelSeries]:
    """Reduce the series of a recording (a folder) or of a store (a file).

    DataError where there are no measurements or no temperature.
    """
    if path.is_dir():
        from thermocald.store.recording import read_recording

        recording = read_recording(path)
        if not recording.has_observations:
            raise DataError(
                f"{path}: holds frames, not measurements; measure them into a store first: "
                f"thermocald replay {path}"
            )
        return [model_series(recording)]
    from thermocald.store.database import Store

    with Store.open(path) as store:
        found = [
            reduce_series(
                s.head, s.testfield, [e.epoch for e in store.epochs(s)], f"{path}: {s.name}"
            )
            for s in store.all_series()
        ]
    if not found:
        raise DataError(f"{path}: the store holds no series")
    return found


def model_series(recording: Recording, keep_targets: tuple[str, ...] = ()) -> ModelSeries:
    """Reduce a recording; see `reduce_series`."""
    return reduce_series(
        recording.head,
        recording.testfield,
        list(recording.epochs),
        str(recording.path),
        keep_targets,
    )


def reduce_series(
    head: Head,
    field: TestField,
    epochs: list[Epoch],
    source: str,
    keep_targets: tuple[str, ...] = (),
) -> ModelSeries:
    """Find the mean orientation and the gross errors, and reduce every epoch.

    keep_targets: targets that must not be thrown out, because they are thought to move.
    """
    if not head.channels:
        raise DataError(f"{source}: has no temperature column; a thermal model needs one")
    sensor = head.camera.sensor
    whole = ObservationGrid.from_observations(field, [e.observations for e in epochs])
    enough = whole.observed.sum(axis=1) >= _ENOUGH
    if enough.sum() < 3:
        raise DataError(f"{source}: fewer than 3 epochs show {_ENOUGH} targets or more")
    epochs = [e for e, ok in zip(epochs, enough, strict=True) if ok]
    grid = ObservationGrid(whole.points[enough], whole.weights[enough])
    most = int(grid.observed.sum(axis=1).argmax())
    seen = grid.observed[most]
    interior, exterior, _ = approximate_orientation(
        sensor, field.points[seen], grid.points[most, seen], head.camera.principal_distance
    )
    mean = _mean_orientation(sensor, field, grid, interior, exterior)
    at = linearise(sensor, field, mean[:10], mean[10:])
    kept = [field.index[t] for t in keep_targets if t in field.index]
    clean = grid.reject(_gross_errors(grid, at, kept))
    series = ModelSeries(
        head.series,
        head.camera.name,
        sensor,
        field,
        clean,
        mean,
        np.empty(0),
        np.empty(0),
        np.zeros(len(epochs)),
        clean.observed.sum(axis=1),
        History.from_epochs(epochs, next(iter(head.channels)), 0.0),
        {name: c.resolution or 0.0 for name, c in head.channels.items()},
        source,
    )
    return _reduced(series, np.zeros(0, dtype=np.int64))


def _mean_orientation(
    sensor: Sensor,
    field: TestField,
    grid: ObservationGrid,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
) -> Array:
    """The mean (16,) of some epochs adjusted together."""
    sample = np.unique(np.linspace(0, len(grid.points) - 1, _SAMPLE).astype(int))
    some = ObservationGrid(grid.points[sample], grid.weights[sample])
    settings = SeriesSettings(exterior="series", target_noise=False)
    adjusted = adjust_series(sensor, field, some, interior, exterior, settings)
    if not adjusted.ok.any():
        raise DataError(f"no epoch could be adjusted: {adjusted.reasons[0]}")
    mean: Array = adjusted.values[adjusted.ok].mean(axis=0)
    return mean


def _gross_errors(grid: ObservationGrid, at: Partials, keep: list[int]) -> NDArray[np.bool_]:
    """Gross errors (E, T).

    Every epoch is given all 16 parameters of its own, every target its constant offset. A gross
    error is beyond 4.5 times the noise of its own epoch: one sigma for all would cut off the tails
    of epochs that heat defocuses, and make them look better than they are.
    """
    observed = grid.observed
    misclosure = grid.points - at.predicted
    offsets = np.zeros(at.predicted.shape)
    use = observed
    for _ in range(_ROUNDS):
        weights = np.where(use[..., None], grid.weights, 0.0)
        N = normal_matrices(weights, at.A)
        b, _ = right_hand_sides(weights, misclosure - offsets, at.A)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(N, axis1=1, axis2=2), 1e-300))
        # a weak field determines some parameters badly: those are held, not blown up
        scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-10 * np.eye(N.shape[1])
        step = scale * np.linalg.solve(scaled, (scale * b)[..., None])[..., 0]
        left = misclosure - offsets - np.einsum("tcp,ep->etc", at.A, step)
        size = np.where(observed[..., None], np.abs(left), np.nan)
        noise = 1.4826 * np.nanmedian(size.reshape(len(size), -1), axis=1)
        use = observed & (np.nan_to_num(size) <= _GROSS * noise[:, None, None]).all(axis=2)
        use[:, keep] = observed[:, keep]
        count = np.maximum(use.sum(axis=0), 1)[:, None]
        offsets = offsets + np.where(use[..., None], left, 0.0).sum(axis=0) / count
    return observed & ~use


def _reduced(series: ModelSeries, displaced: NDArray[np.int64]) -> ModelSeries:
    at = linearise(series.sensor, series.field, series.start[:10], series.start[10:])
    A = np.zeros((len(series.field), 2, N_PARAMETERS))
    A[:, :, : len(PARAMETER_NAMES)] = at.A
    A[:, :, 16:19] = at.B * series.field.points[:, None, :]
    A[displaced, :, 19:22] = at.B[displaced]
    weights = series.grid.weights
    b, lPl = right_hand_sides(weights, series.grid.points - at.predicted, A)
    return replace(series, N=normal_matrices(weights, A), b=b, lPl=lPl)
