"""Boards of a test field that move as rigid bodies: knocked, or creeping.

Of a board, a step at an unknown time and slow settling in its six degrees of freedom are compared
with what a free camera per epoch cannot take up of them. A board has moved where that explains most
of its targets' slow movement, most of what each of them would do by itself, and far more than the
same explains of the boards that stand.

Source: a step at an unknown time as Page (1955), Biometrika 42, 523-527.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.planes import FEWEST_ON_A_SHEET
from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.field_motion import (
    FEWEST_EPOCHS,
    GAIN,
    LEAST_PX,
    OTHERS,
    FieldMovement,
    FieldSeries,
    cosines,
    put_back,
    wandering_targets,
    weighted_products,
    with_free_cameras,
    without,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

    Rows = NDArray[np.int64]

__all__ = ["board_movements", "refined"]

_SIDE = 4  # epochs before and after a knock
_LARGEST = 0.6  # share of the targets on one board: beyond, the others moved
_FEWEST_OTHERS = 8
_SHARE = 0.6  # of a board's slow movement that its trajectory has to explain
_RIGID = 0.5  # of what its targets would do one by one that the board has to explain
_MOST_BOARDS = 4
_TRIES = 400  # times of a knock
_SETTLING = (0.08, 0.3)  # of the duration: time constants


def board_movements(s: FieldSeries) -> list[FieldMovement]:
    """Boards that were knocked or creep, the largest first; each with the others in place."""
    if len(s.times) < FEWEST_EPOCHS:
        return []
    for single in wandering_targets(s):  # it would pull at the cameras, and they at the boards
        s = without(s, single.rows)
    seen = s.used.any(axis=0)
    boards = {}
    for label in np.unique(s.boards[s.boards >= 0]):
        rows = np.flatnonzero((s.boards == label) & seen)
        others = int(seen.sum()) - len(rows)
        if FEWEST_ON_A_SHEET <= len(rows) <= _LARGEST * seen.sum() and others >= _FEWEST_OTHERS:
            boards[int(label)] = rows
    found: list[FieldMovement] = []
    while len(found) < _MOST_BOARDS and len(boards) > 0:
        free = with_free_cameras(s)
        trials = {label: _board(free, rows) for label, rows in boards.items()}
        moved = {k: t for k, t in trials.items() if t is not None}
        if not moved:
            break
        label = max(moved, key=lambda k: moved[k].gain)
        best = moved[label]
        s = put_back(s, best)
        if best.gain < OTHERS * _usual(
            with_free_cameras(s), [r for k, r in boards.items() if k != label]
        ):
            break
        found.append(best)
    return found


def _usual(s: FieldSeries, boards: list[Rows]) -> float:
    """χ² that boards which stand usually explain by moving."""
    trajectories, _ = _trajectories(s.times)
    gains = [_gains(*_board_equations(s, r, _rigid(s, r)), trajectories)[0].max() for r in boards]
    return float(np.median(gains)) if gains else 0.0


def refined(s: FieldSeries, movement: FieldMovement) -> FieldMovement:
    """A board's movement with what a series, from which it was removed, still shows of it.

    Gross errors are looked for again once a board is back in its place.
    """
    free = with_free_cameras(s)
    rigid = _rigid(free, movement.rows)
    M, r = _board_equations(free, movement.rows, rigid)
    step = _gains(M, r, movement.trajectory[None])[1][0]
    image = movement.image + (rigid @ step).reshape(-1, 2)
    covariance = inverse_of_determined(_information(M, movement.trajectory))
    size, sd = _across(s.B[movement.rows], image, rigid, covariance)
    size_px = float(np.sqrt(np.mean(image**2)))
    return replace(movement, image=image, size_mm=size, sd_mm=sd, size_px=size_px)


def _board(s: FieldSeries, rows: Rows) -> FieldMovement | None:
    """The best trajectory of one board; None where it stands."""
    rigid = _rigid(s, rows)
    M, r = _board_equations(s, rows, rigid)
    trajectories, firsts = _trajectories(s.times)
    gain, steps = _gains(M, r, trajectories)
    best = int(np.argmax(gain))
    if gain[best] < GAIN:
        return None
    epoch = firsts[best]
    if epoch and len(firsts) < len(s.times) - _SIDE:  # a long series: the epochs between two tries
        stride = firsts[1] - firsts[0]
        near = range(max(epoch - stride, _SIDE), min(epoch + stride, len(s.times) - _SIDE) + 1)
        trajectories, firsts = _steps(len(s.times), near), list(near)
        finer, steps = _gains(M, r, trajectories)
        best = int(np.argmax(finer))
        epoch, gain = firsts[best], finer
    slow = cosines(s.times)
    share = gain[best] / max(float(_gains(M, r, slow)[0].sum()) - 6 * len(slow), gain[best])
    trajectory, step = trajectories[best], steps[best]
    w, v = s.w[:, rows], np.nan_to_num(s.residuals[:, rows])
    weight = np.maximum(w.sum(axis=0), 1e-12)
    c = trajectory[:, None, None] - (w * trajectory[:, None, None]).sum(axis=0) / weight
    each = np.sum(w * c * v, axis=0) ** 2 / np.maximum(np.sum(w * c**2, axis=0), 1e-12)
    one_by_one = float(each.sum()) - 2 * len(rows)
    image = (rigid @ step).reshape(-1, 2)
    size_px = float(np.sqrt(np.mean(image**2)))
    if share < _SHARE or gain[best] < _RIGID * one_by_one or size_px < LEAST_PX:
        return None
    covariance = inverse_of_determined(_information(M, trajectory))
    size, sd = _across(s.B[rows], image, rigid, covariance)
    before, after = s.times[max(epoch - 1, 0)], s.times[epoch]
    return FieldMovement(
        "knock" if epoch else "creep", rows, tuple(s.names[r] for r in rows),
        int(s.numbers[epoch]) if epoch else 0, float(0.5 * (before + after)),
        float((after - before) / np.sqrt(12.0)), trajectory, image, size, sd, size_px,
        float(gain[best]),
    )  # fmt: skip


def _rigid(s: FieldSeries, rows: Rows) -> Array:
    """∂ image points (2k,) / ∂ shifts mm and turns, these in mm at the board's size, (2k, 6)."""
    X = s.points[rows] - s.points[rows].mean(axis=0)
    size = max(float(np.sqrt((X**2).sum(axis=1).mean())), 1e-9)
    x, y, z = X.T / size
    o = np.zeros_like(x)
    turns = np.stack([np.stack([o, -z, y]), np.stack([z, o, -x]), np.stack([-y, x, o])], axis=-1)
    motion = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(X), 3, 3)), np.swapaxes(turns, 0, 1)], axis=2
    )
    out: Array = (s.B[rows] @ motion).reshape(-1, 6)
    return out


def _board_equations(s: FieldSeries, rows: Rows, rigid: Array) -> tuple[Array, Array]:
    """Normal equations (E, 6, 6), (E, 6) of a board's movement, the cameras eliminated."""
    assert s.cameras is not None
    w = s.w[:, rows].reshape(len(s.times), -1)
    C = weighted_products(w, rigid, s.A[rows].reshape(-1, s.A.shape[-1]))
    M = weighted_products(w, rigid, rigid) - C @ s.cameras @ np.swapaxes(C, 1, 2)
    v = np.nan_to_num(s.residuals[:, rows]).reshape(len(w), -1)
    return M, (w * v) @ rigid


def _trajectories(times: Array) -> tuple[Array, list[int]]:
    """Steps at some hundred epochs, then settling, (n, E), 0 to 1; a step's first epoch, else 0."""
    E = len(times)
    stride = int(np.ceil(E / _TRIES))
    firsts = range(_SIDE, E - _SIDE + 1, stride)
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    slow = [u, *((1 - np.exp(-u / f)) / (1 - np.exp(-1 / f)) for f in _SETTLING)]
    return np.concatenate([_steps(E, firsts), np.stack(slow)]), [*firsts, *(0 for _ in slow)]


def _steps(epochs: int, firsts: range) -> Array:
    """Steps (n, E) at some epochs."""
    return (np.arange(epochs) >= np.array(firsts)[:, None]).astype(float)


def _gains(M: Array, r: Array, trajectories: Array) -> tuple[Array, Array]:
    """χ² (n,) that a board explains by moving along each trajectory, and the movements (n, 6)."""
    E = len(M)
    flat = M.reshape(E, -1)
    N11 = M.sum(axis=0)
    N12 = (trajectories @ flat).reshape(-1, 6, 6)
    N22 = (trajectories**2 @ flat).reshape(-1, 6, 6)
    held = 1e-9 * float(np.trace(N11)) * np.eye(6) + 1e-12 * np.eye(6)
    X = np.linalg.solve(N11 + held, N12)
    own = N22 - N12 @ X
    right = trajectories @ r - X.swapaxes(1, 2) @ r.sum(axis=0)
    steps = np.linalg.solve(own + held, right[..., None])[..., 0]
    gains: Array = np.einsum("ni,ni->n", steps, right)
    return gains, steps


def _information(M: Array, trajectory: Array) -> Array:
    """Normal matrix (6, 6) of a movement along one trajectory, the board's level eliminated."""
    flat = M.reshape(len(M), -1)
    N12 = (trajectory @ flat).reshape(6, 6)
    out: Array = (trajectory**2 @ flat).reshape(6, 6) - N12 @ np.linalg.pinv(M.sum(axis=0)) @ N12
    return out


def _across(B: Array, image: Array, rigid: Array, covariance: Array) -> tuple[float, float]:
    """RMS over targets of the movement across the rays, mm, and its standard deviation."""
    inverse = np.linalg.pinv(B)  # (k, 3, 2)
    moved = np.einsum("kij,kj->ki", inverse, image)
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    # of the RMS, to first order
    by_step = np.einsum("kij,kjp->kip", inverse, rigid.reshape(len(B), 2, 6))
    slope = np.einsum("ki,kip->p", moved, by_step) / max(len(B) * size, 1e-12)
    return size, float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))
