"""What a recording must hold to carry a discovery; the refusals say what is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.field.planes import plane_fit

if TYPE_CHECKING:
    from thermocald.reduction.series import SeriesInput
    from thermocald.reduction.thermometer import Thermometer

__all__ = [
    "LEAST_EPOCHS",
    "MIN_EPOCHS",
    "MIN_TARGETS",
    "no_temperature",
    "require",
    "require_change",
    "require_for_fit",
]

MIN_EPOCHS = 20
LEAST_EPOCHS = 3
_ENOUGH = 20  # targets without which an epoch says too little to a fit
MIN_TARGETS = 12
_MIN_DURATION = 120.0  # s


def no_temperature(source: SeriesInput, reference: str) -> str:
    """The sentence for a reference temperature that was hardly ever read."""
    return (
        f"{source.name}: the recording has no temperature: the column {reference!r} holds fewer "
        f"than {MIN_EPOCHS} readings. Discovery compares the camera with a thermometer; record one"
    )


def require(source: SeriesInput) -> None:
    """Raises DataError where temperature, epochs, duration or field do not carry a discovery."""
    if not source.readings:
        raise DataError(
            f"{source.name}: the recording has no temperature column. Discovery compares the "
            "camera with a thermometer; record one"
        )
    reference = next(iter(source.readings))
    if np.isfinite(source.readings[reference]).sum() < MIN_EPOCHS and (
        len(source.frame_times) >= MIN_EPOCHS
    ):
        raise DataError(no_temperature(source, reference))
    seen = source.grid.observed.sum(axis=1)
    good = int(np.sum(seen >= MIN_TARGETS))
    if good < MIN_EPOCHS:
        raise DataError(
            f"{source.name}: {good} of {len(seen)} epochs have {MIN_TARGETS} targets or more; "
            f"discovery needs {MIN_EPOCHS} such epochs, better 100"
        )
    duration = float(source.frame_times[-1] - source.frame_times[0])
    if duration < _MIN_DURATION:
        raise DataError(
            f"{source.name}: the recording lasts {duration:.0f} s; heat needs minutes to reach a "
            "camera, and what moves faster is not a thermal effect. Record at least "
            f"{_MIN_DURATION:.0f} s, better half an hour"
        )
    rows = source.grid.observed.any(axis=0)
    if plane_fit(source.field.points[rows])[2]:
        raise DataError(
            f"{source.name}: the {int(rows.sum())} targets seen lie in one plane; principal point "
            "and tilt cannot be separated on it. Use a field with depth, such as a corner"
        )


def require_for_fit(source: SeriesInput) -> None:
    """Raises DataError where temperature or epochs do not carry the fit of a thermal model."""
    if not source.readings:
        raise DataError(f"{source.name}: has no temperature column; a thermal model needs one")
    enough = source.grid.observed.sum(axis=1) >= _ENOUGH
    if enough.sum() < LEAST_EPOCHS:
        raise DataError(
            f"{source.name}: fewer than {LEAST_EPOCHS} epochs show {_ENOUGH} targets or more"
        )


def require_change(source: SeriesInput, reference: str, channel: Thermometer) -> None:
    """Raises DataError where the reference temperature does not change."""
    trajectory = channel.trajectory[np.isfinite(channel.trajectory)]
    change = float(np.ptp(trajectory))
    if change < max(1.0, 8.0 * channel.noise):
        raise DataError(
            f"{source.name}: the temperature {reference!r} is constant within "
            f"{change:.2f} K; what follows it cannot be told from what does not. "
            "Record a series in which it changes by 5 K or more"
        )
