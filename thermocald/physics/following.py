"""The operators of drives, one knot at a time: what `operators` says of a whole polygon.

Each takes the knots of a polygon in order and gives the value at the last: the same numbers, at
the cost of one knot.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol


class Follower(Protocol):
    """An operator that keeps its state."""

    def push(self, time: float, value: float) -> float:
        """Take the next knot, s and °C; return the operator's value there."""


class LagFollower:
    """`operators.lag` with a time constant s."""

    def __init__(self, tau: float) -> None:
        self.tau, self.time, self.input, self.state = tau, math.nan, math.nan, math.nan

    def push(self, time: float, value: float) -> float:
        """Take the next knot; return the lagged value."""
        if math.isnan(self.time):
            self.state = value
        else:
            x = (time - self.time) / self.tau
            a, g = math.exp(-x), -math.expm1(-x) / x
            self.state = a * self.state + (g - a) * self.input + (1.0 - g) * value
        self.time, self.input = time, value
        return self.state


class PlayFollower:
    """`operators.play` with a half-width K."""

    def __init__(self, half_width: float) -> None:
        self.half_width, self.state = half_width, math.nan

    def push(self, time: float, value: float) -> float:  # noqa: ARG002
        """Take the next knot; return where the play rests."""
        if math.isnan(self.state):
            self.state = value
        self.state = min(max(self.state, value - self.half_width), value + self.half_width)
        return self.state


class DelayFollower:
    """The value d s ago; with a negative delay the present one, as nobody knows more."""

    def __init__(self, d: float) -> None:
        self.d = d
        self.knots: deque[tuple[float, float]] = deque()

    def push(self, time: float, value: float) -> float:
        """Take the next knot; return the value d s before it."""
        self.knots.append((time, value))
        asked = time - self.d
        while len(self.knots) > 2 and self.knots[1][0] <= asked:
            self.knots.popleft()
        if self.d <= 0 or len(self.knots) == 1:
            return value
        (t0, v0), (t1, v1) = self.knots[0], self.knots[1]
        return v0 + (v1 - v0) * min(max((asked - t0) / (t1 - t0), 0.0), 1.0)
