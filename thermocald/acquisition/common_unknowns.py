"""What all epochs of the daemon's series share: one orientation, its mount, its targets' offsets.

The estimation is that of any series (`photogrammetry.series.running`). The daemon adds what only
somebody who waits for the next epoch can decide: an epoch that contradicts the common exterior
orientation has no result, and a second one in a row starts the series' common unknowns again.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation, InteriorOrientation
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.linalg import scaled_inverse
from thermocald.photogrammetry.parameters import EOP, IOP
from thermocald.photogrammetry.series.mount import fastest_period
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.photogrammetry.series.running import RunningSeries

if TYPE_CHECKING:
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment, AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.result import Exterior

__all__ = ["CommonUnknowns"]

log = logging.getLogger(__name__)

_MOST_TARGETS = 300  # 1 GFLOP and 14 MB whenever they are solved for
_MOVED = 38.3  # chi-square, 6 degrees of freedom, error probability 1e-6


class CommonUnknowns:
    """The common unknowns of one series; `refine` takes epochs in any order, one thread at a time.

    exterior: as of `SeriesSettings`; `mount` and `auto` are the same here. offsets: one offset per
    target, with the test field's sigmas as prior, for up to 300 targets: their normal matrix is a
    full one. interval_s: between epochs.
    """

    def __init__(
        self,
        sensor: Sensor,
        testfield: TestField,
        settings: AdjustmentSettings,
        *,
        exterior: Exterior,
        offsets: bool,
        interval_s: float = 10.0,
    ) -> None:
        offsets = offsets and bool((testfield.sigmas > 0).any())
        if offsets and len(testfield) > _MOST_TARGETS:
            log.warning("%d targets are too many for target_offsets", len(testfield))
            offsets = False
        self._sensor = sensor
        self._field = testfield
        self._settings = replace(
            SeriesSettings.of(settings, exterior),
            target_offsets=offsets,
            drift_period=fastest_period(interval_s),
            snooping_alpha=settings.snooping_alpha,
        )
        self._surprised = False
        self.reset()

    @property
    def any(self) -> bool:
        """Whether there is something that epochs share, and something of their own beside it."""
        s = self._settings
        return len(s.per_epoch) > 0 and (s.exterior != "per_epoch" or s.target_offsets)

    @property
    def epochs(self) -> int:
        """How many were taken in since the start or the last reset."""
        return self._series.epochs

    def reset(self) -> None:
        """Forget all: the camera was moved and sees its targets from elsewhere."""
        self._series = RunningSeries(self._sensor, self._field, self._settings)

    def refine(
        self, observations: Observations, apart: Adjustment, *, moved: bool = False
    ) -> Adjustment:
        """An epoch's result given all epochs so far, this one included.

        apart: the epoch's adjustment by itself, whose rejected targets stay rejected; returned as
        it is where it is not a result. moved: the epoch contradicts the others in what the caller
        knows. With a common orientation such an epoch has no result; the second one in a row starts
        again.
        """
        if not self.any or not apart.ok:
            return apart
        if self.epochs > 1 and (moved or self._contradicted(apart)):
            if self._settings.exterior == "per_epoch":
                return apart
            if not self._surprised:
                self._surprised = True
                why = "it contradicts the one exterior orientation of its series: was it moved?"
                return failed("moved", why, observations, apart.free)
            self.reset()
        self._surprised = False
        epoch = self._series.add(observations, apart.values, apart.rejected)
        if epoch.status != "ok":
            return failed(epoch.status, epoch.reason, observations, apart.free)
        return replace(
            apart,
            interior=InteriorOrientation.from_array(epoch.values[IOP]),
            exterior=ExteriorOrientation.from_array(epoch.values[EOP]),
            covariance=epoch.covariance,
            sigma0=epoch.sigma0,
            redundancy=epoch.redundancy,
            residuals=epoch.residuals[apart.targets],
            rejected=tuple(np.flatnonzero(epoch.rejected).tolist()),
        )

    def _contradicted(self, apart: Adjustment) -> bool:
        """Whether the epoch's own exterior orientation is another one than the common one."""
        known = self._series.pose()
        if known is None:
            return False
        pose, covariance = known
        d = apart.values[EOP] - pose
        return float(d @ scaled_inverse(apart.covariance[EOP, EOP] + covariance) @ d) > _MOVED
