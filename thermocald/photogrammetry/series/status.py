"""Whether an epoch of a series has a result: its status, and the reason in a sentence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PRINCIPAL_POINT
from thermocald.photogrammetry.epoch.geometry import weaknesses
from thermocald.photogrammetry.epoch.snooping import (
    TRUSTED_REDUNDANCY,
    fails_global_test,
    most_rejected,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.photogrammetry.series.result import SeriesSettings

__all__ = ["enough_targets", "judge"]

_FEW = 0.6  # share of a series' targets below which an epoch's geometry is looked at by itself


def enough_targets(grid: ObservationGrid, s: SeriesSettings) -> Mask:
    """(E,): epochs with enough targets for their own parameters."""
    count = 2 * grid.observed.sum(axis=1) - s.unknowns
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

    few = 2 * offered - s.unknowns < TRUSTED_REDUNDANCY
    most = np.where(few, most_rejected(s.max_rejected, 0), s.max_rejected)
    say(offered == 0, "no_observations", "no target was measured")
    say(
        ~enough_targets(grid, s),
        "too_few_targets",
        f"{{n}} targets for {s.unknowns} unknowns of the epoch leave too little "
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
