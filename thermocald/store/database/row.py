"""What one epoch leaves in the store, and what a series is there."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.store.recording.head import Head

__all__ = ["NOT_CALIBRATED", "EpochResult", "Event", "LoggedReading", "StoredSeries"]

NOT_CALIBRATED = "not_calibrated"  # the status of an epoch that has not been adjusted yet


class _Adjusted(Protocol):
    """What this module reads of a photogrammetry.adjustment.Adjustment."""

    @property
    def status(self) -> str: ...
    @property
    def reason(self) -> str: ...
    @property
    def interior(self) -> InteriorOrientation | None: ...
    @property
    def exterior(self) -> ExteriorOrientation | None: ...
    @property
    def covariance(self) -> Array: ...
    @property
    def sigma0(self) -> float: ...
    @property
    def redundancy(self) -> int: ...
    @property
    def n_observations(self) -> int: ...
    @property
    def rejected(self) -> Sequence[int]: ...


@dataclass(frozen=True, slots=True, eq=False)
class EpochResult:
    """The numbers of one adjustment, in the order of `PARAMETER_NAMES`.

    status: `ok` or one word for why there is no result, `reason` in a sentence; values (16,), NaN
    where there is none; covariance (16, 16), zero where a parameter was held, None without a
    result; rejected: rows of the test field.
    """

    status: str
    reason: str = ""
    values: Array = field(default_factory=lambda: np.full(16, np.nan))
    covariance: Array | None = None
    sigma0: float = float("nan")
    redundancy: int = 0
    n_observations: int = 0
    rejected: tuple[int, ...] = ()

    @classmethod
    def from_adjustment(cls, adjustment: _Adjusted) -> Self:
        """The part of an adjustment that is kept."""
        values = np.full(16, np.nan)
        if adjustment.interior is not None:
            values[:10] = adjustment.interior.as_array()
        if adjustment.exterior is not None:
            values[10:] = adjustment.exterior.as_array()
        solved = adjustment.interior is not None or adjustment.exterior is not None
        return cls(
            adjustment.status,
            adjustment.reason,
            values,
            adjustment.covariance if solved else None,
            float(adjustment.sigma0),
            int(adjustment.redundancy),
            int(adjustment.n_observations),
            tuple(int(row) for row in adjustment.rejected),
        )

    @property
    def sd(self) -> Array:
        """Standard deviations (16,), NaN where a parameter was held or nothing was estimated."""
        if self.covariance is None:
            return np.full(16, np.nan)
        variances = np.diag(self.covariance)
        return np.sqrt(np.where(variances > 0, variances, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class StoredSeries:
    """One series of one camera.

    head: what its recording.yaml would say; start: the start condition, such as `cold`; identity:
    what the device said it is; settings: how it was adjusted (both JSON-able); created_utc: s.
    """

    id: int
    head: Head
    testfield: TestField
    start: str
    identity: Mapping[str, Any]
    settings: Mapping[str, Any]
    created_utc: float

    @property
    def camera(self) -> str:
        return self.head.camera.name

    @property
    def name(self) -> str:
        return self.head.series


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened: a knock, a device gone or back, a deletion.

    utc: s; kind: one word; series and epoch: where it belongs to one; data: JSON-able.
    """

    utc: float
    kind: str
    text: str
    series: int | None = None
    epoch: int | None = None
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LoggedReading:
    """What a thermometer said that belongs to no epoch: utc s, values {channel: °C}."""

    thermometer: str
    utc: float
    values: Mapping[str, float]
    clock_trusted: bool = True
