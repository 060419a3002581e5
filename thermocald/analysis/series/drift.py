"""Test of drift in a series, and of its stated standard deviations.

For each parameter: a straight line in time that takes the autocorrelation of its residuals into
account, the study's test for drift of any shape, and the scatter of the epochs beside the stated
standard deviations. A drift is reported only if it is significant at 1 % for all parameters
together (Holm), and does not depend on a single marker or target: the movement of a board is not
one of the camera.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.course import LEVEL, Course
from thermocald.analysis.statistics.dependence import dependence, holm, slope_noise
from thermocald.analysis.statistics.noise_models import drift_test
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, PRINCIPAL
from thermocald.photogrammetry.series.target_noise import slow_errors
from thermocald.thermal.thermometer import estimate_reading_noise

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array

_FEWEST = 10
_LEAST_WARMING_K = 0.5  # a smaller change may be the thermometer's noise
_MOST_VALUES = 100_000  # for a line: of more, neighbours are averaged
_SUSPECTS = 5  # groups that are left out in turn
_SHRUNK = 0.5  # fraction of a change that must vanish without the group that a drift rests on


def _thin(*columns: Array) -> list[Array]:
    """Average neighbours if there are more values than a line needs; drop an incomplete mean."""
    n = len(columns[0])
    size = -(-n // _MOST_VALUES)
    if size == 1:
        return list(columns)
    return [c[: n // size * size].reshape(-1, size).mean(axis=1) for c in columns]


def _p_value(change: float, sd: float) -> float:
    """Return the two-sided p-value of no change, 0 if it is known exactly."""
    from scipy.special import ndtr

    return float(2 * ndtr(-abs(change) / sd)) if sd > 0 else 0.0


def _lines(table: Epochs, names: Sequence[str]) -> dict[str, Course]:
    """Fit straight lines to the estimated parameters; p is corrected for their number (Holm).

    The p-value of no drift is that of `drift_test`, as in a study. If targets are hidden at the end
    but not at the beginning, their coordinate errors tilt the line. All epochs share that part of
    the change's sd, and a slow change that it explains is no drift.
    """
    found, ok = [], table.ok
    time = table.frame_time[ok]
    slow = np.diagonal(table.slow_between_ends)
    whole = table.adjustment if table.sampled is None else None
    # an epoch in which the mount was touched is as uncertain as many others together
    still = ~np.isin(np.flatnonzero(ok), whole.movement.touched if whole else ())
    for name in names:
        column = IOP_NAMES.index(name)
        values, sds = table.values[ok, column], table.sd[ok, column]
        if len(values) < _FEWEST or not np.isfinite(sds).all() or np.ptp(time) == 0:
            continue
        # the sds of means are smaller by one factor, which does not change p
        t, y, sd = _thin(time, values, sds)
        x = t - t.mean()
        slope = float(x @ y / (x @ x))
        sd_slope, *_ = slope_noise(y, x, slope, times=t)
        test = drift_test(y, sd, np.ones(len(y)), times=t)
        p = 1.0 if test is None else test.p_value
        span, tilt_sd = float(np.ptp(time)), float(table.trend_sd[column])
        if tilt_sd > 0:
            p = max(p, _p_value(float(np.ptp(np.polynomial.Polynomial.fit(t, y, 3)(t))), tilt_sd))
        line = Course(
            name, float(values.mean()), float(values[still].std(ddof=1)),
            float(np.sqrt(np.mean(sds[still] ** 2))), slope * span,
            float(np.hypot(sd_slope * span, tilt_sd)), min(1.0, p), drifts=False,
            last_minus_first=float(values[-1] - values[0]),
            sd_last_minus_first=float(np.sqrt(sds[-1] ** 2 + sds[0] ** 2 + slow[column])),
            sd_by_perspective=float(np.sqrt(2.0) * table.perspective_sd[column]),
        )  # fmt: skip
        found.append(line)
    corrected = zip(found, holm([line.p for line in found]), strict=True)
    return {line.name: replace(line, p=p, drifts=p < LEVEL) for line, p in corrected}


def courses(table: Epochs) -> list[Course]:
    """Return how c, x0 and y0 changed over a series; held parameters are left out."""
    ok = table.ok
    lines = _lines(table, IOP_NAMES[PRINCIPAL])
    have = np.flatnonzero(ok)[np.isfinite(table.temperature[ok])]
    temperature, time = table.temperature[have], table.frame_time[have]
    if len(have) >= _FEWEST and np.ptp(temperature) >= _LEAST_WARMING_K:
        warming = temperature - temperature.mean()
        course, variances = table.slow_errors
        per_kelvin = course[:, have] @ warming / (warming @ warming)
        slow = np.sqrt(per_kelvin**2 @ variances)
        for name, line in lines.items():
            column = IOP_NAMES.index(name)
            values, sds = table.values[have, column], table.sd[have, column]
            t, y, sd, times = _thin(temperature, values, sds, time)
            on = dependence(y, sd, t, estimate_reading_noise(times, t, None), times)
            p = max(on.p_value, _p_value(on.slope, slow[column]))
            sd_slope = float(np.hypot(on.sd_slope, slow[column]))
            lines[name] = replace(
                line, per_kelvin=on.slope, sd_per_kelvin=sd_slope, p_temperature=p
            )

    @cache
    def without(group: str) -> dict[str, Course]:
        assert table.without is not None  # as _single_support has checked
        left = table.without(table.groups[group], True)
        return _lines(left, tuple(lines)) if left.ok.sum() >= _FEWEST else {}

    result = []
    p_warm = holm([line.p_temperature for line in lines.values()])
    for line, p in zip(lines.values(), p_warm, strict=True):
        rests_on = _single_support(table, line, without) if line.drifts else None
        drifts = line.drifts and not rests_on
        result.append(replace(line, drifts=drifts, rests_on=rests_on, p_temperature=p))
    return result


def with_drifts(table: Epochs) -> Epochs:
    """Return the epochs with their drifts; a group of targets that alone causes one is left out."""
    found = courses(table)
    moving = next((c.rests_on for c in found if c.rests_on), "")
    if not moving or table.without is None:
        return replace(table, drifts=tuple(found))
    left = table.without(table.groups[moving], False)
    return replace(
        left,
        left_out=(moving,),
        field_movements=table.field_movements,
        drifts=tuple(courses(left)),
    )


def _single_support(
    table: Epochs, line: Course, lines_without: Callable[[str], dict[str, Course]]
) -> str | None:
    """Return the group of targets that alone causes a parameter's drift, or None.

    lines_without: returns all lines of the series without a group. The groups whose residuals
    change most over the series are tried. Without the group the change must shrink by more than
    half and no longer be significant, with the same correction: a group whose absence only makes
    the change less certain does not cause it.
    """
    if table.without is None or table.adjustment is None or len(table.groups) < 3:
        return None
    slow, _ = slow_errors(table.adjustment.residuals, table.adjustment.observed)
    size = {first: float(np.nansum(slow[rows] ** 2)) for first, rows in table.groups.items()}
    best, least = None, _SHRUNK * abs(line.change)
    for first in sorted(size, key=lambda first: -size[first])[:_SUSPECTS]:
        without = lines_without(first).get(line.name)
        if without is not None and not without.drifts and abs(without.change) < least:
            best, least = first, abs(without.change)
    return best
