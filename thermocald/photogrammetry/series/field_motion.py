"""Movements of the test field: targets that wander, and boards that move as rigid bodies.

Movements are estimated from the residuals of a free camera per epoch, which contain no movement of
the camera. A single target wanders if its slow residuals are far larger than those of the others on
its board; in a real field residuals are never quite constant. For a board two trajectories are
tested in its six degrees of freedom, reduced by the free cameras: a step at an unknown time (a
knock) and slow settling (creep). A board has moved if a trajectory explains most of its targets'
slow movement, most of what single movements of its targets would explain, and far more than the
same explains for boards that stand still.

Source: a step at an unknown time as Page (1955), Biometrika 42, 523-527.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.field.planes import FEWEST_ON_A_SHEET
from thermocald.photogrammetry.linalg import inverse_of_determined, rigid_motion
from thermocald.photogrammetry.series.normals import ObservationGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index, Mask


FEWEST_EPOCHS = 20
"""Epochs needed to show a movement of the field."""
GAIN = 100.0
"""Least χ² of a movement: with six degrees of freedom and a thousand tests its level is 1e-15."""
LEAST_PX = 0.02
"""Movements below it are not reported."""
OTHERS = 8.0
"""Least ratio of a movement's χ² to that of most others."""
MOST_TARGETS = 0.2
"""Share of the targets that can wander; if more seem to, none is reported."""
FEW_TARGETS = 100
"""Number of targets up to which wandering ones may mask each other."""

_ORDERS = 14  # of slow trajectories
_PASSES = 3
_MOST = 80.0  # percentile of the targets' χ² that represents most others
_SEEN = 0.3  # share of the epochs: points of a fast wander are often rejected as gross errors
_ON_TRIAL = 4  # most targets that are left out together on trial
_LEAST_FREE = 0.05  # redundancy of a coordinate


@dataclass(frozen=True, eq=False)
class FieldSeries:
    """The residuals of a series, for the analysis of its field.

    times (E,) s; residuals (E, T, 2) px: NaN if unseen; weights (E, T, 3) px⁻²; A (T, 2, P), B
    (T, 2, 3): partials with respect to the camera's parameters and the object points; points (T, 3)
    mm; boards (T,): labels, -1 for none; names: of the targets; numbers (E,): of the epochs;
    cameras (E, P, P): inverse normal matrices of free cameras, once these are reduced.
    """

    times: Array
    residuals: Array
    weights: Array
    A: Array
    B: Array
    points: Array
    boards: Index
    names: tuple[str, ...]
    numbers: Index
    cameras: Array | None = None

    @property
    def used(self) -> Mask:
        """Mask (E, T) of the image points with a residual and a weight."""
        return np.isfinite(self.residuals[..., 0]) & (self.weights[..., 0] > 0)

    @property
    def w(self) -> Array:
        """Weights (E, T, 2) of the coordinates, 0 for points not used."""
        return np.where(self.used[..., None], self.weights[..., :2], 0.0)


@dataclass(frozen=True, eq=False)
class FieldMovement:
    """One board or target that moved.

    kind: `knock`, `creep` or `wander`; rows: of the k targets in the field; targets: their names;
    epoch: number of the first epoch after a knock, else 0; time, sd_time s: of a knock, from the
    start of the series; trajectory (E,): 0 to 1; image (k, 2) px: whole movement in the image;
    size_mm, sd_mm: RMS over the targets across the rays; size_px; gain: χ² that it explains.
    """

    kind: str
    rows: Index
    targets: tuple[str, ...]
    epoch: int
    time: float
    sd_time: float
    trajectory: Array
    image: Array
    size_mm: float
    sd_mm: float
    size_px: float
    gain: float

    @property
    def sentence(self) -> str:
        """The movement in words."""
        who = f"{self.targets[0]} to {self.targets[-1]} ({len(self.targets)} targets)"
        size = f"{self.size_mm:.3f} ± {self.sd_mm:.3f} mm ({self.size_px:.3f} px)"
        if self.kind == "knock":
            return f"the board of {who} was moved by {size} at {self.time:.0f} s"
        if self.kind == "creep":
            return f"the board of {who} creeps, by {size} over the series"
        return f"target {self.targets[0]} wanders by {size} RMS"

    def as_dict(self) -> dict[str, Any]:
        """Return the movement as an entry of a document."""
        knocked = self.kind == "knock"
        return {
            "kind": self.kind,
            "targets": list(self.targets),
            "time_s": self.time if knocked else None,
            "sd_time_s": self.sd_time if knocked else None,
            "epoch": self.epoch if knocked else None,
            "size_mm": self.size_mm,
            "sd_size_mm": self.sd_mm,
            "size_px": self.size_px,
        }


def without(s: FieldSeries, rows: Index) -> FieldSeries:
    """Return the series as if some targets had not been observed."""
    weights = s.weights.copy()
    weights[:, rows] = 0.0
    return replace(s, weights=weights)


def taken_off(
    grid: ObservationGrid, moved: Sequence[FieldMovement], rows: slice = slice(None)
) -> ObservationGrid:
    """Return observations as of a still field: boards moved back, wandering targets left out.

    rows: the grid's epochs within the movements' trajectories.
    """
    points, wandering = grid.points.copy(order="K"), np.zeros(grid.points.shape[1], dtype=bool)
    for m in moved:
        if m.kind == "wander":
            wandering[m.rows] = True
        else:
            points[:, m.rows] -= m.trajectory[rows, None, None] * m.image
    return ObservationGrid(points, grid.weights).reject(wandering)


def put_back(s: FieldSeries, movement: FieldMovement) -> FieldSeries:
    """Return the series as if a board had not moved."""
    residuals = s.residuals.copy()
    residuals[:, movement.rows] -= movement.trajectory[:, None, None] * movement.image
    return replace(s, residuals=residuals)


def wandering_targets(s: FieldSeries) -> list[FieldMovement]:
    """Find single targets whose slow residuals are far larger than those of others on their board.

    Several among few targets may distort the cameras so that none stands out: these are found by
    leaving them out together.
    """
    if len(s.times) < FEWEST_EPOCHS:
        return []
    found: list[FieldMovement] = []
    most = MOST_TARGETS * int(s.used.any(axis=0).sum())
    for _ in range(max(int(most), 1)):
        free = with_free_cameras(s)
        there, power = _often_seen(free), _slow_power(free)
        if not there.any():
            break
        power = np.where(power > _usual_limits(free, power, there), power, 0.0)
        rows = [int(np.argmax(power))]
        if not power[rows[0]] or _size_px(_slow_movement(free, rows[0])) < LEAST_PX:
            rows = _find_masked(s, min(_ON_TRIAL, int(most) - len(found)))
            free = with_free_cameras(without(s, np.array(rows, dtype=int)))
        if not rows:
            break
        found += [_wanderer(s, free, row) for row in rows]
        s = without(s, np.array(rows))
        if len(found) > most:
            return []
    return found


def _find_masked(s: FieldSeries, most: int) -> list[int]:
    """Find up to `most` targets that stand out only if all of them are left out."""
    rows, found = list[int](), list[int]()
    if s.used.any(axis=0).sum() > FEW_TARGETS:
        return found
    free = with_free_cameras(s)
    own = _own_power(free, s.w, included=True)
    for _ in range(most):
        rows.append(int(np.argmax(np.where(_often_seen(free), own, 0.0))))
        free = with_free_cameras(without(s, np.array(rows)))
        there = _often_seen(free)
        if there.sum() < _FEWEST_OTHERS:
            break
        own = _own_power(free, free.w, included=True)
        limits = _usual_limits(free, own, there)[rows]
        stand_out = _own_power(free, s.w, included=False)[rows] > limits
        if stand_out.all() and all(_size_px(_slow_movement(free, r)) >= LEAST_PX for r in rows):
            found = list(rows)
    return found


def _often_seen(s: FieldSeries) -> Mask:
    """Return a mask (T,) of the targets seen in enough epochs to show a wander."""
    return np.asarray(s.used.sum(axis=0) >= max(FEWEST_EPOCHS, _SEEN * len(s.times)))


def _slow_power(s: FieldSeries) -> Array:
    """Return χ² (T,) of each target's slow residuals."""
    v = np.nan_to_num(s.residuals) * np.sqrt(s.w)
    return np.asarray(np.sum(np.tensordot(cosines(s.times), v, 1) ** 2, axis=(0, 2)))


def _own_power(s: FieldSeries, w: Array, included: bool) -> Array:
    """Return χ² (T,) that a slow movement of each single target explains.

    w (E, T, 2): weights; included: whether the target itself took part in the camera's estimate.
    """
    flat = s.A.reshape(-1, s.A.shape[-1])
    N = weighted_products(s.w.mean(axis=0).reshape(1, -1), flat, flat)[0]
    held = 1e-9 * np.trace(N) + 1e-12
    root = np.sqrt(w.mean(axis=0))
    J = s.A * root[..., None]
    of_camera = J @ np.linalg.inv(N + held * np.eye(len(N))) @ J.swapaxes(1, 2)
    values, vectors = np.linalg.eigh(np.eye(2) + (-of_camera if included else of_camera))
    seen = np.isfinite(s.residuals)
    level = np.nan_to_num(s.residuals).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    v = np.where(seen, s.residuals - level, 0.0) * root
    slow = np.einsum("jtk,tkl->jtl", np.tensordot(cosines(s.times), v, 1), vectors)
    return np.asarray(np.sum(slow**2 / np.maximum(values, _LEAST_FREE), axis=(0, 2)))


def _usual_limits(s: FieldSeries, power: Array, there: Mask) -> Array:
    """Return the limits (T,) of χ² beyond which targets wander, from the others on their boards."""
    limits = np.full(len(power), float(np.percentile(power[there], _MOST)))
    for board in np.unique(s.boards[there & (s.boards >= 0)]):
        limits[s.boards == board] = np.percentile(power[there & (s.boards == board)], _MOST)
    return np.where(there | ~s.used.any(axis=0), np.maximum(OTHERS * limits, GAIN), np.inf)


def _slow_movement(s: FieldSeries, row: int) -> Array:
    """Return the slow part (E, 2) px of a target's residuals."""
    slow = cosines(s.times)
    return np.asarray(slow.T @ np.einsum("je,ek->jk", slow, np.nan_to_num(s.residuals[:, row])))


def _size_px(smooth: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(smooth**2, axis=1)) / 2))


def with_free_cameras(s: FieldSeries) -> FieldSeries:
    """Return the series with the residuals of a free camera per epoch."""
    w, P = s.w, s.A.shape[-1]
    flat = s.A.reshape(-1, P)
    scale = np.sqrt(np.maximum((flat**2).mean(axis=0), 1e-300))
    flat = flat / scale
    N = weighted_products(w.reshape(len(w), -1), flat, flat)
    held = 1e-9 * np.einsum("epp->e", N)[:, None, None] + 1e-12
    inverse = np.linalg.inv(N + held * np.eye(P))
    left, total = s.residuals, np.maximum(w.sum(axis=0), 1e-12)
    for _ in range(_PASSES):  # targets that come and go distort cameras by their own errors
        b = (w * np.nan_to_num(left)).reshape(len(w), -1) @ flat
        values = np.einsum("epq,eq->ep", inverse, b)
        left = left - (values @ flat.T).reshape(left.shape)
        left = left - np.sum(w * np.nan_to_num(left), axis=0) / total
    return replace(s, residuals=left, A=flat.reshape(s.A.shape), cameras=inverse)


def weighted_products(w: Array, a: Array, b: Array) -> Array:
    """Return Σ w a bᵀ (E, p, q) for weights (E, n) and partials (n, p), (n, q)."""
    pairs = (a[:, :, None] * b[:, None, :]).reshape(len(a), -1)
    return (w @ pairs).reshape(len(w), a.shape[1], b.shape[1])


def cosines(times: Array) -> Array:
    """Return smooth orthonormal trajectories (n, E) with zero mean."""
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    rows = np.cos(np.pi * np.arange(1, _ORDERS + 1)[:, None] * u[None])
    rows = rows - rows.mean(axis=1, keepdims=True)
    return np.linalg.qr(rows.T)[0].T


def _wanderer(s: FieldSeries, free: FieldSeries, row: int) -> FieldMovement:
    """Describe a wandering target; s: the series with it; free: the series with free cameras."""
    smooth = _slow_movement(free, row)
    inverse = np.linalg.pinv(s.B[row])
    moved = smooth @ inverse.T
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    w = s.w[:, row]
    sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
    sd = sigma * float(np.sqrt(np.mean(np.sum(inverse**2, axis=0)))) / np.sqrt(len(s.times))
    power = _slow_power(replace(free, weights=s.weights))[row]
    return FieldMovement(
        "wander", np.array([row]), (s.names[row],), 0, 0.0, 0.0, np.zeros(len(s.times)),
        np.zeros((1, 2)), size, float(sd), _size_px(smooth), float(power),
    )  # fmt: skip


_SIDE = 4  # least number of epochs before and after a knock
_LARGEST = 0.6  # largest share of the targets on one board; beyond it, the others moved
_FEWEST_OTHERS = 8
_SHARE = 0.6  # of a board's slow movement that the trajectory must explain
_RIGID = 0.5  # of the χ² of its targets' single movements that the board must explain
_MOST_BOARDS = 4
_TRIES = 400  # times of a knock
_SETTLING = (0.08, 0.3)  # time constants over the duration


def board_movements(s: FieldSeries, wandering: Sequence[FieldMovement]) -> list[FieldMovement]:
    """Find boards that were knocked or creep, the largest first, each with the earlier moved back.

    wandering: single targets, left out as they would distort the cameras and thereby the boards.
    """
    if len(s.times) < FEWEST_EPOCHS:
        return []
    for single in wandering:
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


def _usual(s: FieldSeries, boards: list[Index]) -> float:
    """Return the median χ² that a movement of boards which stand still would explain."""
    trajectories, _ = _trajectories(s.times)
    gains = [_gains(*_board_equations(s, r, _rigid(s, r)), trajectories)[0].max() for r in boards]
    return float(np.median(gains)) if gains else 0.0


def refined(s: FieldSeries, movement: FieldMovement) -> FieldMovement:
    """Refine a board's movement by a series from which it was removed.

    In this series gross errors were snooped again with the board moved back.
    """
    free = with_free_cameras(s)
    rigid = _rigid(free, movement.rows)
    M, r = _board_equations(free, movement.rows, rigid)
    step = _gains(M, r, movement.trajectory[None])[1][0]
    image = movement.image + (rigid @ step).reshape(-1, 2)
    size, sd, size_px = _across(s.B[movement.rows], image, rigid, M, movement.trajectory)
    return replace(movement, image=image, size_mm=size, sd_mm=sd, size_px=size_px)


def _board(s: FieldSeries, rows: Index) -> FieldMovement | None:
    """Return one board's movement along the best trajectory; None if it stands still."""
    rigid = _rigid(s, rows)
    M, r = _board_equations(s, rows, rigid)
    trajectories, firsts = _trajectories(s.times)
    gain, steps = _gains(M, r, trajectories)
    best = int(np.argmax(gain))
    if gain[best] < GAIN:
        return None
    epoch = firsts[best]
    if epoch and len(firsts) < len(s.times) - _SIDE:  # in a long series, try the epochs between
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
    size, sd, size_px = _across(s.B[rows], image, rigid, M, trajectory)
    if share < _SHARE or gain[best] < _RIGID * one_by_one or size_px < LEAST_PX:
        return None
    before, after = s.times[max(epoch - 1, 0)], s.times[epoch]
    return FieldMovement(
        "knock" if epoch else "creep", rows, tuple(s.names[r] for r in rows),
        int(s.numbers[epoch]) if epoch else 0, float(0.5 * (before + after)),
        float((after - before) / np.sqrt(12.0)), trajectory, image, size, sd, size_px,
        float(gain[best]),
    )  # fmt: skip


def _rigid(s: FieldSeries, rows: Index) -> Array:
    """Return ∂ image points / ∂ shifts, rotations (2k, 6), px/mm; rotations at the board's size."""
    X = s.points[rows] - s.points[rows].mean(axis=0)
    X /= max(float(np.sqrt((X**2).sum(axis=1).mean())), 1e-9)
    return np.asarray((s.B[rows] @ rigid_motion(X)).reshape(-1, 6))


def _board_equations(s: FieldSeries, rows: Index, rigid: Array) -> tuple[Array, Array]:
    """Return normal equations (E, 6, 6), (E, 6) of a board's movement, the cameras eliminated.

    They are 0 in epochs that show too few targets beside the board: it would move with the camera.
    """
    assert s.cameras is not None
    others = s.used.sum(axis=1) - s.used[:, rows].sum(axis=1)
    w = s.w[:, rows].reshape(len(s.times), -1) * (others >= _FEWEST_OTHERS)[:, None]
    C = weighted_products(w, rigid, s.A[rows].reshape(-1, s.A.shape[-1]))
    M = weighted_products(w, rigid, rigid) - C @ s.cameras @ np.swapaxes(C, 1, 2)
    v = np.nan_to_num(s.residuals[:, rows]).reshape(len(w), -1)
    return M, (w * v) @ rigid


def _trajectories(times: Array) -> tuple[Array, list[int]]:
    """Return trajectories (n, E), 0 to 1, steps and then settling, and each step's epoch, or 0."""
    E = len(times)
    stride = int(np.ceil(E / _TRIES))
    firsts = range(_SIDE, E - _SIDE + 1, stride)
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    slow = [u, *((1 - np.exp(-u / f)) / (1 - np.exp(-1 / f)) for f in _SETTLING)]
    return np.concatenate([_steps(E, firsts), np.stack(slow)]), [*firsts, *(0 for _ in slow)]


def _steps(epochs: int, firsts: range) -> Array:
    """Return steps (n, E) at n epochs."""
    return (np.arange(epochs) >= np.array(firsts)[:, None]).astype(float)


def _gains(M: Array, r: Array, trajectories: Array) -> tuple[Array, Array]:
    """Return χ² (n,) that a board's movement along n trajectories explains, and its size (n, 6)."""
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


def _across(
    B: Array, image: Array, rigid: Array, M: Array, trajectory: Array
) -> tuple[float, float, float]:
    """Return the RMS over targets of a movement across the rays, mm, its sd, and the RMS in px.

    M (E, 6, 6): normal equations of the board, whose level is eliminated here; trajectory (E,).
    """
    flat = M.reshape(len(M), -1)
    N12 = (trajectory @ flat).reshape(6, 6)
    information = (trajectory**2 @ flat).reshape(6, 6) - N12 @ np.linalg.pinv(M.sum(axis=0)) @ N12
    covariance = inverse_of_determined(information)
    inverse = np.linalg.pinv(B)  # (k, 3, 2)
    moved = np.einsum("kij,kj->ki", inverse, image)
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    # of the RMS, to first order
    by_step = np.einsum("kij,kjp->kip", inverse, rigid.reshape(len(B), 2, 6))
    slope = np.einsum("ki,kip->p", moved, by_step) / max(len(B) * size, 1e-12)
    sd = float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))
    return size, sd, float(np.sqrt(np.mean(image**2)))
