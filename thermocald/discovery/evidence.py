"""Movements of the test field: targets that jump, boards that move, targets that wander.

They are found in the residuals of a free camera per epoch, so that no change of the camera can be
mistaken for them, and removed before the parameters' trajectories are examined. A board that was
knocked or creeps is put back to its place; a target that jumps or wanders is left out.

Source: a step at an unknown time, Page (1955), Biometrika 42, 523-527.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.errors import DataError
from thermocald.photogrammetry.field.planes import field_sheets
from thermocald.photogrammetry.linalg import mad_sd
from thermocald.photogrammetry.series.field_motion import (
    FEW_TARGETS,
    MOST_TARGETS,
    FieldMovement,
    FieldSeries,
    board_movements,
    refined,
    wandering_targets,
)
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.thermal.reduce import with_points, without_targets
from thermocald.thermal.series import cosines
from thermocald.thermal.source import refuse_copies

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.thermal.series import ReducedSeries, SeriesInput


def require_other_series(series: Sequence[SeriesInput]) -> None:
    """Refuse verification series of another camera or thermometer, and copies."""
    a = series[0]
    reference = next(iter(a.readings), None)
    for b in series[1:]:
        if a.camera != b.camera or a.sensor != b.sensor:
            raise DataError(
                f"{b.name} has another camera ({b.camera}, {b.sensor.width}×{b.sensor.height} px)"
                f" than {a.name} ({a.camera}, {a.sensor.width}×{a.sensor.height} px); constants of "
                "one camera cannot be verified on another"
            )
        if reference is not None and reference != next(iter(b.readings), None):
            raise DataError(
                f"{b.name}: the reference temperature is {next(iter(b.readings), 'missing')!r}, in "
                f"{a.name} it is {reference!r}; both series need the same thermometer"
            )
    refuse_copies([(one.name, one.grid.points) for one in series])


_PASSES = 2


def replace_moved_boards(evidence: ReducedSeries) -> tuple[list[FieldMovement], ReducedSeries]:
    """Find the boards that moved, and put them back to their places."""
    series = _field_series(evidence)
    movements = board_movements(series, wandering_targets(series))
    if not movements:
        return [], evidence
    still = _put_boards_back(evidence, movements)
    for _ in range(_PASSES):
        movements = [refined(_field_series(still), m) for m in movements]
        still = _put_boards_back(evidence, movements)
    return movements, still


def _put_boards_back(evidence: ReducedSeries, movements: list[FieldMovement]) -> ReducedSeries:
    """Reduce the series again with the boards in their places."""
    grid = evidence.source.grid
    points = np.array(grid.points)
    for m in movements:
        points[:, m.rows] -= m.trajectory[:, None, None] * m.image
    return with_points(evidence, ObservationGrid(points, grid.weights))


def drop_wandering_targets(evidence: ReducedSeries) -> tuple[list[FieldMovement], ReducedSeries]:
    """Find the targets that wander, and reduce the series without them.

    Among few targets, wandering ones dominate the noise, and without them others may stand out.
    """
    wandering: list[FieldMovement] = []
    still, every = evidence, int(evidence.weights[..., 0].any(axis=0).sum())
    while more := wandering_targets(_field_series(still)):
        if len(wandering) + len(more) > MOST_TARGETS * every:
            break
        wandering += more
        rows = np.concatenate([m.rows for m in wandering])
        still = without_targets(evidence, np.union1d(evidence.excluded, rows))
        if every > FEW_TARGETS:
            break
    return wandering, still


def _field_series(e: ReducedSeries) -> FieldSeries:
    field = e.source.field
    boards = field_sheets(field)
    return FieldSeries(
        e.times, e.residuals, e.weights, e.columns, e.at.B, field.points, boards, field.names,
        e.numbers,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Displaced:
    """Targets that moved together.

    rows: of the field; time, sd_time: s from the series' start; vectors, sd_vectors: (k, 3) mm,
    the displacements across the rays, which is all that an image shows; steps: (k, 2) px.
    """

    rows: NDArray[np.int64]
    time: float
    sd_time: float
    vectors: Array
    sd_vectors: Array
    steps: Array
    gain: float


_LASTING = 3  # points on either side of a step: two may be gross errors


def _find_steps(evidence: ReducedSeries) -> tuple[Array, NDArray[np.int64], Array]:
    """Find the best step of each target: gain (T,), first epoch after it, share of movement."""
    w = np.sqrt(evidence.weights[..., :2])
    r = evidence.residuals * w
    # noise may grow with heat, so each epoch is divided by its own spread
    own = np.array([mad_sd(x) if np.isfinite(x).any() else 1.0 for x in r])
    r = np.nan_to_num(r / np.maximum(own, 0.3)[:, None, None])
    there = np.isfinite(evidence.residuals[..., 0]).astype(float)
    count = np.cumsum(there, axis=0)
    total = count[-1]
    before = count[:-1]
    after = total - before
    sums = np.cumsum(r, axis=0)
    s0, s1 = sums[:-1], sums[-1] - sums[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = s1 / after[..., None] - s0 / before[..., None]
        gain = np.sum(difference**2, axis=2) * before * after / total
    gain = np.where(np.minimum(before, after) >= _LASTING, np.nan_to_num(gain), 0.0)
    best = np.argmax(gain, axis=0)
    columns = np.arange(gain.shape[1])
    top = gain[best, columns]
    # share of this step in all slow movement
    slow = cosines(evidence.times, 14)
    slow = slow / np.linalg.norm(slow, axis=1, keepdims=True)
    step = (np.arange(len(r))[:, None] > best[None]).astype(float)
    mean = np.sum(r * there[..., None], axis=0) / np.maximum(total, 1)[:, None]
    high = s1[best, columns] / np.maximum(after[best, columns], 1)[:, None] - mean
    low = s0[best, columns] / np.maximum(before[best, columns], 1)[:, None] - mean
    model = np.where(step[..., None] > 0, high, low) * there[..., None]
    left = np.einsum("je,etk->jtk", slow, r - model)
    rest = np.maximum(np.sum(left**2, axis=(0, 2)) - 2 * len(slow), 0.0)
    return top, best + 1, top / np.maximum(top + rest, 1e-9)


def _lasts(residuals: Array, first: int) -> bool:
    """Test whether a step in residuals (E, 2) persists; a gross error, too, changes a mean."""
    before, after = residuals[:first], residuals[first:]
    mean = np.nanmean(after, axis=0) - np.nanmean(before, axis=0)
    middle = np.nanmedian(after, axis=0) - np.nanmedian(before, axis=0)
    return bool(np.sum(mean * middle) > 0.5 * np.sum(mean**2))


def find_displaced_targets(evidence: ReducedSeries) -> tuple[list[Displaced], ReducedSeries]:
    """Find the targets that jumped, and reduce the series without them.

    A marker jumps as a whole: if only some of its corners jump, it was badly measured and is left
    out without being reported.
    """
    jumps: dict[int, tuple[int, float]] = {}
    limit = criteria.STEP_CHI2 * evidence.correlation
    cleaned, groups = evidence, evidence.source.field.groups
    seen = evidence.source.grid.observed.any(axis=0)
    for _ in range(8):
        gain, first, share = _find_steps(cleaned)
        w = cleaned.weights[..., 0]
        sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
        there = np.isfinite(cleaned.residuals[..., 0]).sum(axis=0)
        size = 2.0 * sigma * np.sqrt(gain / np.maximum(there, 1))
        # real targets wander: a gain that many of them reach is no displacement
        common = 8.0 * float(np.percentile(gain[there > 0], 85)) if (there > 0).any() else 0.0
        top = float(gain.max(initial=0.0))
        # a moved target drags the camera and so all others: the largest steps go first
        chosen = np.flatnonzero(
            (gain > max(limit, common, 0.3 * top))
            & (share > criteria.STEP_SHARE)
            & (size > criteria.STEP_PX)
        )
        chosen = np.array([t for t in chosen if _lasts(cleaned.residuals[:, t], first[t])], int)
        if not len(chosen):
            break
        for row in chosen:
            jumps[int(row)] = (int(first[row]), float(gain[row]))
        if len(jumps) > 0.2 * seen.sum():
            return [], evidence  # so many do not jump independently: the camera moved
        # a marker is left out as a whole
        cleaned = without_targets(evidence, np.flatnonzero(np.isin(groups, groups[sorted(jumps)])))
    if not jumps:
        return [], evidence
    jumped = {}
    for corner, jump in jumps.items():
        corners = np.flatnonzero((groups == groups[corner]) & seen)
        together = [r for r in corners.tolist() if r in jumps and abs(jumps[r][0] - jump[0]) <= 1]
        if 4 * len(together) >= 3 * len(corners):
            jumped[corner] = jump
    return _group_steps(cleaned, jumped) if jumped else [], cleaned


_GROSS_CHI2 = 25.0  # the most that one point says about the time of a step


def _date_step(times: Array, later: Array) -> tuple[float, float]:
    """Return the time of a step and its sd, s.

    later (E,): χ² of each epoch's points if they are before the step, minus that if they are after.
    A step in an interval is as probable as the likelihood times the interval's length.
    """
    gain, length = -np.cumsum(later)[:-1], np.diff(times)
    share = length * np.exp(0.5 * (gain - gain.max()))
    share /= share.sum()
    middle = 0.5 * (times[:-1] + times[1:])
    time = float(share @ middle)
    return time, float(np.sqrt(share @ ((middle - time) ** 2 + length**2 / 12.0)))


def _group_steps(cleaned: ReducedSeries, jumps: dict[int, tuple[int, float]]) -> list[Displaced]:
    """Measure the steps against the camera from the other targets; one group per time."""
    rows = np.array(sorted(jumps))
    v = cleaned.left_by_cameras(rows)
    w = cleaned.weights[..., 0]
    sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
    v = np.where(np.abs(v - np.nanmedian(v, axis=0)).max(axis=2, keepdims=True) < 1e6, v, np.nan)
    firsts = np.array([jumps[row][0] for row in rows.tolist()])
    order = np.argsort(firsts)
    out = []
    for group in np.split(order, np.flatnonzero(np.diff(firsts[order]) > 1) + 1):
        first = int(np.median(firsts[group]))
        steps, vectors, sds = [], [], []
        later = np.zeros(len(v))
        for k in group:
            b, a = v[:first, k], v[first:, k]
            b, a = b[np.isfinite(b[:, 0])], a[np.isfinite(a[:, 0])]
            levels = np.median(b, axis=0), np.median(a, axis=0)
            off = [np.sum((v[:, k] - level) ** 2, axis=1) / sigma**2 for level in levels]
            later += np.nan_to_num(np.subtract(*np.minimum(off, _GROSS_CHI2)))
            step = levels[1] - levels[0]
            variance = (np.pi / 2) * sigma**2 * (1 / max(len(a), 1) + 1 / max(len(b), 1))
            B = cleaned.at.B[rows[k]]
            inverse = np.linalg.pinv(B)
            steps.append(step)
            vectors.append(inverse @ step)
            sds.append(np.sqrt(np.diag(inverse @ inverse.T) * variance))
        out.append(
            Displaced(
                rows[group],
                *_date_step(cleaned.times, later),
                np.array(vectors),
                np.array(sds),
                np.array(steps),
                sum(jumps[int(rows[k])][1] for k in group),
            )
        )
    return out
