"""Operators on a temperature polygon: interpolation, lag, play, running maximum, rate.

Every operator is exact for a polygon, works on whole vectors, and comes with the matrix of its
derivatives by the values at the knots, so that a thermometer's error can be carried through it.
Knots are (K,) s ascending, values (K,) °C, `at` (E,) s; beyond the ends the values are held.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array

__all__ = [
    "interpolation_matrix",
    "lag",
    "lag_matrix",
    "play",
    "play_matrix",
    "play_turns",
    "running_maximum",
    "running_maximum_matrix",
    "slope_matrix",
]

# Weights of a lag below this share of the reading's own are left out of its matrix.
_LAG_CUT = 14.0


def _edges(knots: Array, at: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Left knot, right knot, and share of the right one, at times (E,); held beyond the ends."""
    last = len(knots) - 1
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, max(last - 1, 0))
    right = np.minimum(left + 1, last)
    step = knots[right] - knots[left]
    share = np.clip((at - knots[left]) / np.where(step > 0, step, 1.0), 0.0, 1.0)
    return left, right, share


def interpolation_matrix(knots: Array, at: Array) -> csr_array:
    """The matrix (E, K) that interpolates values at knots (K,) linearly at times (E,)."""
    from scipy.sparse import csr_array

    left, right, share = _edges(knots, at)
    rows = np.arange(len(at))
    return csr_array(
        (
            np.concatenate([1.0 - share, share]),
            (np.concatenate([rows, rows]), np.concatenate([left, right])),
        ),
        shape=(len(at), len(knots)),
    )


def _lag_weights(knots: Array, tau: float) -> tuple[Array, Array, Array]:
    """Decay a, weight of the old and of the new value over each edge, (K-1,) each.

    L₊ = a L + (g - a) T + (1 - g) T₊ with a = exp(-h/τ), g = (1 - a) τ/h: the exact response of
    τ L' = T - L to a straight line.
    """
    x = np.diff(knots) / tau
    a = np.exp(-x)
    g = -np.expm1(-x) / x
    return a, g - a, 1.0 - g


def lag(knots: Array, values: Array, tau: float, at: Array) -> Array:
    """The polygon through a first-order lag `tau` L' = T - L, L = T at the first knot.

    knots (K,) s, values (K,) or (K, m), at (E,) s; returns (E,) or (E, m).
    """
    from scipy.linalg.lapack import dtbtrs

    v = np.asarray(values, dtype=float)
    columns = v.reshape(len(v), -1)
    state = columns
    if len(knots) > 1:
        a, old, new = _lag_weights(knots, tau)
        driven = np.empty_like(columns)
        driven[0] = columns[0]
        driven[1:] = old[:, None] * columns[:-1] + new[:, None] * columns[1:]
        band = np.ones((2, len(knots)), order="F")
        band[1, :-1] = -a
        state, _ = dtbtrs(band, driven, uplo="L", diag="U")
    left, right, share = _edges(knots, at)
    elapsed = share * (knots[right] - knots[left]) / tau
    edge = (knots[right] - knots[left]) / tau
    slope = (columns[right] - columns[left]) / np.where(edge > 0, edge, 1.0)[:, None]
    decayed = np.exp(-elapsed)[:, None]
    result = (
        columns[left] * (1.0 - decayed)
        + state[left] * decayed
        + slope * (elapsed[:, None] - 1.0 + decayed)
    )
    shaped: Array = result.reshape(len(at), *v.shape[1:])
    return shaped


def lag_matrix(knots: Array, tau: float, at: Array) -> csr_array:
    """The matrix (E, K) of `lag`; weights older than 14 tau are left out (below 1e-6)."""
    from scipy.sparse import csr_array

    n = len(knots)
    if n == 1:
        return interpolation_matrix(knots, at)
    _, old, new = _lag_weights(knots, tau)
    left, right, share = _edges(knots, at)
    # state k = Σ_j<k D_kj+1 (old_j T_j + new_j T_j+1) + D_k0 T_0, with D_kj = exp(-(t_k - t_j)/τ)
    first = np.maximum(np.searchsorted(knots, knots[left] - _LAG_CUT * tau) - 1, 0)
    counts = left - first + 1
    rows = np.repeat(np.arange(len(at)), counts)
    offset = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    columns = np.repeat(first, counts) + offset
    gone = np.exp(-(knots[left][rows] - knots[columns]) / tau)
    weight = np.where(columns == 0, 1.0, np.append(0.0, new)[columns]) * gone
    inner = columns < left[rows]
    following = np.minimum(columns + 1, n - 1)
    weight[inner] += old[columns[inner]] * np.exp(
        -(knots[left][rows] - knots[following])[inner] / tau
    )
    elapsed = share * (knots[right] - knots[left]) / tau
    edge = (knots[right] - knots[left]) / tau
    decayed = np.exp(-elapsed)
    rise = (elapsed - 1.0 + decayed) / np.where(edge > 0, edge, 1.0)
    frames = np.arange(len(at))
    return csr_array(
        (
            np.concatenate([weight * decayed[rows], 1.0 - decayed - rise, rise]),
            (
                np.concatenate([rows, frames, frames]),
                np.concatenate([columns, left, right]),
            ),
        ),
        shape=(len(at), n),
    )


def play(knots: Array, values: Array, half_width: float, at: Array) -> Array:
    """The play (backlash) operator: the output rests until the input is `half_width` away.

    P = min(max(P, T - r), T + r), P = T at the first knot. knots, values (K,), at (E,); (E,).
    Source: Krasnosel'skii, Pokrovskii (1989): Systems with Hysteresis.
    """
    states = _play_states(values, half_width)
    left, right, share = _edges(knots, at)
    now = values[left] * (1.0 - share) + values[right] * share
    result: Array = np.minimum(np.maximum(states[left], now - half_width), now + half_width)
    return result


def _play_states(values: Array, half_width: float) -> Array:
    """States at the knots. Clipping after clipping is clipping: a prefix scan, no time loop."""
    low, high = values - half_width, values + half_width
    low[0] = high[0] = values[0]
    step = 1
    while step < len(values):
        lo, hi = low[step:].copy(), high[step:].copy()
        low[step:] = np.minimum(np.maximum(low[:-step], lo), hi)
        high[step:] = np.minimum(np.maximum(high[:-step], lo), hi)
        step *= 2
    return low


def play_matrix(knots: Array, values: Array, half_width: float, at: Array) -> csr_array:
    """∂ play / ∂ values (E, K): each output depends on the reading that moved it last."""
    moving, source, _ = _play_moves(knots, values, half_width, at)
    return _switched(knots, at, moving, source)


def _play_moves(
    knots: Array, values: Array, half_width: float, at: Array
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    """Whether the play moves since the knot before each time (E,), the knot that moved it last
    until then (E,), and whether the time is that very knot (E,).
    """
    states = _play_states(values, half_width)
    moved = np.append(True, states[1:] != states[:-1])
    source = np.maximum.accumulate(np.where(moved, np.arange(len(values)), 0))
    left, right, share = _edges(knots, at)
    now = values[left] * (1.0 - share) + values[right] * share
    moving = (states[left] < now - half_width) | (states[left] > now + half_width)
    return moving, source[left], (share == 0) & moved[left]


def play_turns(knots: Array, values: Array, half_width: float, at: Array) -> NDArray[np.bool_]:
    """Where the play rests after a turn and is near either end of that rest, (E,).

    Which reading was the highest, and when the play is used up, is not sure there.
    """
    moving, source, just_moved = _play_moves(knots, values, half_width, at)
    resting = ~moving & ~just_moved & (source > 0)  # at the start it has not turned
    near = np.zeros(len(at), dtype=bool)
    begins = np.flatnonzero(np.diff(resting.astype(int), prepend=0) > 0)
    ends = np.flatnonzero(np.diff(resting.astype(int), append=0) < 0)
    for begin, end in zip(begins, ends, strict=True):
        near[begin : begin + 2] = True
        near[max(end - 1, begin) : end + 2] = True
    return near


def running_maximum(knots: Array, values: Array, at: Array) -> Array:
    """The highest value from the first knot to each time. knots, values (K,), at (E,); (E,)."""
    left, right, share = _edges(knots, at)
    now = values[left] * (1.0 - share) + values[right] * share
    result: Array = np.maximum(np.maximum.accumulate(values)[left], now)
    return result


def running_maximum_matrix(knots: Array, values: Array, at: Array) -> csr_array:
    """∂ running_maximum / ∂ values (E, K): each output depends on the highest reading so far."""
    highest = np.maximum.accumulate(values)
    risen = np.append(True, values[1:] > highest[:-1])
    source = np.maximum.accumulate(np.where(risen, np.arange(len(values)), 0))
    left, right, share = _edges(knots, at)
    now = values[left] * (1.0 - share) + values[right] * share
    return _switched(knots, at, now > highest[left], source[left])


def _switched(
    knots: Array, at: Array, current: NDArray[np.bool_], source: NDArray[np.int64]
) -> csr_array:
    """Rows that follow the input now where `current`, and a former knot elsewhere."""
    from scipy.sparse import csr_array

    left, right, share = _edges(knots, at)
    rows = np.arange(len(at))
    return csr_array(
        (
            np.concatenate([np.where(current, 1.0 - share, 1.0), np.where(current, share, 0.0)]),
            (
                np.concatenate([rows, rows]),
                np.concatenate([np.where(current, left, source), right]),
            ),
        ),
        shape=(len(at), len(knots)),
    )


def slope_matrix(knots: Array, at: Array) -> csr_array:
    """The matrix (E, K) of the rate dT/dt at times (E,).

    At the knots the slope of the parabola through three neighbours (second order, also for uneven
    steps; one-sided at the ends), linear in between.
    """
    from scipy.sparse import csr_array

    n = len(knots)
    if n == 1:
        return csr_array((len(at), 1))
    if n == 2:
        h = knots[1] - knots[0]
        return csr_array(np.tile([-1.0 / h, 1.0 / h], (len(at), 1)))
    h = np.diff(knots)
    h0, h1 = h[:-1], h[1:]
    inner = np.arange(1, n - 1)
    a, b = h[0], h[1]
    y, z = h[-1], h[-2]
    weights = [
        -h1 / (h0 * (h0 + h1)),
        (h1 - h0) / (h0 * h1),
        h0 / (h1 * (h0 + h1)),
        np.array([-(2 * a + b) / (a * (a + b)), (a + b) / (a * b), -a / (b * (a + b))]),
        np.array([y / (z * (y + z)), -(y + z) / (y * z), (2 * y + z) / (y * (y + z))]),
    ]
    rows = [inner, inner, inner, np.zeros(3, dtype=int), np.full(3, n - 1)]
    columns = [inner - 1, inner, inner + 1, np.arange(3), np.arange(n - 3, n)]
    slopes = csr_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)
    )
    return interpolation_matrix(knots, at) @ slopes
