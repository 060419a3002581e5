"""Boards that moved and targets that wander: found, reported, and none of the camera's.

A board that was knocked or creeps is put back where it was; a target that wanders is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.sheets import field_sheets
from thermocald.photogrammetry.series.board_motion import board_movements, refined
from thermocald.photogrammetry.series.field_motion import (
    FieldMovement,
    FieldSeries,
    wandering_targets,
)
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.reduction.reduce import with_points, without_targets

if TYPE_CHECKING:
    from thermocald.reduction.series import ReducedSeries

__all__ = ["moved_boards", "wandering_apart"]

_PASSES = 2


def moved_boards(evidence: ReducedSeries) -> tuple[list[FieldMovement], ReducedSeries]:
    """The boards that moved, and the series with them where they were."""
    found = board_movements(_field_series(evidence))
    if not found:
        return [], evidence
    still = _without(evidence, found)
    for _ in range(_PASSES):
        found = [refined(_field_series(still), m) for m in found]
        still = _without(evidence, found)
    return found, still


def _without(evidence: ReducedSeries, found: list[FieldMovement]) -> ReducedSeries:
    """The series with boards back in their places."""
    grid = evidence.source.grid
    points = np.array(grid.points)
    for m in found:
        points[:, m.rows] -= m.trajectory[:, None, None] * m.image
    return with_points(evidence, ObservationGrid(points, grid.weights))


def wandering_apart(evidence: ReducedSeries) -> tuple[list[FieldMovement], ReducedSeries]:
    """The targets that wander, and the series without them."""
    found = wandering_targets(_field_series(evidence))
    if not found:
        return [], evidence
    rows = np.concatenate([m.rows for m in found])
    return found, without_targets(evidence, np.union1d(evidence.excluded, rows))


def _field_series(e: ReducedSeries) -> FieldSeries:
    field = e.source.field
    boards = field_sheets(field)
    return FieldSeries(
        e.times, e.residuals, e.weights, e.columns, e.at.B, field.points, boards, field.names,
        e.numbers,
    )  # fmt: skip
