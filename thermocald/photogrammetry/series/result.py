"""The result of a series' adjustment: what was estimated per epoch and what once, and the status.

Two standard deviations come out of it. That of a difference within the series holds the noise of
the epoch and the differences of visibility; the *level*, what all epochs have in common (the EOP's
and the targets' uncertainty), is stated separately and cancels in every drift. An epoch without a
result has its reason in a sentence.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    EOP_COLUMNS,
    PRINCIPAL_POINT,
    Sensor,
    free_columns,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.epoch.geometry import weaknesses
from thermocald.photogrammetry.epoch.snooping import (
    TRUSTED_REDUNDANCY,
    fails_global_test,
    most_rejected,
)
from thermocald.photogrammetry.series.mount import STILL, Movement

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.covariances import HeldAffinity
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs


Exterior = Literal["per_epoch", "series", "mount", "auto"]
"""How the exterior orientation of a series is estimated."""

EXTERIOR_CHOICES: tuple[str, ...] = get_args(Exterior)
"""The words for it."""


@dataclass(frozen=True, slots=True)
class SeriesSettings(AdjustmentSettings):
    """What is estimated per epoch and what once, beside the settings of single epochs.

    exterior: `per_epoch`: every epoch its own orientation; `series`: one for all epochs; `mount`:
    one for all and a movement of each epoch, whose variance is estimated; `auto`: what the data
    choose of the three; target_offsets: a constant offset per target, with the test field's sigmas
    as prior; target_noise: the measuring noise, also its correlations within a marker and what
    neighbouring epochs scatter beyond it, from the series' own scatter where it is long enough;
    drift_period: the shortest of the camera's drift in epochs (`mount.drift_period`), 0 for a
    series too short for one.
    """

    exterior: Exterior = "series"
    target_offsets: bool = True
    target_noise: bool = True
    drift_period: float = 24.0

    @classmethod
    def of(cls, settings: AdjustmentSettings, exterior: str) -> SeriesSettings:
        """Return the series' settings that go with those of single epochs."""
        given = {each.name: getattr(settings, each.name) for each in fields(AdjustmentSettings)}
        return cls(**given, exterior=cast("Exterior", exterior))

    @property
    def per_epoch(self) -> Index:
        """Positions of the parameters that every epoch has of its own."""
        own = free_columns(self.free)
        if self.exterior != "series":
            own += list(EOP_COLUMNS)
        return np.array(own, dtype=np.int64)

    @property
    def carried(self) -> int:
        """How many unknowns an epoch has to carry: a movement of the mount costs hardly any."""
        interior = free_columns(self.free)
        return len(interior) + (6 if self.exterior == "per_epoch" else 0)

    @property
    def common(self) -> Index:
        """Positions of the parameters that are estimated once."""
        return np.empty(0, dtype=np.int64) if self.exterior == "per_epoch" else EOP_COLUMNS


@dataclass(frozen=True, eq=False)
class EpochRows:
    """Epochs of a series as adjusted, one by one.

    values, sd (E, 16): NaN where an epoch has no result or a parameter was held; sigma0,
    redundancy, stillness (E,): NaN where there is none; n_observations, n_rejected (E,): how many
    targets, the rejected in both; status, reasons: E words and sentences.
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
        """Return rows to be put in."""
        values, sd = np.empty((2, epochs, 16))
        sigma0, redundancy, stillness = np.empty((3, epochs))
        observed, rejected = np.empty((2, epochs), dtype=np.int64)
        words, sentences = [""] * epochs, [""] * epochs
        return cls(values, sd, sigma0, redundancy, stillness, observed, rejected, words, sentences)

    def put(self, first: int, part: EpochRows) -> None:
        """Put consecutive epochs in, from epoch `first` on."""
        here = slice(first, first + len(part.values))
        for column in fields(self):
            values = getattr(part, column.name)
            if isinstance(values, list):  # each text once, however many epochs have it
                values = map(sys.intern, values)
            getattr(self, column.name)[here] = values


@dataclass(frozen=True, eq=False)
class SeriesAdjustment:
    """The adjusted series; rows are epochs, parameters in the order of `PARAMETER_NAMES`.

    values (E, 16), NaN where an epoch has no result; covariance (E, 16, 16): relative to the
    series; level_covariance (16, 16): common to all epochs; sigma0 (E,); redundancy (E,);
    observed, rejected (E, T); residuals (E, T, 2) px; offsets (T, 2) px, NaN where none was
    estimated; status, reasons: per epoch; stillness (E,): chi-square with 6 degrees of
    freedom of the epoch's own EOP against the series', NaN where the EOP are per epoch; excess_sd
    (16,): by how much neighbouring epochs scatter beyond their noise because the set-up trembles
    or the light flickers; contained in the covariance, 0 where it is not significant; trend_sd
    (16,): what a straight line from the first epoch to the last owes to targets: their coordinates'
    uncertainty where the visible ones changed on the way, slow errors of their own, and a mount
    with memory; perspective_sd (16,): of an epoch whose mount could stand anywhere, NaN where each
    has its own exterior orientation anyway; field_ratio: the standard deviations of the field's
    coordinates over those stated, 1 where no more are shown; outer_noise: noise of the outermost
    target over that in the image's middle, and its standard deviation; noise_ratio: the noise found
    over the one stated; affinity: of C1 and C2 where they are held; movement: of the mount;
    choice: how the exterior orientation was estimated and why; slow (16, 16): covariance of a
    straight line from slow errors of targets; pairs: of coordinates that err together.
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
    noise_ratio: float = 1.0
    affinity: HeldAffinity | None = None
    movement: Movement = STILL
    choice: str = ""
    slow: Array = field(default_factory=lambda: np.zeros((16, 16)))
    pairs: CorrelatedPairs | None = None

    @property
    def exterior(self) -> Exterior:
        """How the exterior orientation was estimated."""
        return self.settings.exterior

    @property
    def sd(self) -> Array:
        """Standard deviations (E, 16), NaN where held; of common parameters with the level."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2).copy()
        common = self.settings.common
        variance[:, common] += np.diag(self.level_covariance)[common]
        out: Array = np.sqrt(np.where(variance > 0, variance, np.nan))
        out[~self.ok] = np.nan
        return out

    @property
    def level_sd(self) -> Array:
        """Standard deviation (16,) of what all epochs have in common."""
        return np.sqrt(np.clip(np.diag(self.level_covariance), 0.0, None))

    @property
    def ok(self) -> Mask:
        """(E,): epochs with a result."""
        return np.array([s == "ok" for s in self.status], dtype=bool)

    @property
    def rows(self) -> EpochRows:
        """The epochs one by one."""
        rejected = self.rejected.sum(axis=1)
        return EpochRows(
            self.values, self.sd, np.where(self.ok, self.sigma0, np.nan), self.redundancy,
            self.stillness, self.observed.sum(axis=1) + rejected, rejected, list(self.status),
            list(self.reasons),
        )  # fmt: skip

    def spread(self, targets: Index, n: int) -> SeriesAdjustment:
        """The same with its columns of targets put where they stand in a larger test field."""
        if len(targets) == n:
            return self

        def wide(array: NDArray[Any], axis: int, fill: Any) -> NDArray[Any]:
            shape = list(array.shape)
            shape[axis] = n
            out = np.full(shape, fill, dtype=array.dtype)
            out[(slice(None),) * axis + (targets,)] = array
            return out

        return replace(
            self,
            observed=wide(self.observed, 1, False),
            rejected=wide(self.rejected, 1, False),
            residuals=wide(self.residuals, 1, np.nan),
            offsets=wide(self.offsets, 0, np.nan),
        )


_FEW = 0.6  # share of a series' targets below which an epoch's geometry is looked at by itself


def enough_targets(grid: ObservationGrid, s: SeriesSettings) -> Mask:
    """(E,): epochs with enough targets for their own parameters."""
    count = 2 * grid.observed.sum(axis=1) - s.carried
    enough: Mask = count >= s.bounds.minimum_redundancy
    return enough


def judge(
    sensor: Sensor,
    testfield: TestField,
    grid: ObservationGrid,
    s: SeriesSettings,
    values: Array,
    use: Mask,
    carried: Mask,
    covariance: Array,
    unit: Array,
    redundancy: Array,
) -> tuple[list[str], list[str]]:
    """Status and reason of every epoch.

    values (E, 16); use (E, T): what took part; carried (E,): whose targets carry the parameters;
    covariance (E, 16, 16); unit (E,): variance of unit weight over the series' own; redundancy
    (E,).
    """
    observed, bounds = grid.observed, s.bounds
    offered, used = observed.sum(axis=1), use.sum(axis=1)
    status, reasons = ["ok"] * len(use), [""] * len(use)

    def say(rows: NDArray[np.bool_], word: str, sentence: str) -> None:
        for row in np.flatnonzero(rows):
            if status[row] == "ok":
                status[row] = word
                reasons[row] = sentence.format(n=offered[row], bad=offered[row] - used[row])

    few = 2 * offered - s.carried < TRUSTED_REDUNDANCY
    most = np.where(few, most_rejected(s.max_rejected, 0), s.max_rejected)
    say(offered == 0, "no_observations", "no target was measured")
    say(
        ~enough_targets(grid, s),
        "too_few_targets",
        f"{{n}} targets for {s.carried} unknowns of the epoch leave too little "
        "redundancy: show more targets or hold parameters fixed",
    )
    say(
        used < (1 - most) * offered,
        "too_many_rejected",
        "{bad} of {n} targets contradict the others: a moved test field, a wrong one, or a "
        "blurred image",
    )
    say(~carried, "weak_geometry", "these targets cannot carry the parameters")
    say(
        fails_global_test(unit, redundancy),
        "global_test",
        "the residuals are larger than the series' noise allows, and too few to tell which target "
        "is wrong: show more targets",
    )
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    c, pitch = values[:, 0], sensor.pixel_pitch
    say(
        np.sqrt(np.maximum(variance[:, 0], 0.0)) > bounds.relative_sd_c * c,
        "weak_geometry",
        f"the principal distance is known to worse than {bounds.relative_sd_c:.1%}",
    )
    say(
        np.sqrt(variance[:, PRINCIPAL_POINT].max(axis=1).clip(0.0)) > bounds.sd_point_px * pitch,
        "weak_geometry",
        f"the principal point is known to worse than {bounds.sd_point_px:.0f} px",
    )
    # Geometry is that of the series' targets; only epochs that see few of them are looked at
    # one by one.
    ever = use.any(axis=0).sum()
    few = (used < _FEW * ever) & (np.array(status) == "ok")
    typical = int(np.argmax(used))
    for row in {typical, *map(int, np.flatnonzero(few))}:
        if status[row] != "ok":
            continue
        seen = use[row]
        found = weaknesses(
            sensor, testfield.points[seen], grid.points[row, seen], values[row], covariance[row],
            s.free, bounds,
        )  # fmt: skip
        said = "; ".join(found).replace("{", "(").replace("}", ")")
        if said and row == typical:
            say(np.ones(len(use), dtype=bool), "weak_geometry", said)
        elif said:
            status[row], reasons[row] = "weak_geometry", said
    return status, reasons
