"""Movements of the test field: what a series shows of them, and targets that wander.

They are looked for in what a free camera per epoch leaves, so that nothing the camera does can be
mistaken for them. A single target wanders where its slow residuals are far beyond those of the
others on its board, which have a life of their own in every real field; `board_motion` has the
boards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

    Rows = NDArray[np.int64]

__all__ = [
    "FEWEST_EPOCHS", "GAIN", "LEAST_PX", "OTHERS", "FieldMovement", "FieldSeries", "cosines",
    "put_back", "wandering_targets", "weighted_products", "with_free_cameras", "without",
]  # fmt: skip

FEWEST_EPOCHS = 20
"""Below, a series shows no movement of its field."""
GAIN = 100.0
"""χ² from which on something moved: of six degrees of freedom and a thousand times, 1e-15."""
LEAST_PX = 0.02
"""Movements below are not worth a word."""
OTHERS = 8.0
"""Times what most of the others do."""

_ORDERS = 14
_PASSES = 3
_MOST = 80.0  # per cent of the targets, which stay below what a single one does
_SEEN = 0.3  # of the epochs: of what wanders fast, many are taken for gross errors
_MOST_TARGETS = 0.2  # of the targets: so many do not wander by themselves


@dataclass(frozen=True, eq=False)
class FieldSeries:
    """What a series shows of its field.

    times (E,) s; residuals (E, T, 2) px, NaN where unseen; weights (E, T, 3) px⁻²; A (T, 2, P), B
    (T, 2, 3): partials by the camera's parameters and by the object points (T, 3) mm; boards (T,):
    labels, -1 on none; names: of the targets; numbers (E,): the epochs' own; cameras (E, P, P):
    inverse normal matrices, where free cameras have been taken out.
    """

    times: Array
    residuals: Array
    weights: Array
    A: Array
    B: Array
    points: Array
    boards: Rows
    names: tuple[str, ...]
    numbers: Rows
    cameras: Array | None = None

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which image points (E, T) there are."""
        out: NDArray[np.bool_] = np.isfinite(self.residuals[..., 0]) & (self.weights[..., 0] > 0)
        return out

    @property
    def w(self) -> Array:
        """Weights (E, T, 2) of the coordinates that there are."""
        return np.where(self.used[..., None], self.weights[..., :2], 0.0)


@dataclass(frozen=True, eq=False)
class FieldMovement:
    """One board or target that moved.

    kind: `knock`, `creep` or `wander`; rows: of the field, targets: their names; epoch: number of
    the first after a knock, else 0; time, sd_time s from the start of the series, of a knock;
    trajectory (E,) 0 to 1; image (k, 2) px: where it went in the image; size_mm, sd_mm: RMS over
    its targets across the rays; size_px; gain: χ² that it explains.
    """

    kind: str
    rows: Rows
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
        """For people."""
        who = f"{self.targets[0]} to {self.targets[-1]} ({len(self.targets)} targets)"
        size = f"{self.size_mm:.3f} ± {self.sd_mm:.3f} mm ({self.size_px:.3f} px)"
        if self.kind == "knock":
            return f"the board of {who} was moved by {size} at {self.time:.0f} s"
        if self.kind == "creep":
            return f"the board of {who} creeps, by {size} over the series"
        return f"target {self.targets[0]} wanders by {size} RMS"

    def as_dict(self) -> dict[str, Any]:
        """For a document."""
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


def without(s: FieldSeries, rows: Rows) -> FieldSeries:
    """The series as if some targets had not been observed."""
    weights = s.weights.copy()
    weights[:, rows] = 0.0
    return replace(s, weights=weights)


def put_back(s: FieldSeries, movement: FieldMovement) -> FieldSeries:
    """The series as if something had not moved."""
    residuals = s.residuals.copy()
    residuals[:, movement.rows] -= movement.trajectory[:, None, None] * movement.image
    return replace(s, residuals=residuals)


def wandering_targets(s: FieldSeries) -> list[FieldMovement]:
    """Single targets whose slow residuals are far beyond those of the others on their board."""
    if len(s.times) < FEWEST_EPOCHS:
        return []
    found: list[FieldMovement] = []
    every = int(s.used.any(axis=0).sum())
    for _ in range(max(int(_MOST_TARGETS * every), 1)):
        free = with_free_cameras(s)
        w = free.w
        slow = cosines(free.times)
        v = np.nan_to_num(free.residuals) * np.sqrt(w)
        power = np.sum(np.einsum("je,etk->jtk", slow, v) ** 2, axis=(0, 2))
        count = np.sum(w[..., 0] > 0, axis=0)
        there = count >= max(FEWEST_EPOCHS, _SEEN * len(free.times))
        if not there.any():
            break
        power = np.where(there, power, 0.0)
        usual = np.full(len(power), float(np.percentile(power[there], _MOST)))
        for board in np.unique(s.boards[there & (s.boards >= 0)]):
            usual[s.boards == board] = np.percentile(power[there & (s.boards == board)], _MOST)
        power = np.where(power > np.maximum(OTHERS * usual, GAIN), power, 0.0)
        row = int(np.argmax(power))
        smooth = slow.T @ np.einsum("je,ek->jk", slow, np.nan_to_num(free.residuals[:, row]))
        size = float(np.sqrt(np.mean(np.sum(smooth**2, axis=1)) / 2))
        if not power[row] or size < LEAST_PX:
            break
        found.append(_wanderer(free, row, smooth, float(power[row])))
        s = without(s, found[-1].rows)
        if len(found) > _MOST_TARGETS * every:
            return []
    return found


def with_free_cameras(s: FieldSeries) -> FieldSeries:
    """The series as a free camera per epoch leaves it."""
    w, P = s.w, s.A.shape[-1]
    flat = s.A.reshape(-1, P)
    scale = np.sqrt(np.maximum((flat**2).mean(axis=0), 1e-300))
    flat = flat / scale
    N = weighted_products(w.reshape(len(w), -1), flat, flat)
    held = 1e-9 * np.einsum("epp->e", N)[:, None, None] + 1e-12
    inverse = np.linalg.inv(N + held * np.eye(P))
    left, total = s.residuals, np.maximum(w.sum(axis=0), 1e-12)
    for _ in range(_PASSES):  # targets that come and go pull at the cameras by their own error
        b = (w * np.nan_to_num(left)).reshape(len(w), -1) @ flat
        values = np.einsum("epq,eq->ep", inverse, b)
        left = left - (values @ flat.T).reshape(left.shape)
        left = left - np.sum(w * np.nan_to_num(left), axis=0) / total
    return replace(s, residuals=left, A=flat.reshape(s.A.shape), cameras=inverse)


def weighted_products(w: Array, a: Array, b: Array) -> Array:
    """Σ w a bᵀ (E, p, q) of weights (E, n) and partials (n, p), (n, q)."""
    pairs = (a[:, :, None] * b[:, None, :]).reshape(len(a), -1)
    out: Array = (w @ pairs).reshape(len(w), a.shape[1], b.shape[1])
    return out


def cosines(times: Array) -> Array:
    """Smooth trajectories (n, E) of unit length and zero mean."""
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    rows = np.cos(np.pi * np.arange(1, _ORDERS + 1)[:, None] * u[None])
    rows = rows - rows.mean(axis=1, keepdims=True)
    out: Array = np.linalg.qr(rows.T)[0].T
    return out


def _wanderer(s: FieldSeries, row: int, smooth: Array, gain: float) -> FieldMovement:
    inverse = np.linalg.pinv(s.B[row])
    moved = smooth @ inverse.T
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    w = s.w[:, row]
    sigma = float(1.0 / np.sqrt(np.mean(w[w > 0])))
    sd = sigma * float(np.sqrt(np.mean(np.sum(inverse**2, axis=0)))) / np.sqrt(len(s.times))
    rms = float(np.sqrt(np.mean(np.sum(smooth**2, axis=1)) / 2))
    return FieldMovement(
        "wander", np.array([row]), (s.names[row],), 0, 0.0, 0.0, np.zeros(len(s.times)),
        np.zeros((1, 2)), size, float(sd), rms, gain,
    )  # fmt: skip
