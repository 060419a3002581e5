"""Did the camera move in this series, and are its standard deviations true?

A straight line in time per parameter, with the autocorrelation of its residuals taken into account,
the study's test for drift of any shape, and the scatter of the epochs, with what the adjustment
said of them. A drift is claimed only where
chance gives its like in less than one series of a hundred, all parameters together (Holm), and
where it does not rest on a single marker or target: a board that gives way is not the camera.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.course import LEVEL, Course
from thermocald.analysis.statistics.dependence import holm, slope_noise, slope_p_value
from thermocald.analysis.statistics.noise_models import drift_test
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, PRINCIPAL
from thermocald.photogrammetry.series.target_noise import slow_errors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array

_FEWEST = 10
_LEAST_WARMING_K = 0.5  # below, the thermometer's own noise is all there is
_MOST_VALUES = 100_000  # of a line: neighbours beyond that are averaged
_SUSPECTS = 5  # groups that are left out in turn
_SHRUNK = 0.5  # of its change must go with a group that a parameter's drift rests on


def _thinned(*columns: Array) -> list[Array]:
    """Means of neighbours where there are more values than a line needs; the rest left out."""
    n = len(columns[0])
    size = -(-n // _MOST_VALUES)
    if size == 1:
        return list(columns)
    return [c[: n // size * size].reshape(-1, size).mean(axis=1) for c in columns]


def _lines(table: Epochs, names: Sequence[str]) -> dict[str, Course]:
    """Straight lines through the parameters that were estimated, p corrected for their number
    (Holm).
    """
    found, ok = [], table.ok
    t = table.frame_time[ok]
    for name in names:
        column = IOP_NAMES.index(name)
        y, sd = table.values[ok, column], table.sd[ok, column]
        if len(y) < _FEWEST or not np.isfinite(sd).all() or np.ptp(t) == 0:
            continue
        line = Course(
            name, float(y.mean()), float(y.std(ddof=1)), float(np.sqrt(np.mean(sd**2))),
            *_line(t, y, sd, float(table.trend_sd[column])), drifts=False,
            last_minus_first=float(y[-1] - y[0]),
            sd_last_minus_first=float(np.hypot(sd[-1], sd[0])),
            sd_by_perspective=float(np.sqrt(2.0) * table.perspective_sd[column]),
        )  # fmt: skip
        found.append(line)
    corrected = zip(found, holm([line.p for line in found]), strict=True)
    return {line.name: replace(line, p=p, drifts=p < LEVEL) for line, p in corrected}


def courses(table: Epochs) -> list[Course]:
    """How c, x0 and y0 changed over a series; those that were held are left out."""
    ok = table.ok
    lines = _lines(table, IOP_NAMES[PRINCIPAL])
    columns = [table.values[ok, IOP_NAMES.index(name)] for name in lines]
    warm = _with_temperature(table.frame_time[ok], table.temperature[ok], columns)

    @cache
    def without(group: str) -> dict[str, Course]:
        assert table.without is not None  # _single_support asks only then
        left = table.without(table.groups[group], True)
        return _lines(left, tuple(lines)) if left.ok.sum() >= _FEWEST else {}

    result = []
    for line, (slope, sd_slope, p_warm) in zip(lines.values(), warm, strict=True):
        rests_on = _single_support(table, line, without) if line.drifts else None
        line = replace(line, per_kelvin=slope, sd_per_kelvin=sd_slope, p_temperature=p_warm)
        result.append(replace(line, drifts=line.drifts and not rests_on, rests_on=rests_on))
    return result


def _with_temperature(
    time: Array, temperature: Array, columns: list[Array]
) -> list[tuple[float, float, float]]:
    """Slope per kelvin, its sd and corrected p-value of each column (n,); NaN without one."""
    have = np.isfinite(temperature)
    unknown = [(float("nan"),) * 3] * len(columns)
    if have.sum() < _FEWEST or np.ptp(temperature[have]) < _LEAST_WARMING_K:
        return unknown
    slopes, sds, ps = [], [], []
    for column in columns:
        t, y, times = _thinned(temperature[have], column[have], time[have])
        t = t - t.mean()
        slopes.append(float(y @ t / (t @ t)))
        sds.append(slope_noise(y, t, slopes[-1]).sd)
        ps.append(slope_p_value(y, t, times))
    return list(zip(slopes, sds, holm(ps), strict=True)) if columns else []


def with_drifts(table: Epochs) -> Epochs:
    """Return the epochs with their drifts, without a group of targets that alone makes one."""
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
    """The group of targets that alone makes a parameter drift, or None.

    lines_without: all lines of the series without a group. Asked are those whose own residuals
    wander most over the series. Without the group that is named the change must shrink by more than
    half and no longer be significant, corrected as with it: a group whose absence only makes the
    change less certain is not accused.
    """
    if table.without is None or table.adjustment is None or len(table.groups) < 3:
        return None
    slow = slow_errors(table.adjustment.residuals, table.adjustment.observed)
    size = {first: float(np.nansum(slow[rows] ** 2)) for first, rows in table.groups.items()}
    best, least = None, _SHRUNK * abs(line.change)
    for first in sorted(size, key=lambda first: -size[first])[:_SUSPECTS]:
        without = lines_without(first).get(line.name)
        if without is not None and not without.drifts and abs(without.change) < least:
            best, least = first, abs(without.change)
    return best


def _line(t: Array, y: Array, sds: Array, tilt_sd: float) -> tuple[float, float, float]:
    """Change of a straight line over the series, its sd, and the p-value of no drift.

    The p-value is that of `drift_test`, as in a study. tilt_sd: the part of the change's sd that
    all epochs share: targets hidden at the end and not at the beginning tilt the line by their
    coordinate errors. What they explain of the slow course is no drift.
    """
    from scipy.stats import norm

    span = float(np.ptp(t))
    t, y, sds = _thinned(t, y, sds)  # means err less than that, by one factor: p stays
    x = t - t.mean()
    slope = float(x @ y / (x @ x))
    noise = slope_noise(y, x, slope, times=t)
    found = drift_test(y, sds, np.ones(len(y)), times=t)
    p = found.p_value if found is not None else 1.0
    if tilt_sd > 0:
        slow = float(np.ptp(np.polynomial.Polynomial.fit(t, y, 3)(t)))
        p = max(p, float(2 * norm.sf(slow / tilt_sd)))
    return slope * span, float(np.hypot(noise.sd * span, tilt_sd)), min(1.0, p)
