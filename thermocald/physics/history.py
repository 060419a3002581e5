"""The temperature history of a series, from which effects are computed.

Readings are joined by straight lines, so that the temperature has a value at any time between the
first and the last frame, even if a reading is missing or was taken a second before or after the
frame. The operators on this polygon are in `operators`.

Time 0 is the first frame of the series. The past begins there: before it, the temperature is taken
as constant.

Followers are operators that take the knots of a polygon one by one, in order, and return the value
at the last knot: the same numbers, at the cost of one knot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.errors import DataError
from thermocald.physics.operators import interpolation_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike
    from scipy.sparse import csr_array

    from thermocald.arrays import Array, Index


@dataclass(frozen=True, eq=False)
class Polygon:
    """A temperature as a polygon: times (K,) s ascending, values (K,) °C.

    weights: weight, knot and reading of each entry of `matrix`; readings: their number R.
    """

    times: Array
    values: Array
    weights: tuple[Array, Index, Index]
    readings: int

    @cached_property
    def matrix(self) -> csr_array:
        """∂ values / ∂ readings (K, R)."""
        from scipy.sparse import csr_array

        weight, *place = self.weights
        return csr_array((weight, tuple(place)), shape=(len(self.times), self.readings))

    def at(self, times: ArrayLike) -> Array:
        """Return the temperature (...,) °C at some times; constant beyond the ends."""
        return np.asarray(np.interp(np.asarray(times, dtype=float), self.times, self.values))


@dataclass(frozen=True, eq=False)
class History:
    """The recorded temperatures, and the times at which they are evaluated.

    times (E,): of the frames, s since the series' start, ascending; reading_times (R,): s on the
    same axis; readings: {channel: (R,)} °C, NaN where missing; reference: the channel of T; T0: the
    model's reference temperature °C, one value for all series of a camera; columns: {name: (times
    (N,) s, values (N,))} of other recorded quantities, such as a humidity.
    """

    times: Array
    reading_times: Array
    readings: Mapping[str, Array]
    reference: str
    T0: float
    columns: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    def at(self, times: ArrayLike) -> Self:
        """Return the history with other times."""
        return replace(self, times=np.asarray(times, dtype=float))

    @cached_property
    def _polygons(self) -> dict[str, Polygon]:
        return {}

    def polygon(self, channel: str | None = None) -> Polygon:
        """Return the polygon of a channel (default: the reference); it covers all frames.

        Raises DataError if the channel is unknown or was never read.
        """
        name = channel or self.reference
        if name not in self._polygons:
            if name not in self.readings:
                raise DataError(
                    f"there is no temperature column {name!r}; there are: "
                    f"{', '.join(self.readings) or 'none'}"
                )
            self._polygons[name] = _lay_polygon(self.reading_times, self.readings[name], self.times)
        return self._polygons[name]

    def temperature(self, channel: str | None = None) -> Array:
        """Return the temperature (E,) °C of a channel at the frames' times."""
        return self.polygon(channel).at(self.times)

    def temperature_matrix(self) -> csr_array:
        """Return ∂ temperature / ∂ readings (E, R) of the reference."""
        p = self.polygon()
        return interpolation_matrix(p.times, self.times) @ p.matrix


def _lay_polygon(times: Array, readings: Array, frames: Array) -> Polygon:
    """Lay knots at the valid readings; extrapolate the outer edges by at most their own length."""
    rows = np.flatnonzero(np.isfinite(readings) & np.isfinite(times))
    if not len(rows):
        raise DataError("the temperature was never read: every reading of the column is empty")
    rows = rows[np.argsort(times[rows], kind="stable")]
    # of several readings with the same time stamp, the last one counts
    rows = rows[np.append(np.diff(times[rows]) > 0, True)]
    t, n = times[rows], len(rows)
    begin, end = frames.min(initial=t[0]), frames.max(initial=t[-1])
    early, late = int(begin < t[0]), int(end > t[-1])
    column, weight, knot = [rows], [np.ones(n)], [np.arange(n) + early]
    for first, second, edge, place in (
        (0, 1 % n, begin, 0), (n - 1, max(n - 2, 0), end, n + early)
    ):  # fmt: skip
        if edge != t[first]:
            step = t[first] - t[second]
            share = float(np.clip((edge - t[first]) / step, 0.0, 1.0)) if n > 1 else 0.0
            column.append(rows[[first, second]])
            weight.append(np.array([1.0 + share, -share]))
            knot.append(np.full(2, place))
    weights, places, columns = (np.concatenate(x) for x in (weight, knot, column))
    knots = np.concatenate([[begin], t, [end]])[1 - early : n + 1 + late]
    values = np.bincount(places, weights * readings[columns]).astype(float, copy=False)
    return Polygon(knots, values, (weights, places, columns), len(times))


Follower = Callable[[float, float], float]
"""An operator with a state: it takes the next knot, s and °C, and returns its value there."""


def follow_lag(tau: float) -> Follower:
    """Return a follower of `operators.lag`, with a time constant s."""
    last = before = state = math.nan

    def push(time: float, value: float) -> float:
        nonlocal last, before, state
        if math.isnan(last):
            state = value
        else:
            x = (time - last) / tau
            a, g = math.exp(-x), -math.expm1(-x) / x
            state = a * state + (g - a) * before + (1.0 - g) * value
        last, before = time, value
        return state

    return push


def follow_play(half_width: float) -> Follower:
    """Return a follower of `operators.play`, with a half-width K."""
    state = math.nan

    def push(_: float, value: float) -> float:
        nonlocal state
        if math.isnan(state):
            state = value
        state = min(max(state, value - half_width), value + half_width)
        return state

    return push


def follow_delay(d: float) -> Follower:
    """Return a follower of a delay d s; if it is negative, the present value is the best known."""
    knots: deque[tuple[float, float]] = deque()

    def push(time: float, value: float) -> float:
        knots.append((time, value))
        asked = time - d
        while len(knots) > 2 and knots[1][0] <= asked:
            knots.popleft()
        if d <= 0 or len(knots) == 1:
            return value
        (t0, v0), (t1, v1) = knots[0], knots[1]
        return v0 + (v1 - v0) * min(max((asked - t0) / (t1 - t0), 0.0), 1.0)

    return push
