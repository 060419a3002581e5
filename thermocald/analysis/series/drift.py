"""Did the camera move in this series, and are its standard deviations true?

A straight line in time per parameter, with the autocorrelation of its residuals taken into account,
and the scatter of the epochs, with what the adjustment said of them. A drift is claimed only where
chance gives its like in less than one series of a hundred, all parameters together (Holm), and
where it does not rest on a single marker or target: a board that gives way is not the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.autocorrelation import slope_noise
from thermocald.analysis.statistics.dependence import holm, pearson_p_value
from thermocald.analysis.statistics.drift_test import drift_test
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.series.spool import released
from thermocald.photogrammetry.series.target_noise import slow_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from thermocald.analysis.series.table import SeriesTable
    from thermocald.arrays import Array

__all__ = ["Course", "courses", "settled"]

_LEVEL = 0.01
_FEWEST = 10
_LEAST_WARMING_K = 0.5  # below, the thermometer's own noise is all there is
_MOST_VALUES = 100_000  # of a line: neighbours beyond that are averaged
_SUSPECTS = 5  # groups that are left out in turn
_BEYOND_TILT = 6.0  # sds of the tilt: a range that hidden targets do not explain
_SHRUNK = 0.5  # of its change must go with a group that a parameter's drift rests on


@dataclass(frozen=True, slots=True)
class Course:
    """One parameter over a series, in its own unit.

    mean; scatter: standard deviation over the epochs; sd: stated by the adjustments, RMS; change:
    of a straight line from the first to the last epoch, with sd_change; p: that chance gives as
    much, corrected for the number of parameters; drifts: p below 1 %, with and without any single
    group of targets; rests_on: the group without which there would be no drift, or "";
    per_kelvin, p_temperature: slope on the reference temperature and its p-value, corrected, NaN
    where that is constant or not known; last_minus_first: between the first and the last epoch.
    """

    name: str
    mean: float
    scatter: float
    sd: float
    change: float
    sd_change: float
    p: float
    drifts: bool
    rests_on: str = ""
    per_kelvin: float = float("nan")
    p_temperature: float = float("nan")
    last_minus_first: float = float("nan")
    sd_last_minus_first: float = float("nan")

    @property
    def moves(self) -> bool:
        """Whether the camera moved: in time, or with its temperature."""
        return self.drifts or self.p_temperature < _LEVEL


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """A straight line through one parameter: values and sds (n,), its change, sd and p-value."""

    name: str
    values: Array
    sds: Array
    change: float
    sd_change: float
    p: float


def _column(values: Array, ok: NDArray[np.bool_], column: int) -> Array:
    """One parameter of the epochs with a result; the others of a long series leave memory."""
    out: Array = values[ok, column]
    released(values)
    return out


def _thinned(*columns: Array) -> list[Array]:
    """Means of neighbours where there are more values than a line needs; the rest left out."""
    n = len(columns[0])
    size = -(-n // _MOST_VALUES)
    if size == 1:
        return list(columns)
    return [c[: n // size * size].reshape(-1, size).mean(axis=1) for c in columns]


def _lines(table: SeriesTable, names: tuple[str, ...]) -> dict[str, _Line]:
    """Lines through the parameters that were estimated, p corrected for their number (Holm)."""
    found = []
    ok = table.ok
    t = table.frame_time[ok]
    for name in names:
        column = IOP_NAMES.index(name)
        y, sd = _column(table.values, ok, column), _column(table.sd, ok, column)
        if len(y) < _FEWEST or not np.isfinite(sd).all() or np.ptp(t) == 0:
            continue
        tilt = float(table.trend_sd[column])
        found.append(_Line(name, y, sd, *_line(t, y, sd, tilt)))
    corrected = holm([line.p for line in found])
    return {line.name: replace(line, p=p) for line, p in zip(found, corrected, strict=True)}


def courses(table: SeriesTable, names: tuple[str, ...] = ("c", "x0", "y0")) -> list[Course]:
    """How parameters changed over a series; those that were held are left out."""
    ok = table.ok
    lines = _lines(table, names)
    warm = _with_temperature(table.temperature[ok], [line.values for line in lines.values()])
    result = []

    @cache
    def without(group: str) -> dict[str, _Line]:
        assert table.without is not None  # _single_support asks only then
        left = table.without(table.groups[group], True)
        return _lines(left, tuple(lines)) if left.ok.sum() >= _FEWEST else {}

    for line, (slope, p_warm) in zip(lines.values(), warm, strict=True):
        rests_on = _single_support(table, line, without) if line.p < _LEVEL else ""
        y, sd = line.values, line.sds
        result.append(
            Course(
                line.name,
                float(y.mean()),
                float(y.std(ddof=1)),
                float(np.sqrt(np.mean(sd**2))),
                line.change,
                line.sd_change,
                line.p,
                line.p < _LEVEL and not rests_on,
                rests_on,
                slope,
                p_warm,
                float(y[-1] - y[0]),
                float(np.hypot(sd[-1], sd[0])),
            )
        )
    return result


def _with_temperature(temperature: Array, columns: list[Array]) -> list[tuple[float, float]]:
    """Slope per kelvin and corrected p-value of each column (n,); NaN without a temperature."""
    have = np.isfinite(temperature)
    unknown = [(float("nan"), float("nan"))] * len(columns)
    if have.sum() < _FEWEST or np.ptp(temperature[have]) < _LEAST_WARMING_K:
        return unknown
    slopes, ps = [], []
    for column in columns:
        t, y = _thinned(temperature[have], column[have])
        t = t - t.mean()
        slopes.append(float(y @ t / (t @ t)))
        n = slope_noise(y, t, slopes[-1]).n_effective
        ps.append(pearson_p_value(float(np.corrcoef(y, t)[0, 1]), n))
    return list(zip(slopes, holm(ps), strict=True)) if columns else []


def settled(table: SeriesTable) -> tuple[SeriesTable, list[Course]]:
    """The table without a group of targets that alone makes a parameter drift, and its courses."""
    found = courses(table)
    moving = next((c.rests_on for c in found if c.rests_on), "")
    if not moving or table.without is None:
        return table, found
    left = replace(
        table.without(table.groups[moving], False), left_out=(moving,),
        field_movements=table.field_movements,
    )  # fmt: skip
    return left, courses(left)


def _single_support(
    table: SeriesTable, line: _Line, lines_without: Callable[[str], dict[str, _Line]]
) -> str:
    """The group of targets that alone makes a parameter drift, or "".

    lines_without: all lines of the series without a group. Without the group that is named the
    change must shrink by more than half and no longer be significant, corrected as with it: a group
    whose absence only makes the change less certain is not accused.
    """
    if table.without is None or len(table.groups) < 3:
        return ""
    best, least = "", _SHRUNK * abs(line.change)
    for first in _suspects(table):
        without = lines_without(first).get(line.name)
        if without is None or without.p < _LEVEL:
            continue
        if abs(without.change) < least:
            best, least = first, abs(without.change)
    return best


def _suspects(table: SeriesTable) -> list[str]:
    """The groups whose own residuals wander most over the series."""
    if table.adjustment is None:
        return []
    slow = slow_errors(table.adjustment.residuals, table.adjustment.observed)
    size = {first: float(np.nansum(slow[rows] ** 2)) for first, rows in table.groups.items()}
    return sorted(size, key=lambda first: -size[first])[:_SUSPECTS]


def _line(t: Array, y: Array, sds: Array, tilt_sd: float) -> tuple[float, float, float]:
    """Change of a straight line over the series, its sd, and the p-value of no drift.

    The p-value is twice the smaller one of the line's and of drift of any shape. tilt_sd: the part
    of the change's sd that all epochs share: targets hidden at the end and not at the beginning
    tilt the line by their coordinate errors.
    """
    from scipy.stats import t as student

    span = float(np.ptp(t))
    t, y, sds = _thinned(t, y, sds)  # means err less than that, by one factor: p stays
    x = t - t.mean()
    slope = float(x @ y / (x @ x))
    noise = slope_noise(y, x, slope)
    freedom = max(noise.n_effective - 2.0, 1.0)
    residual = y - y.mean() - slope * x
    own = float(np.sqrt(np.mean(residual**2) / freedom)) / float(x.std()) * span
    p = 2 * student.sf(abs(slope) * span / float(np.hypot(own, tilt_sd)), freedom)
    shape = None
    if np.ptp(y) > _BEYOND_TILT * tilt_sd:
        shape = drift_test(y, sds, np.ones(len(y)))
    both = 2.0 * min(float(p), shape.p_value if shape is not None else 1.0)
    return slope * span, float(np.hypot(noise.sd * span, tilt_sd)), min(1.0, both)
