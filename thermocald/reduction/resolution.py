"""Where a long series needs short blocks: greedy halving where most happens within a block.

What happens is χ² of the cameras of a block's epochs about their mean: first of all what does not
follow the temperature in a straight line, where an effect hides that the base model lacks; to a
hundredth of its weight all movement, where lags and delays show.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.series import ReducedSeries

__all__ = ["resolved"]

_ALL_MOVEMENT = 0.01
_DAY_S = 86_400.0
_DAYS = 30.0  # of a series whose long blocks are whole days: what a day repeats averages out


def resolved(evidence: ReducedSeries, rows: int) -> NDArray[np.int64]:
    """First epochs (B,) of at most `rows` blocks."""
    E = len(evidence.times)
    apart = _Scatter(evidence, _unexplained(evidence))
    every = _Scatter(evidence, evidence.values)

    def worth(start: int, stop: int) -> float:
        return apart.within(start, stop) + _ALL_MOVEMENT * every.within(start, stop)

    first = _long_blocks(evidence.times, rows // 2)
    heap: list[tuple[float, int, int]] = []
    for start, stop in zip(first, np.append(first[1:], E), strict=True):
        heapq.heappush(heap, (-worth(int(start), int(stop)), int(start), int(stop)))
    done: list[int] = []
    while heap and len(heap) + len(done) < rows:
        _, start, stop = heapq.heappop(heap)
        if stop - start < 2:
            done.append(start)
            continue
        middle = _middle(evidence.times, start, stop)
        for part in ((start, middle), (middle, stop)):
            heapq.heappush(heap, (-worth(*part), *part))
    return np.array(sorted([*done, *(start for _, start, _ in heap)]), dtype=np.int64)


def _long_blocks(times: Array, most: int) -> NDArray[np.int64]:
    """First epochs of blocks of equal times; of a series of months, of whole days."""
    span = float(times[-1] - times[0])
    length = span / max(most, 1)
    if span > _DAYS * _DAY_S:
        length = np.ceil(length / _DAY_S) * _DAY_S
    number = np.floor((times - times[0]) / max(length, 1e-9))
    return np.flatnonzero(np.diff(number, prepend=-1.0) > 0)


def _middle(times: Array, start: int, stop: int) -> int:
    """Where a block is halved in time; at least one epoch on either side."""
    half = 0.5 * (times[start] + times[stop - 1])
    return int(np.clip(np.searchsorted(times[start:stop], half) + start, start + 1, stop - 1))


def _unexplained(evidence: ReducedSeries) -> Array:
    """The cameras (E, P) less levels and rates of the temperature, by least squares."""
    N, T = evidence.N, evidence.history.temperature() - evidence.T0
    P = N.shape[1]
    A = np.empty((2 * P, 2 * P))
    A[:P, :P] = N.sum(axis=0)
    A[:P, P:] = A[P:, :P] = np.einsum("e,epq->pq", T, N)
    A[P:, P:] = np.einsum("e,epq->pq", T * T, N)
    c = np.concatenate([evidence.b.sum(axis=0), T @ evidence.b])
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    x = scale * np.linalg.lstsq(A * np.outer(scale, scale), c * scale, rcond=1e-10)[0]
    left: Array = evidence.values - x[:P] - np.outer(T, x[P:])
    return left


class _Scatter:
    """χ² of cameras about the mean of any run of epochs, beyond their noise, from running sums."""

    def __init__(self, evidence: ReducedSeries, values: Array) -> None:
        N = evidence.N
        right = np.einsum("epq,eq->ep", N, values)
        square = np.einsum("ep,ep->e", right, values)
        self._N = _running(N)
        self._right = _running(right)
        self._square = _running(square)
        self._count = _running((evidence.n > 0).astype(float))
        self._free = evidence.rank

    def within(self, start: int, stop: int) -> float:
        """χ² less its expectation for epochs `start` to `stop`."""
        count = self._count[stop] - self._count[start]
        if count < 2:
            return 0.0
        N = self._N[stop] - self._N[start]
        right = self._right[stop] - self._right[start]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
        ridge = 1e-9 * np.eye(len(N))
        mean = scale * np.linalg.solve(N * np.outer(scale, scale) + ridge, right * scale)
        total = self._square[stop] - self._square[start] - right @ mean
        return float(total - self._free * (count - 1))


def _running(values: Array) -> Array:
    """Sums (E + 1, …) of all before each epoch."""
    out = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=out[1:])
    return out
