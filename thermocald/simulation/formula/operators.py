"""The operators of formulas: what may be done to a recorded quantity.

Two kinds. Pointwise operators take values at one time; those with memory take a polygon of values
and give it back at any times. Each comes with its derivatives, so that the thermometer's error is
carried through a formula, and with the unit and the words of what it makes.

    offset(x, a)          x - a
    above(x, k)           max(x - k, 0)
    power(x, p)           max(x, 0)^p, x in its own unit
    square(x), cube(x)    x², x³
    signed_square(x)      x |x|
    magnitude(x)          |x|
    saturation(x, k, w)   tanh((x - k) / w); a switch where w is small
    exponential(x, w)     exp(x / w)
    wave(x, P, phi)       sin(2π x / P + phi)
    product(x, y)         x y
    rate(x)               dx/dt, per s
    integral(x)           ∫ x dt from the first frame, s
    lag(x, tau)           first-order lag
    play(x, r)            backlash of half-width r
    change(x)             x less what it was at the first frame
    maximum(x), minimum(x)   the highest, the lowest value so far
    peak(x, tau)          the highest value so far, which fades towards x with a time constant
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from thermocald.simulation.operators import (
    interpolation_matrix,
    lag,
    lag_matrix,
    play,
    play_matrix,
    running_maximum,
    running_maximum_matrix,
    slope_matrix,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from scipy.sparse import csr_array

    from thermocald.arrays import Array

__all__ = ["OPERATORS", "Constant", "Operator"]

Role = Literal["threshold", "width", "time_constant", "exponent", "phase", "scale"]
# knots beyond which the error of a single reading in an integral is left out: it is below 1/√1500
# of the sum's, and its matrix is full
_LONG = 1500


@dataclass(frozen=True, slots=True)
class Constant:
    """A constant of an operator: its usual name, what it means, and whether it is above 0.

    same_unit: it has the unit of what the operator is applied to.
    """

    name: str
    role: Role
    positive: bool
    same_unit: bool = True


@dataclass(frozen=True, slots=True)
class Operator:
    """One operator.

    inputs: how many; constants: in order; powers: exponent of the input's unit in the result's (0:
    a pure number), seconds: exponent of s that is multiplied; keeps: the result is a value of
    the input's own kind (°C stays °C). value, slopes: of pointwise ones, (inputs…, constants…) →
    values, partial derivatives by each input. trajectory, matrix: of those with memory, (knots,
    values, constants, times) → values at the times, ∂ by the values at the knots.
    """

    inputs: int
    constants: tuple[Constant, ...]
    words: str
    powers: int = 1
    seconds: int = 0
    keeps: bool = False
    value: Callable[..., Array] | None = None
    slopes: Callable[..., tuple[Array, ...]] | None = None
    trajectory: Callable[..., Array] | None = None
    matrix: Callable[..., csr_array] | None = None

    @property
    def remembers(self) -> bool:
        """Whether it depends on the past."""
        return self.trajectory is not None


def _power(x: Array, p: float) -> Array:
    return np.asarray(np.maximum(x, 0.0) ** p)


def _power_slope(x: Array, p: float) -> tuple[Array]:
    # a root is vertical at its foot: held where the reading's error ends
    return (p * np.maximum(x, 1e-2) ** (p - 1.0) * (x > 0),)


def _rate_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    return slope_matrix(knots, at)


def _lag_matrix(knots: Array, values: Array, tau: float, at: Array) -> csr_array:  # noqa: ARG001
    return lag_matrix(knots, tau, at)


def _rate(knots: Array, values: Array, at: Array) -> Array:
    return np.asarray(slope_matrix(knots, at) @ values)


def _integral(knots: Array, values: Array, at: Array) -> Array:
    steps = 0.5 * np.diff(knots) * (values[1:] + values[:-1])
    total = np.append(0.0, np.cumsum(steps))
    last = len(knots) - 1
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, max(last - 1, 0))
    elapsed = np.clip(at - knots[left], 0.0, None)
    now = np.interp(at, knots, values)
    whole: Array = total[left] + 0.5 * elapsed * (values[left] + now)
    return whole - float(np.interp(0.0, knots, total))


def _integral_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    from scipy.sparse import csr_array

    n = len(knots)
    if n > _LONG or n < 2:
        return csr_array((len(at), n))
    h = np.diff(knots)
    whole = np.zeros((n, n))
    inside = np.tri(n, n - 1, -1) * h / 2.0
    whole[:, :-1] += inside
    whole[:, 1:] += inside
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, n - 2)
    share = np.clip((at - knots[left]) / h[left], 0.0, 1.0)
    weights = whole[left]
    rows = np.arange(len(at))
    weights[rows, left] += h[left] * share * (1.0 - share / 2.0)
    weights[rows, left + 1] += h[left] * share**2 / 2.0
    return csr_array(weights - _from_start(whole, knots))


def _from_start(whole: Array, knots: Array) -> Array:
    """The row of `whole` at time 0, where an integral begins: between the knots around it."""
    at = np.clip(np.searchsorted(knots, 0.0, side="right") - 1, 0, len(knots) - 2)
    share = float(np.clip(-knots[at] / (knots[at + 1] - knots[at]), 0.0, 1.0))
    out: Array = whole[at] * (1.0 - share) + whole[at + 1] * share
    return out


def _change(knots: Array, values: Array, at: Array) -> Array:
    return np.asarray(np.interp(at, knots, values) - np.interp(0.0, knots, values))


def _change_matrix(knots: Array, values: Array, at: Array) -> csr_array:  # noqa: ARG001
    from scipy.sparse import csr_array

    start = interpolation_matrix(knots, np.zeros(1))
    return csr_array(interpolation_matrix(knots, at) - start[np.zeros(len(at), dtype=int)])


def _maximum(knots: Array, values: Array, at: Array) -> Array:
    return running_maximum(knots, values, at)


def _minimum(knots: Array, values: Array, at: Array) -> Array:
    return -running_maximum(knots, -values, at)


def _minimum_matrix(knots: Array, values: Array, at: Array) -> csr_array:
    return running_maximum_matrix(knots, -values, at)


def _peak(knots: Array, values: Array, tau: float, at: Array) -> Array:
    """Source: the diode and leaky capacitor of a peak detector (Horowitz, Hill (2015): The Art of
    Electronics, 3rd ed., section 4.5.1).
    """
    left = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 1)
    decay = np.exp(-np.diff(knots) / tau)
    states = [float(values[0])]
    for v, d in zip(values[1:].tolist(), decay.tolist(), strict=True):
        states.append(max(v, v + (states[-1] - v) * d))
    now = np.interp(at, knots, values)
    gone = np.exp(-np.clip(at - knots[left], 0.0, None) / tau)
    return np.asarray(np.maximum(now, now + (np.array(states)[left] - now) * gone))


def _peak_matrix(knots: Array, values: Array, tau: float, at: Array) -> csr_array:
    """∂ peak / ∂ values: those of the input where it leads, of a lag since the peak elsewhere."""
    from scipy.sparse import csr_array

    n = len(knots)
    decay = np.append(0.0, np.exp(-np.diff(knots) / tau))
    held = _peak(knots, values, tau, knots) > values
    rows, columns, weights = [], [], []
    first = 0
    for i in range(n):
        if not held[i]:
            first = i
        gone = np.append(np.cumprod(decay[i:first:-1])[::-1], 1.0)
        share = gone * np.append(1.0, 1.0 - decay[first + 1 : i + 1])
        kept = share > 1e-6
        columns.append(np.arange(first, i + 1)[kept])
        rows.append(np.full(int(kept.sum()), i))
        weights.append(share[kept])
    at_knots = csr_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)
    )
    return interpolation_matrix(knots, at) @ at_knots


_A = Constant("a", "threshold", False)
_K = Constant("k", "threshold", False)
_W = Constant("w", "scale", True)
_TAU = Constant("tau", "time_constant", True, same_unit=False)


def _ones(x: Array, *_: float) -> tuple[Array]:
    return (np.ones_like(x),)


OPERATORS: dict[str, Operator] = {
    "offset": Operator(
        1, (_A,), "({0} − {1})", value=lambda x, a: np.asarray(x - a), slopes=_ones
    ),
    "above": Operator(
        1, (_K,), "({0} − {1})₊", value=lambda x, k: np.maximum(x - k, 0.0),
        slopes=lambda x, k: ((x > k).astype(float),),
    ),
    "power": Operator(
        1, (Constant("p", "exponent", True, same_unit=False),), "[{0}]^({1})", 0,
        value=_power, slopes=_power_slope,
    ),
    "square": Operator(
        1, (), "[{0}]²", 2, value=lambda x: np.asarray(x**2), slopes=lambda x: (2.0 * x,)
    ),
    "cube": Operator(
        1, (), "[{0}]³", 3, value=lambda x: np.asarray(x**3), slopes=lambda x: (3.0 * x**2,)
    ),
    "signed_square": Operator(
        1, (), "sign({0}) · ({0})²", 2, value=lambda x: x * np.abs(x),
        slopes=lambda x: (2.0 * np.abs(x),),
    ),
    "magnitude": Operator(1, (), "|{0}|", value=np.abs, slopes=lambda x: (np.sign(x),)),
    "saturation": Operator(
        1, (_K, _W), "tanh(({0} − {1}) / {2})", 0,
        value=lambda x, k, w: np.tanh((x - k) / w),
        slopes=lambda x, k, w: (
            1.0 / (w * np.cosh(np.clip((x - k) / w, -300.0, 300.0)) ** 2),
        ),
    ),
    "exponential": Operator(
        1, (_W,), "exp({0} / {1})", 0,
        value=lambda x, w: np.exp(np.clip(x / w, -300.0, 300.0)),
        slopes=lambda x, w: (np.exp(np.clip(x / w, -300.0, 300.0)) / w,),
    ),
    "wave": Operator(
        1, (Constant("P", "scale", True), Constant("phi", "phase", False, same_unit=False)),
        "sin(2π · {0} / {1} + {2})", 0,
        value=lambda x, P, phi: np.sin(2 * np.pi * x / P + phi),
        slopes=lambda x, P, phi: (2 * np.pi / P * np.cos(2 * np.pi * x / P + phi),),
    ),
    "product": Operator(
        2, (), "{0} · {1}", value=lambda x, y: np.asarray(x * y), slopes=lambda x, y: (y, x)
    ),
    "rate": Operator(1, (), "d{0}/dt", seconds=-1, trajectory=_rate,
                     matrix=_rate_matrix),
    "integral": Operator(1, (), "∫ {0} dt", seconds=1, trajectory=_integral,
                         matrix=_integral_matrix),
    "change": Operator(1, (), "({0} − {0} at the start)", trajectory=_change,
                       matrix=_change_matrix),
    "lag": Operator(1, (_TAU,), "({0}, lagged by {1})", keeps=True, trajectory=lag,
                    matrix=_lag_matrix),
    "play": Operator(
        1, (Constant("r", "width", True),), "({0}, through a play of half-width {1})", keeps=True,
        trajectory=play, matrix=play_matrix,
    ),
    "maximum": Operator(1, (), "(highest {0} so far)", keeps=True, trajectory=_maximum,
                        matrix=running_maximum_matrix),
    "minimum": Operator(1, (), "(lowest {0} so far)", keeps=True, trajectory=_minimum,
                        matrix=_minimum_matrix),
    "peak": Operator(
        1, (_TAU,), "(highest {0} so far, fading within {1})", keeps=True, trajectory=_peak,
        matrix=_peak_matrix,
    ),
}  # fmt: skip
"""Every operator by its name."""
