"""The study of one or several cameras: section 4 of Elias et al. 2020 for the user's own cameras.

Series with the same label are one camera: their correlations are pooled for a single Monte-Carlo
simulation. The reference treats a cold- and a warm-started camera as two; use two labels for that.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.dependence import IopCorrelations, median_correlations
from thermocald.analysis.study.montecarlo import (
    MonteCarlo,
    Trajectory,
    correlations_over_time,
    draw_root,
    mean_and_largest,
    plane_jacobian,
    shares_within,
    simulate_errors,
    trajectories,
)
from thermocald.analysis.study.series_study import SeriesStudy, StudySettings, study_series
from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.arrays import Array


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
class CameraStudy:
    """The study of one camera (label) from its series.

    iop (10,): mean over the series; sds (10,): standard deviations over time, pooled over the
    series that estimate a parameter, 0 if none does; correlations: within the adjustments, None if
    no epoch has a covariance matrix; over_time (10, 10): correlations of the parameters over the
    epochs; trajectories: the camera's own drift in object space, empty if it cannot be computed.
    """

    label: str
    series: tuple[SeriesStudy, ...]
    iop: Array
    sds: Array
    correlations: IopCorrelations | None
    montecarlo: MonteCarlo | None
    first_order: FirstOrder | None
    over_time: Array
    trajectories: tuple[Trajectory, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Study:
    """The studies of all cameras."""

    settings: StudySettings
    cameras: tuple[CameraStudy, ...]


def study(
    series: Sequence[MeasuredSeries],
    settings: StudySettings | None = None,
    progress: Callable[[int], None] | None = None,
) -> Study:
    """Study every camera; `progress` receives the number of IOP sets simulated."""
    s = settings or StudySettings()
    count = Counter((one.label, one.name) for one in series)
    series = [
        one
        if count[one.label, one.name] == 1
        else replace(one, name=f"{one.name} in {Path(one.source).name}")
        for one in series
    ]
    labels = dict.fromkeys(one.label for one in series)
    cameras = [
        study_camera(label, [one for one in series if one.label == label], s, progress)
        for label in labels
    ]
    return Study(s, tuple(cameras))


def study_camera(
    label: str,
    series: Sequence[MeasuredSeries],
    settings: StudySettings,
    progress: Callable[[int], None] | None = None,
) -> CameraStudy:
    """Study the series of one camera together."""
    notes: list[str] = []
    studies = tuple(study_series(one, settings) for one in series)
    iop = np.mean([one.mean for one in series], axis=0)
    squares, degrees = np.zeros(10), np.zeros(10)
    for one in series:
        for name in one.free:
            k = IOP_NAMES.index(name)
            squares[k] += np.var(one.column(name)[0]) * len(one)
            degrees[k] += len(one) - 1
    sds = np.sqrt(squares / np.maximum(degrees, 1))
    correlations = median_correlations([one.correlations for one in series])
    if correlations is None:
        notes.append(
            "No epoch has a covariance matrix: correlations within the adjustments are unknown."
        )
    montecarlo = first_order = None
    if correlations is None or not (sds > 0).any():
        notes.append(
            "No Monte-Carlo: it needs a parameter that varies over two epochs or more, and the "
            "correlations."
        )
    else:
        sensor, correlation = series[0].sensor, correlations.median
        try:
            montecarlo = simulate_errors(sensor, iop, sds, correlation, settings, progress)
            root = draw_root(sds, correlation)
            jacobian = plane_jacobian(sensor, iop, montecarlo.image_points, settings.distance_mm)
            covariance = jacobian @ (root.T @ root) @ np.swapaxes(jacobian, 1, 2)
            axes = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
            below = np.mean(shares_within(axes, settings.clusters_mm), axis=0)
            shares = np.diff(below, prepend=0.0, append=1.0)
            first_order = FirstOrder(covariance, *mean_and_largest(axes, settings.sets), shares)
        except GeometryError as error:
            notes.append(f"No Monte-Carlo: {error}.")
    if montecarlo is not None and montecarlo.folded:
        notes.append(
            f"{montecarlo.folded} of {montecarlo.sets} drawn interior orientations fold the image "
            "over itself and were left out."
        )
    try:
        paths = trajectories(series, settings.distance_mm, settings.grid, settings.clusters_mm)
    except GeometryError as error:
        paths = ()
        notes.append(f"The camera's drift cannot be projected onto the plane: {error}.")
    return CameraStudy(
        label, studies, iop, sds, correlations, montecarlo, first_order,
        correlations_over_time(series), paths, tuple(notes),
    )  # fmt: skip
