"""Movements of the test field: what a series shows of them, and targets that wander.

They are looked for in what a free camera per epoch leaves, so that nothing the camera does can be
mistaken for them. A single target wanders where its slow residuals are far beyond those of the
others, which have a life of their own in every real field; `board_motion` has the boards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Rows = NDArray[np.int64]

__all__ = [
    "FEWEST_EPOCHS", "GAIN", "LEAST_PX", "OTHERS", "FieldMovement", "FieldSeries", "cosines",
    "movement_entry", "wandering_targets", "with_free_cameras",
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
_MOST_TARGETS = 0.2  # of the targets: so many do not wander by themselves


@dataclass(frozen=True, eq=False)
class FieldSeries:
    """What a series shows of its field.

    times (E,) s; residuals (E, T, 2) px, NaN where unseen; weights (E, T, 3) px⁻²; A (T, 2, P), B
    (T, 2, 3): partials by the camera's parameters and by the object points (T, 3) mm; boards (T,):
    labels, -1 on none.
    """

    times: Array
    residuals: Array
    weights: Array
    A: Array
    B: Array
    points: Array
    boards: Rows

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

    kind: `knock`, `creep` or `wander`; rows: of the field; epoch: the first row after a knock, else
    0; time, sd_time s from the start of the series, of a knock; course (E,) 0 to 1; image (k, 2)
    px: where it went in the image; size_mm, sd_mm: RMS over its targets across the rays; size_px.
    """

    kind: str
    rows: Rows
    epoch: int
    time: float
    sd_time: float
    course: Array
    image: Array
    size_mm: float
    sd_mm: float
    size_px: float
    gain: float

    def sentence(self, names: Sequence[str]) -> str:
        """For people; names of the field's targets."""
        who = f"{names[self.rows[0]]} to {names[self.rows[-1]]} ({len(self.rows)} targets)"
        size = f"{self.size_mm:.3f} ± {self.sd_mm:.3f} mm ({self.size_px:.3f} px)"
        if self.kind == "knock":
            return f"the board of {who} was moved by {size} at {self.time:.0f} s"
        if self.kind == "creep":
            return f"the board of {who} creeps, by {size} over the series"
        return f"target {names[self.rows[0]]} wanders by {size} RMS"


def movement_entry(
    m: FieldMovement, names: Sequence[str], numbers: NDArray[np.int64]
) -> dict[str, Any]:
    """A movement for a JSON document; numbers (E,): the epochs' own."""
    knocked = m.kind == "knock"
    return {
        "kind": m.kind,
        "targets": [names[r] for r in m.rows],
        "time_s": m.time if knocked else None,
        "sd_time_s": m.sd_time if knocked else None,
        "epoch": int(numbers[m.epoch]) if knocked else None,
        "size_mm": m.size_mm,
        "sd_size_mm": m.sd_mm,
        "size_px": m.size_px,
    }


def wandering_targets(s: FieldSeries) -> list[FieldMovement]:
    """Single targets whose slow residuals are far beyond the others'."""
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
        there = count > 0.5 * len(free.times)
        if not there.any():
            break
        usual = OTHERS * float(np.percentile(power[there], 85))
        power = np.where(there, power, 0.0)
        row = int(np.argmax(power))
        smooth = slow.T @ np.einsum("je,ek->jk", slow, np.nan_to_num(free.residuals[:, row]))
        size = float(np.sqrt(np.mean(np.sum(smooth**2, axis=1)) / 2))
        if power[row] < max(GAIN, usual) or size < LEAST_PX:
            break
        found.append(_wanderer(free, row, smooth, float(power[row])))
        weights = s.weights.copy()
        weights[:, row] = 0.0
        s = replace(s, weights=weights)
        if len(found) > _MOST_TARGETS * every:
            return []
    return found


def with_free_cameras(s: FieldSeries) -> FieldSeries:
    """The series as a free camera per epoch leaves it."""
    w, P = s.w, s.A.shape[-1]
    flat = s.A.reshape(-1, P)
    scale = np.sqrt(np.maximum((flat**2).mean(axis=0), 1e-300))
    flat = flat / scale
    v = np.nan_to_num(s.residuals)
    N = np.einsum("ej,jp,jq->epq", w.reshape(len(w), -1), flat, flat, optimize=True)
    b = (w * v).reshape(len(w), -1) @ flat
    held = 1e-9 * np.einsum("epp->e", N)[:, None, None] + 1e-12
    values = np.linalg.solve(N + held * np.eye(P), b[..., None])[..., 0]
    left = s.residuals - (values @ flat.T).reshape(s.residuals.shape)
    mean = np.sum(w * np.nan_to_num(left), axis=0) / np.maximum(w.sum(axis=0), 1e-12)
    return replace(s, residuals=left - mean, A=flat.reshape(s.A.shape))


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
        "wander", np.array([row]), 0, 0.0, 0.0, np.zeros(len(s.times)), np.zeros((1, 2)), size,
        float(sd), rms, gain,
    )  # fmt: skip
