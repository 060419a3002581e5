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
from thermocald.photogrammetry.camera_model import (
    IOP_NAMES,
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
)
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.photogrammetry.testfield import TestField
    from thermocald.simulation.model import Prediction
    from thermocald.store.recording import Recording

    Array = NDArray[np.float64]

__all__ = ["N_PARAMETERS", "ModelSeries", "load_model_series", "model_series"]

N_PARAMETERS = 22
"""16 parameters of the camera, 3 scales of the object coordinates, 3 of a displacement (mm)."""

_ENOUGH = 20  # image points without which an epoch says too little
_GROSS = 4.5  # standard deviations
_WARM_EPOCHS = 40  # a sample of epochs that tells the mean orientation


@dataclass(frozen=True, eq=False)
class ModelSeries:
    """One series of one camera, reduced.

    name, camera; sensor; field; grid: the image points without gross errors, in which constant
    offsets of targets are taken off; start (16,): the linearisation point; N (E, 22, 22),
    b (E, 22), lPl (E,): normal equations there; count (E,): image points; history: `times` are the
    frames'; resolution {channel: K}.
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


def load_model_series(path: Path) -> ModelSeries:
    """Reduce a recording; DataError where it has no observations or no temperature."""
    from thermocald.store.recording import read_recording

    recording = read_recording(path)
    if not recording.has_observations:
        raise DataError(
            f"{path}: holds frames, not measurements; measure them first: thermocald replay {path}"
        )
    if not recording.channels:
        raise DataError(f"{path}: has no temperature column; a thermal model needs one")
    return model_series(recording)


def model_series(recording: Recording, keep_targets: tuple[str, ...] = ()) -> ModelSeries:
    """Find the mean orientation and the gross errors, and reduce every epoch.

    keep_targets: targets that data snooping must not throw out, because they are thought to move.
    """
    from thermocald.photogrammetry.orientation import approximate_orientation
    from thermocald.photogrammetry.series import SeriesSettings, adjust_series

    field, sensor = recording.testfield, recording.camera.sensor
    reference = next(iter(recording.channels))
    epochs = list(recording.epochs)
    whole = ObservationGrid.from_observations(field, [e.observations for e in epochs])
    enough = whole.observed.sum(axis=1) >= _ENOUGH
    if enough.sum() < 3:
        raise DataError(f"{recording.path}: fewer than 3 epochs show {_ENOUGH} targets or more")
    epochs = [e for e, ok in zip(epochs, enough, strict=True) if ok]
    grid = ObservationGrid(whole.points[enough], whole.weights[enough])
    most = int(grid.observed.sum(axis=1).argmax())
    seen = grid.observed[most]
    interior, exterior, _ = approximate_orientation(
        sensor, field.points[seen], grid.points[most, seen], recording.camera.principal_distance
    )
    mean = _mean_orientation(sensor, field, grid, interior, exterior)
    settings = SeriesSettings(exterior="per_epoch", free=IOP_NAMES, target_noise=False)
    adjusted = adjust_series(
        sensor,
        field,
        grid,
        InteriorOrientation.from_array(mean[:10]),
        ExteriorOrientation.from_array(mean[10:]),
        settings,
    )
    rejected = _gross(adjusted.residuals)
    rejected[:, [field.index[t] for t in keep_targets if t in field.index]] = False
    offsets = np.nan_to_num(adjusted.offsets)
    clean = ObservationGrid(grid.points - offsets, grid.weights).reject(rejected)
    series = ModelSeries(
        recording.series,
        recording.camera.name,
        sensor,
        field,
        clean,
        mean,
        np.empty(0),
        np.empty(0),
        np.zeros(len(epochs)),
        clean.observed.sum(axis=1),
        History.from_epochs(epochs, reference, 0.0),
        {name: c.resolution or 0.0 for name, c in recording.channels.items()},
        str(recording.path),
    )
    return _reduced(series, np.zeros(0, dtype=np.int64))


def _mean_orientation(
    sensor: Sensor,
    field: TestField,
    grid: ObservationGrid,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
) -> Array:
    """The mean (16,) of some epochs, each adjusted by itself."""
    from thermocald.photogrammetry.series import SeriesSettings, adjust_series

    sample = np.unique(np.linspace(0, len(grid.points) - 1, _WARM_EPOCHS).astype(int))
    some = ObservationGrid(grid.points[sample], grid.weights[sample])
    settings = SeriesSettings(exterior="series", target_noise=False)
    adjusted = adjust_series(sensor, field, some, interior, exterior, settings)
    if not adjusted.ok.any():
        raise DataError(f"no epoch could be adjusted: {adjusted.reasons[0]}")
    mean: Array = adjusted.values[adjusted.ok].mean(axis=0)
    return mean


def _gross(residuals: Array) -> NDArray[np.bool_]:
    """Gross errors (E, T): beyond 4.5 times their own epoch's noise.

    The adjustment's data snooping measures all epochs by one sigma; where heat defocuses, it would
    cut off the hot epochs' tails and make them look better than they are.
    """
    size = np.abs(residuals)
    noise = 1.4826 * np.nanmedian(size.reshape(len(size), -1), axis=1)
    with np.errstate(invalid="ignore"):
        gross: NDArray[np.bool_] = (size > _GROSS * noise[:, None, None]).any(axis=2)
    return gross


def _reduced(series: ModelSeries, displaced: NDArray[np.int64]) -> ModelSeries:
    at = linearise(series.sensor, series.field, series.start[:10], series.start[10:])
    A = np.zeros((len(series.field), 2, N_PARAMETERS))
    A[:, :, : len(PARAMETER_NAMES)] = at.A
    A[:, :, 16:19] = at.B * series.field.points[:, None, :]
    A[displaced, :, 19:22] = at.B[displaced]
    weights = series.grid.weights
    b, lPl = right_hand_sides(weights, series.grid.points - at.predicted, A)
    return replace(series, N=normal_matrices(weights, A), b=b, lPl=lPl)
