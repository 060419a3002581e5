"""What the camera's own path through its interior orientations does in object space.

The Monte-Carlo of the reference draws interior orientations about the series' mean, normally
distributed and correlated as within an adjustment. A camera that warms up does neither: its
parameters move together, along one path. Here every epoch's interior orientation itself is taken,
against three that a user may hold fixed: that of the first epoch, the mean of the series, the last.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.statistics.dependence import correlation_matrix
from thermocald.analysis.study.montecarlo import plane_errors
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.arrays import Array

__all__ = ["REFERENCES", "Trajectory", "correlations_over_time", "trajectories"]

REFERENCES = ("first", "mean", "last")
"""The interior orientations that are held fixed, by name."""

_MOST_EPOCHS = 2000  # of one series, spread evenly


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Errors on the plane along the path, all series together, against one fixed orientation.

    reference: first, mean or last; fractions (m+1,): of the distances of all epochs and image
    points per cluster; mean mm; mean_largest: mean over the image points of their largest, mm;
    epochs: how many were used.
    """

    reference: str
    fractions: Array
    mean: float = field(metadata={"json": "mean_mm"})
    mean_largest: float = field(metadata={"json": "mean_of_maxima_mm"})
    epochs: int


def trajectories(
    series: Sequence[MeasuredSeries],
    distance_mm: float,
    size: int,
    clusters_mm: Sequence[float],
) -> tuple[Trajectory, ...]:
    """The path of one camera against its first, mean and last interior orientation.

    size: image points per row and column; each series has a path and references of its own. Raises
    GeometryError where a reference has no ray for an image point.
    """
    found = []
    for reference in REFERENCES:
        distances = [
            _distances(one, reference, distance_mm, size) for one in series if len(one) > 1
        ]
        if not distances:
            return ()
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


def _distances(one: MeasuredSeries, reference: str, distance_mm: float, size: int) -> Array:
    """Distances (e, k) mm on the plane of image points (k,) at epochs (e,)."""
    rows = np.unique(np.linspace(0, len(one) - 1, min(len(one), _MOST_EPOCHS)).astype(int))
    fixed = {
        "first": one.values[0],
        "mean": one.mean,
        "last": one.values[-1],
    }[reference]
    points = image_grid(one.sensor, size)
    errors = plane_errors(one.sensor, fixed, one.values[rows], points, distance_mm)
    distances = np.linalg.norm(errors, axis=-1)
    return np.asarray(distances[np.isfinite(distances).all(axis=1)])


def correlations_over_time(series: Sequence[MeasuredSeries]) -> Array:
    """Pearson's r (10, 10) of the IOP over the epochs, about each series' own mean.

    NaN for parameters that were held or did not change.
    """
    columns = []
    every = [name for name in IOP_NAMES if any(name in one.free for one in series)]
    for name in every:
        within = []
        for one in series:
            values = one.column(name)[0] if name in one.free else np.full(len(one), np.nan)
            values -= values.mean()
            within.append(values)
        columns.append(within[0] if len(within) == 1 else np.concatenate(within))
    rows = [IOP_NAMES.index(name) for name in every]
    matrix = np.full((len(IOP_NAMES), len(IOP_NAMES)), np.nan)
    matrix[np.ix_(rows, rows)] = correlation_matrix(columns)
    return matrix
