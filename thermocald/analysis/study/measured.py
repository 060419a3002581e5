"""A measured series as the study reads it: columns of numbers, whoever calibrated the epochs.

Only epochs with a result are rows; what the others lacked is counted by reason. Standard deviations
are those that one epoch adds to its series: what all epochs have in common (the exterior
orientation, the test field) cancels in every comparison between epochs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.series.blocks import released

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.series.field_motion import FieldMovement

__all__ = ["Clip", "MeasuredSeries", "Thermometer"]


@dataclass(frozen=True, slots=True, eq=False)
class Thermometer:
    """One channel at the times of the frames: values (E,) °C, NaN where missing; noise sd K."""

    name: str
    values: Array
    sd: float


@dataclass(frozen=True, slots=True)
class Clip:
    """Where to cut the image around one target in the first and the last frame that exist.

    first, last: image files; first_epoch, last_epoch: their numbers; centre: px in the first.
    """

    target: str
    first: Path
    last: Path
    first_epoch: int
    last_epoch: int
    centre: tuple[float, float]


@dataclass(frozen=True, eq=False)
class MeasuredSeries:
    """The epochs with a result of one series of one camera.

    label: what the study treats as one camera; name: the series; number (E,), time_s (E,): s since
    the first epoch of the series; thermometers: the first is the reference; values (E, 10): IOP;
    sds (E, 10): NaN where held fixed; sigma0, redundancy (E,); correlations (m, 10, 10) of the IOP
    in the adjustments of the epochs `correlation_rows` (m,), a sample where a series is long;
    exterior: how the exterior orientation was estimated, choice: why; without_result: {reason:
    epochs}; start_utc: s UTC of the first epoch, 0 where it has no date; image_noise_ratio: noise
    of the image points found over the one stated, NaN where epochs were adjusted one by one;
    field_movements: boards and targets that moved, taken off the observations; doubts: what cannot
    have been meant in what was recorded.
    """

    label: str
    name: str
    camera: str
    sensor: Sensor
    source: str
    number: NDArray[np.int64]
    time_s: Array
    thermometers: tuple[Thermometer, ...]
    values: Array
    sds: Array
    sigma0: Array
    redundancy: Array
    correlations: Array
    correlation_rows: NDArray[np.int64]
    exterior: str
    without_result: Mapping[str, int] = field(default_factory=dict)
    clip: Clip | None = None
    start_utc: float = 0.0
    choice: str = ""
    image_noise_ratio: float = float("nan")
    field_movements: tuple[FieldMovement, ...] = ()
    doubts: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The IOP that were estimated, in their order."""
        return tuple(n for n in IOP_NAMES if bool(np.any(self._column(self.sds, n) > 0)))

    @cached_property
    def mean(self) -> Array:
        """The mean interior orientation (10,) of the epochs."""
        return np.array([np.mean(self._column(self.values, name)) for name in IOP_NAMES])

    @staticmethod
    def _column(values: Array, name: str) -> Array:
        """A copy (E,): columns of a series of a year are on disk, and leave memory again."""
        out: Array = values[:, IOP_NAMES.index(name)].copy()
        released(values)
        return out

    def column(self, name: str) -> tuple[Array, Array]:
        """Values and standard deviations (E,) of one parameter of the interior orientation."""
        return self._column(self.values, name), self._column(self.sds, name)

    @property
    def reference(self) -> Thermometer | None:
        """The reference thermometer, if there is one."""
        return self.thermometers[0] if self.thermometers else None

    @property
    def interval_s(self) -> float:
        """Median time between epochs, NaN for a single one."""
        return float(np.median(np.diff(self.time_s))) if len(self) > 1 else float("nan")
