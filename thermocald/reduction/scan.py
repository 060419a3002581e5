"""The scan: how much χ² each trial value of a candidate would explain beyond a hypothesis.

A scan over a candidate's whole grid costs one matrix product on the epochs' normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.hypothesis import BASE

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.candidate import Candidate
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit

__all__ = ["Scan", "Scanner"]


@dataclass(frozen=True, eq=False)
class Scan:
    """What a scan found.

    gains (G,): χ² that each trial value explains, all series together; events [(G,)]: of an event,
    in each series, at each of its epochs but the first; coefficients: how many are fitted; stacks,
    parts: of each series the trajectories (G, E, m), and A (G, mk, mk), c (G, mk), B (G, mk, K)
    alongside the whole hypothesis.
    """

    gains: Array
    events: tuple[Array, ...]
    coefficients: int
    stacks: tuple[Array, ...]
    parts: tuple[tuple[Array, Array, Array], ...]

    @property
    def best(self) -> int:
        """Index of the best trial value."""
        return int(np.argmax(self.gains))


class Scanner:
    """The trajectories of candidates over their grids, computed once."""

    def __init__(self, fitter: HypothesisFitter, like: Scanner | None = None) -> None:
        """like: a scanner of the same histories under other noise."""
        self.fitter = fitter
        self._stacks: dict[tuple[int, int], Array] = like._stacks if like else {}
        self._kept: list[Candidate] = like._kept if like else []  # keeps their identities alive

    def stack(self, candidate: Candidate, series: int, fit: Fit) -> Array:
        """Trajectories (G, E, m) of a candidate over its grid in one series."""
        fitter = self.fitter
        drives = [t for t in fit.terms if t.is_drive]
        chained = candidate.kind.is_drive and bool(drives)
        key = (id(candidate), series)
        if key in self._stacks and not chained:
            return self._stacks[key]
        if candidate.kind.is_event:
            times = fitter.series[series].times
            return (times[None, :, None] >= times[1:, None, None]).astype(float)
        rows = []
        for value in candidate.grid if len(candidate.grid) else [None]:
            term = candidate.term(value, len(fitter.series))
            if candidate.kind.is_drive:
                rows.append(fitter.drive_trajectory([*drives, term], series)[:, None])
            else:
                rows.append(fitter.trajectories(term, series, operators=False)[0])
        stack: Array = np.stack(rows)
        stack -= stack.mean(axis=1, keepdims=True)
        if not chained:
            self._stacks[key] = stack
            self._kept.append(candidate)
        return stack

    def scan(self, candidate: Candidate, fit: Fit) -> Scan:
        """One candidate added to a fitted hypothesis."""
        K = len(fit.coefficients)
        stacks = tuple(self.stack(candidate, s, fit) for s in range(len(self.fitter.series)))
        parts = []
        base_A, base_c = np.zeros((K, K)), np.zeros(K)
        for s in range(len(self.fitter.series)):
            C, V, index = fit.designs[s]
            A, c, B = fit.weightings[s].scan(stacks[s], candidate.directions, (C, V))
            full = np.zeros((*c.shape, K))
            full[..., index] = B
            parts.append((A, c, full))
            base_A[np.ix_(index, index)] += fit.reduced[s].A
            base_c[index] += fit.reduced[s].c
        count, whole = len(candidate.parameters), tuple(parts)
        reference = _explained(base_A, base_c)
        if candidate.kind.is_drive:
            # the drive takes the place of T: the base's own rates leave
            keep = np.arange(len(BASE), K)
            base_A, base_c = base_A[np.ix_(keep, keep)], base_c[keep]
            parts = [(A, c, B[..., keep]) for A, c, B in parts]
            count = 0
        if candidate.kind.is_event:
            events = tuple(_gain([part], base_A, base_c) for part in parts)
            finite = tuple(np.where(np.isfinite(g), g, 0.0) for g in events)
            return Scan(np.zeros(0), finite, count, stacks, whole)
        if candidate.kind.is_periodic and len(parts) > 1:
            gains = np.sum([_gain([p], base_A, base_c) for p in parts], axis=0)
            count *= 2 * len(parts)
        else:
            gains = _gain(parts, base_A, base_c)
            count *= 2 if candidate.kind.is_periodic else 1
        gains = gains + _explained(base_A, base_c) - reference
        return Scan(gains, (), count, stacks, whole)

    def trials(self, candidate: Candidate) -> float:
        """How many independent trajectories the grid holds: its length in angles over 90°."""
        stack = self._stacks.get((id(candidate), 0))
        if stack is None or len(stack) < 2:
            return max(float(len(candidate.grid)), 1.0)
        s = stack[..., 0]
        s = s - s.mean(axis=1, keepdims=True)
        norm = np.linalg.norm(s, axis=1)
        cosine = np.sum(s[1:] * s[:-1], axis=1) / np.maximum(norm[1:] * norm[:-1], 1e-12)
        return 1.0 + float(np.sum(np.arccos(np.clip(np.abs(cosine), 0, 1)))) / (np.pi / 2)


def _explained(A: Array, c: Array) -> float:
    return float(c @ _solve(A, c[:, None])[:, 0]) if len(c) else 0.0


def _gain(parts: list[tuple[Array, Array, Array]], base_A: Array, base_c: Array) -> Array:
    """χ² explained by candidates (G,) beyond the base."""
    A: Array = np.sum([p[0] for p in parts], axis=0)
    c: Array = np.sum([p[1] for p in parts], axis=0)
    B: Array = np.sum([p[2] for p in parts], axis=0)
    if len(base_c):
        X = _solve(base_A, np.column_stack([base_c, B.reshape(-1, len(base_c)).T]))
        c = c - B @ X[:, 0]
        BX = np.einsum("gir,rgj->gij", B, X[:, 1:].reshape(len(base_c), *c.shape))
        A = A - BX
    scale = np.sqrt(np.maximum(np.einsum("gii->gi", A), 1e-12))
    own = A / scale[:, :, None] / scale[:, None, :]
    own = own + 1e-9 * np.eye(A.shape[-1])
    right = c / scale
    weak = scale.min(axis=1) < 1e-3
    out: Array = np.einsum("gi,gi->g", right, np.linalg.solve(own, right[..., None])[..., 0])
    return np.where(weak, -np.inf, out)


def _solve(A: Array, right: Array) -> Array:
    if not len(A):
        return np.zeros((0, right.shape[1]))
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    x: Array = (
        np.linalg.solve(A / np.outer(d, d) + 1e-12 * np.eye(len(A)), right / d[:, None])
        / d[:, None]
    )
    return x
