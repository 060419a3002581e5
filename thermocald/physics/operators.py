"""Operators on a temperature polygon, and the table of the operators in formulas.

Every operator is exact for a polygon, works on whole vectors, and has the matrix of its derivatives
with respect to the values at the knots, to propagate a thermometer's error. Knots are (K,) s
ascending, values (K,) °C, `at` (E,) s; beyond the ends, values are constant.

The operators in formulas are of two kinds. Pointwise operators take values at one time; operators
with memory take a polygon of values and return values at any times:

    offset(x, a)          x - a
    above(x, k)           max(x - k, 0)
    power(x, p)           max(x, 0)^p, x in its own unit
    square(x), cube(x)    x², x³
    signed_square(x)      x |x|
    magnitude(x)          |x|
    saturation(x, k, w)   tanh((x - k) / w); a switch where w is small
    exponential(x, w)     exp(x / w)
    wave(x, P, phase)     sin(2π x / P + phase)
    product(x, y)         x y
    rate(x)               dx/dt, per s
    integral(x)           ∫ x dt from the first frame, s
    lag(x, tau)           first-order lag
    play(x, r)            backlash of half-width r
    change(x)             x minus its value at the first frame
    maximum(x), minimum(x)   the highest, the lowest value so far
    peak(x, tau)          the highest value so far, which decays towards x with a time constant
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array

_DECAYED = 1e-7
_LAG_CUT = 14.0  # time constants after which a reading's weight in a lag is left out
_LONG = 1500  # times or knots, above which the matrices of memories are not whole
_LAG_STEP = 0.2  # time constants within which a lag is straight: its curvature leaves 1 / 200


def _edges(knots: Array, at: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return the left knot, the right knot and the right one's share at times (E,)."""
    last = len(knots) - 1
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, max(last - 1, 0))
    right = np.minimum(left + 1, last)
    step = knots[right] - knots[left]
    share = np.clip((at - knots[left]) / np.where(step > 0, step, 1.0), 0.0, 1.0)
    return left, right, share


def _interpolate(knots: Array, values: Array, at: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the left knot (E,) and the value (…, E) of polygons (…, K) at times (E,)."""
    left, right, share = _edges(knots, at)
    return left, values[..., left] * (1.0 - share) + values[..., right] * share


def interpolation_matrix(
    knots: Array,
    at: Array,
    held: tuple[NDArray[np.bool_], NDArray[np.int64]] | None = None,
) -> csr_array:
    """Return the matrix (E, K) that interpolates knots (K,) linearly at times (E,).

    held: the times (E,) that have an earlier knot's value instead, and that knot (E,).
    """
    from scipy.sparse import csr_array

    left, right, share = _edges(knots, at)
    if held is not None:
        left, share = np.where(held[0], held[1], left), np.where(held[0], 0.0, share)
    rows = np.arange(len(at))
    return csr_array(
        (
            np.concatenate([1.0 - share, share]),
            (np.concatenate([rows, rows]), np.concatenate([left, right])),
        ),
        shape=(len(at), len(knots)),
    )


def _lag_weights(knots: Array, tau: float) -> tuple[Array, Array, Array]:
    """Return each edge's decay a and the weights of its old and new value, (K-1,) each.

    L₊ = a L + (g - a) T + (1 - g) T₊ with a = exp(-h/τ), g = (1 - a) τ/h: the exact response of
    τ L' = T - L to a straight line.
    """
    x = np.diff(knots) / tau
    a = np.exp(-x)
    g = -np.expm1(-x) / x
    return a, g - a, 1.0 - g


def decayed_sums(kept: Array, driven: Array) -> Array:
    """Return s (K,) with s₀ = driven₀, s₊ = kept s + driven₊; kept (K-1,), driven (K,)."""
    from scipy.linalg.lapack import dtbtrs

    band = np.ones((2, len(driven)), order="F")
    band[1, :-1] = -kept
    return np.asarray(dtbtrs(band, driven[:, None], uplo="L", diag="U")[0])[:, 0]


def _decay_matrix(kept: Array) -> csr_array:
    """Return the matrix (K, K) of `decayed_sums`, without weights below 1e-7."""
    from scipy.sparse import diags_array, eye_array

    n = len(kept) + 1
    total, step = eye_array(n).tocsr(), diags_array([kept], offsets=[-1], shape=(n, n)).tocsr()
    while step.nnz:  # Σ stepⁱ, with twice as many powers in every turn
        total = total + step @ total
        step = step @ step
        step.data[step.data < _DECAYED] = 0.0
        step.eliminate_zeros()
    return total


def _lag_within(
    knots: Array, tau: float, at: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Return the left and right knots of times (E,), and the weights of the response there.

    These are the decay of the state at the left knot, and the response to a rise by 1 on the way.
    """
    left, right, share = _edges(knots, at)
    edge = (knots[right] - knots[left]) / tau
    decayed = np.exp(-share * edge)
    return left, right, decayed, (share * edge - 1.0 + decayed) / np.where(edge > 0, edge, 1.0)


def lag(knots: Array, values: Array, tau: float, at: Array) -> Array:
    """Pass a polygon through a first-order lag: `tau` L' = T - L, L = T at the first knot.

    knots (K,) s, values (K,), at (E,) s; returns (E,).
    """
    a, old, new = _lag_weights(knots, tau)
    driven = np.append(values[:1], old * values[:-1] + new * values[1:])
    state = decayed_sums(a, driven)
    left, right, decayed, rise = _lag_within(knots, tau, at)
    start = values[left]
    return np.asarray(start + (state[left] - start) * decayed + (values[right] - start) * rise)


def lag_matrix(knots: Array, values: Array, tau: float, at: Array) -> csr_array:  # noqa: ARG001
    """Return the matrix (E, K) of `lag`, without weights older than 14 tau (below 1e-6)."""
    from scipy.sparse import csr_array

    _, old, new = _lag_weights(knots, tau)
    left, right, decayed, rise = _lag_within(knots, tau, at)
    first = np.maximum(np.searchsorted(knots, knots[left] - _LAG_CUT * tau) - 1, 0)
    size, shape = left - first + 1, (len(at), len(knots))
    ends = np.cumsum(size)
    knot = np.arange(ends[-1]) - np.repeat(ends - size - first, size)
    kept = np.exp((knots[knot] - np.repeat(knots[left], size)) / tau)
    kept *= np.repeat(decayed, size)
    weights = np.append(1.0, new)[knot] * kept
    kept *= np.append(0.0, old)[knot]  # the share of the knot before
    kept[ends - size] = 0.0
    weights[:-1] += kept[1:]
    states = csr_array((weights, knot, np.append(0, ends)), shape=shape)
    own = np.concatenate([1.0 - decayed - rise, rise])
    rows = np.tile(np.arange(len(at)), 2)
    return states + csr_array((own, (rows, np.concatenate([left, right]))), shape=shape)


def averaged_lag_matrix(
    averages: csr_array, knots: Array, values: Array, tau: float, at: Array
) -> csr_array:
    """Return averages @ lag_matrix (B, K), for averages (B, E) from fewer of many times.

    Between these, 0.2 tau apart, the lag is taken as straight: the whole matrix of a week in 10 s
    needs gigabytes.
    """
    begins = np.append(True, np.diff(np.floor(at / (_LAG_STEP * tau))) > 0)
    begins[-1] = True
    few = at[begins]
    if len(at) <= _LONG or 2 * len(few) > len(at):
        return averages @ lag_matrix(knots, values, tau, at)
    return averages @ interpolation_matrix(few, at) @ lag_matrix(knots, values, tau, few)


def play(knots: Array, values: Array, half_width: float, at: Array) -> Array:
    """Pass a polygon through a play: the output rests until the input is `half_width` away.

    P = min(max(P, T - r), T + r), P = T at the first knot. knots, values (K,), at (E,); (E,).
    Source: Krasnosel'skii, Pokrovskii (1989): Systems with Hysteresis.
    """
    left, now = _interpolate(knots, values, at)
    return np.clip(_play_states(values, half_width)[left], now - half_width, now + half_width)


def _play_states(values: Array, half_width: float) -> Array:
    """Compute the states at the knots by a prefix scan, as two clippings in turn are one."""
    low, high = values - half_width, values + half_width
    low[0] = high[0] = values[0]
    step = 1
    while step < len(values):
        lo, hi = low[step:].copy(), high[step:].copy()
        low[step:], high[step:] = np.clip(low[:-step], lo, hi), np.clip(high[:-step], lo, hi)
        step *= 2
    return low


def play_matrix(knots: Array, values: Array, half_width: float, at: Array) -> csr_array:
    """Return ∂ play / ∂ values (E, K): an output depends on the reading that last moved it."""
    moving, source, _ = _play_moves(knots, values, half_width, at)
    return interpolation_matrix(knots, at, (~moving, source))


def _play_moves(
    knots: Array, values: Array, half_width: float, at: Array
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    """Find how the play moves at times (E,).

    Returns whether it moves between the previous knot and the time, the knot that last moved it
    before, and whether the time is this very knot, (E,) each.
    """
    states = _play_states(values, half_width)
    moved = np.append(True, states[1:] != states[:-1])
    source = np.maximum.accumulate(np.where(moved, np.arange(len(values)), 0))
    left, now = _interpolate(knots, values, at)
    moving = (states[left] < now - half_width) | (states[left] > now + half_width)
    return moving, source[left], (at == knots[left]) & moved[left]


def play_turns(knots: Array, values: Array, half_width: float, at: Array) -> NDArray[np.bool_]:
    """Find the times (E,) near either end of a rest of the play after a turn.

    There it is uncertain which reading was the extreme, and when the play is used up.
    """
    moving, source, just_moved = _play_moves(knots, values, half_width, at)
    resting = ~moving & ~just_moved & (source > 0)  # a rest at the start follows no turn
    near = np.zeros(len(at), dtype=bool)
    begins = np.flatnonzero(np.diff(resting.astype(int), prepend=0) > 0)
    ends = np.flatnonzero(np.diff(resting.astype(int), append=0) < 0)
    for begin, end in zip(begins, ends, strict=True):
        near[begin : begin + 2] = True
        near[max(end - 1, begin) : end + 2] = True
    return near


def running_maximum(knots: Array, values: Array, at: Array) -> Array:
    """Return the highest value from the first knot to each time, (E,)."""
    left, now = _interpolate(knots, values, at)
    return np.asarray(np.maximum(np.maximum.accumulate(values)[left], now))


def running_maximum_matrix(knots: Array, values: Array, at: Array) -> csr_array:
    """Return ∂ running_maximum / ∂ values (E, K): it depends on the highest reading so far."""
    highest = np.maximum.accumulate(values)
    risen = np.append(True, values[1:] > highest[:-1])
    source = np.maximum.accumulate(np.where(risen, np.arange(len(values)), 0))
    left, now = _interpolate(knots, values, at)
    return interpolation_matrix(knots, at, (now <= highest[left], source[left]))


def slope_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    """Return the matrix (E, K) of the rate dT/dt at times (E,).

    At a knot, it is the slope of the parabola through three neighbours (second order, for uneven
    steps too; one-sided at the ends); between knots it is linear.
    """
    from scipy.sparse import csr_array

    n = len(knots)
    if n == 1:
        return csr_array((len(at), 1))
    if n == 2:
        h = knots[1] - knots[0]
        return csr_array(np.tile([-1.0 / h, 1.0 / h], (len(at), 1)))
    # a row has weights on three neighbours: NumPy's derivatives of combs, 1 at every third knot
    combs = (np.arange(n)[:, None] % 3 == np.arange(3)).astype(float)
    columns = np.clip(np.arange(n) - 1, 0, n - 3)[:, None] + np.arange(3)
    weights = np.take_along_axis(np.gradient(combs, knots, axis=0, edge_order=2), columns % 3, 1)
    slopes = csr_array((weights.ravel(), columns.ravel(), 3 * np.arange(n + 1)), shape=(n, n))
    return interpolation_matrix(knots, at) @ slopes


Role = Literal["threshold", "width", "time_constant", "exponent", "phase", "scale"]


@dataclass(frozen=True, slots=True)
class Constant:
    """A constant of an operator.

    name: the usual one; role: its meaning; positive: whether it is above 0.
    """

    name: str
    role: Role
    positive: bool


@dataclass(frozen=True, slots=True)
class Operator:
    """An operator of formulas.

    inputs: their number; constants: in order; words: its text, with inputs and constants as fields;
    value, derivatives: of a pointwise operator (inputs…, constants…) → values, partial derivatives
    with respect to each input; of one with memory (knots, values, constants…, times) → values at
    the times, derivatives with respect to the values at the knots; remembers: whether it has a
    memory; powers: exponent of the input's unit in the result's (0: a pure number); seconds:
    exponent of s as a further factor; keeps: whether the result is of the input's kind (°C remains
    °C).
    """

    inputs: int
    constants: tuple[Constant, ...]
    words: str
    value: Callable[..., Array]
    derivatives: Callable[..., Any]
    remembers: bool = False
    powers: int = 1
    seconds: int = 0
    keeps: bool = False


def _integral(knots: Array, values: Array, at: Array) -> Array:
    v = values.T  # (K,), or (m, K) of several polygons
    steps = 0.5 * np.diff(knots) * (v[..., 1:] + v[..., :-1])
    total = np.concatenate([0.0 * v[..., :1], np.cumsum(steps, axis=-1)], axis=-1)
    left, now = _interpolate(knots, v, at)
    whole = total[..., left] + 0.5 * np.maximum(at - knots[left], 0.0) * (v[..., left] + now)
    return np.asarray(whole - _interpolate(knots, total, np.zeros(1))[1]).T


def _integral_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    from scipy.sparse import csr_array

    n = len(knots)
    if n > _LONG or n < 2:  # the readings' errors average out to below 1/√1500
        return csr_array((len(at), n))
    return csr_array(_integral(knots, np.eye(n), at))


def _change_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    from scipy.sparse import csr_array

    start = interpolation_matrix(knots, np.zeros(1))
    return csr_array(interpolation_matrix(knots, at) - start[np.zeros(len(at), dtype=int)])


def _peak(knots: Array, values: Array, tau: float, at: Array) -> Array:
    """Return the highest value so far, which decays towards the input with a time constant.

    Source: the diode and leaky capacitor of a peak detector (Horowitz, Hill (2015): The Art of
    Electronics, 3rd ed., section 4.5.1).
    """
    decay = np.exp(-np.diff(knots) / tau)
    states = [float(values[0])]
    for v, d in zip(values[1:].tolist(), decay.tolist(), strict=True):
        states.append(max(v, v + (states[-1] - v) * d))
    left, now = _interpolate(knots, values, at)
    gone = np.exp(-np.clip(at - knots[left], 0.0, None) / tau)
    return np.asarray(np.maximum(now, now + (np.array(states)[left] - now) * gone))


def _peak_matrix(knots: Array, values: Array, tau: float, at: Array) -> csr_array:
    """Return ∂ peak / ∂ values: 1 where the input is the peak, else a lag's since the peak."""
    from scipy.sparse import diags_array

    held = _peak(knots, values, tau, knots) > values
    kept = np.where(held[1:], np.exp(-np.diff(knots) / tau), 0.0)
    own = diags_array(np.append(1.0, 1.0 - kept))
    matrix: csr_array = interpolation_matrix(knots, at) @ _decay_matrix(kept) @ own
    return matrix


_A = Constant("a", "threshold", False)
_K = Constant("k", "threshold", False)
_W = Constant("w", "scale", True)
_TAU = Constant("tau", "time_constant", True)


OPERATORS: dict[str, Operator] = {
    "offset": Operator(1, (_A,), "({0} − {1})", lambda x, a: np.asarray(x - a),
                       lambda x, a: (np.ones_like(x),)),  # noqa: ARG005
    "above": Operator(1, (_K,), "({0} − {1})₊", lambda x, k: np.maximum(x - k, 0.0),
                      lambda x, k: ((x > k).astype(float),)),
    "power": Operator(
        1, (Constant("p", "exponent", True),), "[{0}]^({1})",
        lambda x, p: np.asarray(np.maximum(x, 0.0) ** p),
        # a root is vertical at 0: its slope is limited to that at a reading's error
        lambda x, p: (p * np.maximum(x, 1e-2) ** (p - 1.0) * (x > 0),), powers=0,
    ),
    "square": Operator(1, (), "[{0}]²", lambda x: np.asarray(x**2), lambda x: (2.0 * x,),
                       powers=2),
    "cube": Operator(1, (), "[{0}]³", lambda x: np.asarray(x**3), lambda x: (3.0 * x**2,),
                     powers=3),
    "signed_square": Operator(1, (), "sign({0}) · ({0})²", lambda x: x * np.abs(x),
                              lambda x: (2.0 * np.abs(x),), powers=2),
    "magnitude": Operator(1, (), "|{0}|", np.abs, lambda x: (np.sign(x),)),
    "saturation": Operator(
        1, (_K, _W), "tanh(({0} − {1}) / {2})", lambda x, k, w: np.tanh((x - k) / w),
        lambda x, k, w: (1.0 / (w * np.cosh(np.clip((x - k) / w, -300.0, 300.0)) ** 2),),
        powers=0,
    ),
    "exponential": Operator(
        1, (_W,), "exp({0} / {1})", lambda x, w: np.exp(np.clip(x / w, -300.0, 300.0)),
        lambda x, w: (np.exp(np.clip(x / w, -300.0, 300.0)) / w,), powers=0,
    ),
    "wave": Operator(
        1, (Constant("P", "scale", True), Constant("phase", "phase", False)),
        "sin(2π · {0} / {1} + {2})", lambda x, P, phase: np.sin(2 * np.pi * x / P + phase),
        lambda x, P, phase: (2 * np.pi / P * np.cos(2 * np.pi * x / P + phase),), powers=0,
    ),
    "product": Operator(2, (), "{0} · {1}", lambda x, y: np.asarray(x * y),
                        lambda x, y: (y, x)),
    "rate": Operator(
        1, (), "d{0}/dt", lambda knots, x, at: np.asarray(slope_matrix(knots, x, at) @ x),
        slope_matrix, remembers=True, seconds=-1,
    ),
    "integral": Operator(1, (), "∫ {0} dt", _integral, _integral_matrix, remembers=True,
                         seconds=1),
    "change": Operator(
        1, (), "({0} − {0} at the start)",
        lambda knots, x, at: np.asarray(np.interp(at, knots, x) - np.interp(0.0, knots, x)),
        _change_matrix, remembers=True,
    ),
    "lag": Operator(1, (_TAU,), "({0}, lagged by {1})", lag, lag_matrix, remembers=True,
                    keeps=True),
    "play": Operator(1, (Constant("r", "width", True),), "({0}, through a play of half-width {1})",
                     play, play_matrix, remembers=True, keeps=True),
    "maximum": Operator(1, (), "(highest {0} so far)", running_maximum, running_maximum_matrix,
                        remembers=True, keeps=True),
    "minimum": Operator(
        1, (), "(lowest {0} so far)", lambda knots, x, at: -running_maximum(knots, -x, at),
        lambda knots, x, at: running_maximum_matrix(knots, -x, at), remembers=True, keeps=True,
    ),
    "peak": Operator(1, (_TAU,), "(highest {0} so far, fading within {1})", _peak, _peak_matrix,
                     remembers=True, keeps=True),
}  # fmt: skip
"""Every operator by its name."""
