"""From a recording or a store to the reduced series that a thermal model is fitted to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.series import ModelSeries
from thermocald.errors import DataError
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.epoch.cold_start import cold_start
from thermocald.photogrammetry.series.adjustment import SeriesSettings, adjust_series
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
)
from thermocald.reduction.source import measured_epochs
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import Partials
    from thermocald.store.recording.head import Head
    from thermocald.store.recording.reader import Recording

    Array = NDArray[np.float64]

__all__ = ["load_model_series", "model_series", "reduce_series"]

_ENOUGH = 20  # image points without which an epoch says too little
_GROSS = 4.5  # standard deviations
_SAMPLE = 40  # epochs that tell the mean orientation
_ROUNDS = 4
_WINDOW = 9  # epochs beside which a target that moves must lie
_BEGUN = 5  # epochs tried for a first orientation


def load_model_series(
    path: Path,
    keep_targets: tuple[str, ...] = (),
    advance: Callable[[int], None] | None = None,
) -> list[ModelSeries]:
    """Reduce the series of a recording (a folder) or of a store (a file).

    Frames that have not been measured are measured; advance: told how many of them are done.
    keep_targets: as in `reduce_series`. DataError where there is no temperature, or no target.
    """
    if path.is_dir():
        from thermocald.store.recording.reader import open_recording

        recording = open_recording(path)
        return [
            reduce_series(
                recording.head,
                recording.testfield,
                measured_epochs(recording, advance),
                str(path),
                keep_targets,
            )
        ]
    from thermocald.store.database.store import Store

    with Store.open(path) as store:
        found = [
            reduce_series(
                s.head,
                s.testfield,
                [e.epoch for e in store.epochs(s)],
                f"{path}: {s.name}",
                keep_targets,
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
        measured_epochs(recording),
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
    mean = _mean_orientation(head, field, grid, [e.observations for e in epochs], source)
    at = linearise(sensor, field, mean[:10], mean[10:])
    kept = [field.index[t] for t in keep_targets if t in field.index]
    clean = grid.reject(_gross_errors(grid, at, kept))
    return ModelSeries(
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
    ).reduced()


def _mean_orientation(
    head: Head,
    field: TestField,
    grid: ObservationGrid,
    observations: Sequence[Observations | None],
    source: str,
) -> Array:
    """The mean (16,) of some epochs adjusted together, from a start that needs no initial value."""
    camera = head.camera
    order = np.argsort(-grid.observed.sum(axis=1), kind="stable")[:_BEGUN]
    reason = ""
    for e in order.tolist():
        seen = observations[e]
        assert seen is not None
        start = cold_start(
            camera.sensor,
            field,
            seen,
            AdjustmentSettings(),
            camera.principal_distance,
            camera.interior,
        )
        if start.interior is not None and start.exterior is not None:
            break
        reason = reason or start.reason
    else:
        raise DataError(f"{source}: no epoch can be oriented: {reason}")
    sample = np.unique(np.linspace(0, len(grid.points) - 1, _SAMPLE).astype(int))
    some = ObservationGrid(grid.points[sample], grid.weights[sample])
    settings = SeriesSettings(exterior="series", target_noise=False)
    adjusted = adjust_series(camera.sensor, field, some, start.interior, start.exterior, settings)
    if not adjusted.ok.any():
        raise DataError(f"{source}: no epoch could be adjusted: {adjusted.reasons[0]}")
    mean: Array = adjusted.values[adjusted.ok].mean(axis=0)
    return mean


def _running_median(values: Array) -> Array:
    """Median over neighbouring epochs (E, k, 2), NaN where there is none; keeps a step a step."""
    if not values.size:
        return values
    beside = np.full((_WINDOW // 2, *values.shape[1:]), np.nan)
    padded = np.concatenate([beside, values, beside])
    windows = np.lib.stride_tricks.sliding_window_view(padded, _WINDOW, axis=0)
    seen = np.isfinite(windows).any(axis=-1)
    found = np.full(values.shape, np.nan)
    found[seen] = np.nanmedian(windows[seen], axis=-1)
    return found


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
        b = right_hand_sides(weights, misclosure - offsets, at.A)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(N, axis1=1, axis2=2), 1e-300))
        # a weak field determines some parameters badly: those are held, not blown up
        scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-10 * np.eye(N.shape[1])
        step = scale * np.linalg.solve(scaled, (scale * b)[..., None])[..., 0]
        left = misclosure - offsets - np.einsum("tcp,ep->etc", at.A, step)
        size = np.where(observed[..., None], np.abs(left), np.nan)
        noise = 1.4826 * np.nanmedian(size.reshape(len(size), -1), axis=1)
        use = observed & (np.nan_to_num(size) <= _GROSS * noise[:, None, None]).all(axis=2)
        # a target that moves has no constant offset, but its neighbours in time
        course = _running_median(np.where(observed[..., None], left, np.nan)[:, keep])
        far = np.abs(np.nan_to_num(left[:, keep] - course)) > _GROSS * noise[:, None, None]
        use[:, keep] = observed[:, keep] & ~far.any(axis=2)
        count = np.maximum(use.sum(axis=0), 1)[:, None]
        offsets = offsets + np.where(use[..., None], left, 0.0).sum(axis=0) / count
    return observed & ~use
