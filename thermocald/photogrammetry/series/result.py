"""The result of a series' adjustment: parameters per epoch and common ones, with status.

There are two kinds of standard deviations. That of a difference within the series includes the
epoch's noise and the effect of changing visibility. That of the *level*, the errors common to all
epochs (of the EOP and the targets), is separate and cancels in every drift. An epoch without a
result has a reason in a sentence.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP_COLUMNS, free_columns
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.series.mount import STILL, Movement

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.series.covariances import HeldAffinity
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs


Exterior = Literal["per_epoch", "series", "mount", "auto"]
"""How the exterior orientation of a series is estimated."""

EXTERIOR_CHOICES: tuple[str, ...] = get_args(Exterior)
"""The values of `Exterior`."""


@dataclass(frozen=True, slots=True)
class SeriesSettings(AdjustmentSettings):
    """Settings of a series' adjustment, beyond those of single epochs.

    exterior: `per_epoch`: an orientation for every epoch; `series`: one for all epochs; `mount`:
    one for all and a movement for every epoch, whose variance is estimated; `auto`: one of the
    three, chosen by the data; target_offsets: estimate a constant offset per target, with the test
    field's sigmas as prior; target_noise: estimate the measuring noise, its correlations within a
    marker and the excess scatter of neighbouring epochs, if the series is long enough;
    drift_period: shortest period of the camera's drift in epochs (`mount.drift_period`), 0 if the
    series is too short for a drift; gaps: the first epoch after each gap (`mount.drift_gaps`).
    """

    exterior: Exterior = "series"
    target_offsets: bool = True
    target_noise: bool = True
    drift_period: float = 24.0
    gaps: tuple[int, ...] = ()

    @classmethod
    def of(cls, settings: AdjustmentSettings, exterior: str) -> SeriesSettings:
        """Return the series' settings with those of single epochs."""
        given = {each.name: getattr(settings, each.name) for each in fields(AdjustmentSettings)}
        return cls(**given, exterior=cast("Exterior", exterior))

    @property
    def per_epoch(self) -> Index:
        """Positions of the parameters that are estimated per epoch."""
        own = free_columns(self.free)
        if self.exterior != "series":
            own += list(EOP_COLUMNS)
        return np.array(own, dtype=np.int64)

    @property
    def carried(self) -> int:
        """Number of unknowns per epoch; a movement of the mount takes hardly any redundancy."""
        interior = free_columns(self.free)
        return len(interior) + (6 if self.exterior == "per_epoch" else 0)

    @property
    def common(self) -> Index:
        """Positions of the parameters that are common to all epochs."""
        return np.empty(0, dtype=np.int64) if self.exterior == "per_epoch" else EOP_COLUMNS


@dataclass(frozen=True, eq=False)
class EpochRows:
    """The adjusted epochs of a series, one row each.

    values, sd (E, 16): NaN if an epoch has no result or a parameter was held; sigma0, redundancy,
    stillness (E,): NaN if undefined; n_observations, n_rejected (E,): numbers of targets, the
    rejected ones in both; status, reasons: E words and E sentences.
    """

    values: Array
    sd: Array
    sigma0: Array
    redundancy: Array
    stillness: Array
    n_observations: Index
    n_rejected: Index
    status: list[str]
    reasons: list[str]

    @classmethod
    def empty(cls, epochs: int) -> EpochRows:
        """Return rows without content, for `put`."""
        values, sd = np.empty((2, epochs, 16))
        a, b, c = np.empty((3, epochs))
        m, n = np.empty((2, epochs), dtype=np.int64)
        return cls(values, sd, a, b, c, m, n, [""] * epochs, [""] * epochs)

    def put(self, first: int, part: EpochRows) -> None:
        """Store consecutive epochs, from epoch `first` on."""
        here = slice(first, first + len(part.values))
        for column in fields(self):
            values = getattr(part, column.name)
            if isinstance(values, list):  # one object per text, however many epochs have it
                values = map(sys.intern, values)
            getattr(self, column.name)[here] = values


@dataclass(frozen=True, eq=False)
class SeriesAdjustment:
    """The adjusted series; rows are epochs, parameters in the order of `PARAMETER_NAMES`.

    values (E, 16): NaN if an epoch has no result; covariance (E, 16, 16): relative to the series;
    level_covariance (16, 16): common to all epochs; sigma0 (E,); redundancy (E,); observed,
    rejected (E, T); residuals (E, T, 2) px; offsets (T, 2) px: NaN if not estimated; status,
    reasons: per epoch; stillness (E,): χ² with 6 degrees of freedom of the epoch's own EOP against
    the series', NaN if the EOP are per epoch; excess_sd (16,): scatter of neighbouring epochs
    beyond their noise, as the set-up trembles or the light flickers: included in the covariance, 0
    if not significant; trend_sd (16,): of a straight line from the first epoch to the last, from
    the targets' coordinates if the visible ones changed, errors of the level if the camera changes,
    slow errors of targets, and a mount with memory; perspective_sd (16,): of an epoch with a
    completely free mount, NaN if the EOP are per epoch; field_ratio: estimated over stated standard
    deviations of the field's coordinates, at least 1; outer_noise: noise of the outermost target
    over that in the image's middle, and its standard deviation, NaN if weights do not follow it;
    noise_shown: whether residuals show the noise rather than the field's errors; noise_ratio:
    estimated over stated noise; affinity: of held C1 and C2; movement: of the mount; choice: how
    the exterior orientation was estimated, and why; slow: errors common to all epochs but for a
    factor, each as that course (E,) and the covariance (16, 16) of a change by 1: errors of the
    level, slow errors of targets, jumps of the mount; step: the first epoch (row) after targets
    moved against one another, 0 for none; pairs: of coordinates with correlated errors.
    """

    settings: SeriesSettings
    values: Array
    covariance: Array
    level_covariance: Array
    sigma0: Array
    redundancy: Array
    observed: Mask
    rejected: Mask
    residuals: Array
    offsets: Array
    status: Sequence[str]
    reasons: Sequence[str]
    stillness: Array
    excess_sd: Array = field(default_factory=lambda: np.zeros(16))
    trend_sd: Array = field(default_factory=lambda: np.zeros(16))
    perspective_sd: Array = field(default_factory=lambda: np.full(16, np.nan))
    field_ratio: float = 1.0
    outer_noise: tuple[float, float] = (float("nan"), float("nan"))
    noise_shown: bool = True
    noise_ratio: float = 1.0
    affinity: HeldAffinity | None = None
    movement: Movement = STILL
    choice: str = ""
    slow: tuple[tuple[Array, Array], ...] = ()
    step: int = 0
    pairs: CorrelatedPairs | None = None

    @property
    def exterior(self) -> Exterior:
        """How the exterior orientation was estimated."""
        return self.settings.exterior

    @property
    def sd(self) -> Array:
        """Standard deviations (E, 16), NaN if held; those of common parameters with the level."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2).copy()
        common = self.settings.common
        variance[:, common] += np.diag(self.level_covariance)[common]
        out: Array = np.sqrt(np.where(variance > 0, variance, np.nan))
        out[~self.ok] = np.nan
        return out

    @property
    def level_sd(self) -> Array:
        """Standard deviations (16,) of the level."""
        return np.sqrt(np.clip(np.diag(self.level_covariance), 0.0, None))

    @property
    def ok(self) -> Mask:
        """Mask (E,) of the epochs with a result."""
        return np.array([s == "ok" for s in self.status], dtype=bool)

    @property
    def rows(self) -> EpochRows:
        """The epochs as rows."""
        rejected = self.rejected.sum(axis=1)
        return EpochRows(
            self.values, self.sd, np.where(self.ok, self.sigma0, np.nan), self.redundancy,
            self.stillness, self.observed.sum(axis=1) + rejected, rejected, list(self.status),
            list(self.reasons),
        )  # fmt: skip

    def spread(self, targets: Index, n: int) -> SeriesAdjustment:
        """Return the result with its targets at rows `targets` of a test field of n targets."""
        if len(targets) == n:
            return self

        def wide(array: NDArray[Any], fill: Any) -> NDArray[Any]:
            out = np.full((len(array), n, *array.shape[2:]), fill, dtype=array.dtype)
            out[:, targets] = array
            return out

        return replace(
            self,
            observed=wide(self.observed, False),
            rejected=wide(self.rejected, False),
            residuals=wide(self.residuals, np.nan),
            offsets=wide(self.offsets[None], np.nan)[0],
        )


def enough_targets(grid: ObservationGrid, s: SeriesSettings) -> Mask:
    """Return a mask (E,) of the epochs with enough targets for their own parameters."""
    count = 2 * grid.observed.sum(axis=1) - s.carried
    return np.asarray(count >= s.minimum_redundancy)
