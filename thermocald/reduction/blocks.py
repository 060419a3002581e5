"""Long series on blocks of neighbouring epochs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.resolution import resolved
from thermocald.reduction.series import Blocks, solve

if TYPE_CHECKING:
    from thermocald.reduction.series import ReducedSeries

__all__ = ["in_blocks"]


def in_blocks(evidence: ReducedSeries, rows: int = 720) -> ReducedSeries:
    """A long series on at most `rows` blocks of neighbouring epochs; a short one as it is.

    Heat is slow: over twelve epochs of 10 s a trajectory of parameters loses what is faster than
    some minutes, and nothing else. Trajectories are computed on all epochs and then averaged. The
    blocks of a series of weeks and more are short where the camera moves fast, and days elsewhere.
    """
    from scipy.sparse import csr_array

    E = len(evidence.times)
    if rows >= E:
        return evidence
    size = int(np.ceil(E / rows))
    first = np.arange(0, E, size)
    if evidence.source.counts is not None:
        first = resolved(evidence, rows)
    block = np.repeat(np.arange(len(first)), np.diff(first, append=E))
    B = int(block[-1]) + 1
    weight = evidence.n * evidence.source.per_row
    total = np.bincount(block, weight, minlength=B)
    share = weight / np.where(total > 0, total, 1.0)[block]
    average = csr_array((share, (block, np.arange(E))), shape=(B, E))
    N = np.add.reduceat(evidence.N, first, axis=0)
    b = np.add.reduceat(evidence.b, first, axis=0)
    values = solve(N, b)
    yy = np.einsum("ek,ek->e", values, b)
    rank = float(np.sum(np.linalg.eigvalsh(N.sum(axis=0)) > 1e-9 * np.trace(N.sum(axis=0))))
    knots = next(iter(evidence.thermometers.values())).times
    inside = (knots >= evidence.history.times[0] - 30.0) & (
        knots <= evidence.history.times[-1] + 30.0
    )
    near = np.clip(np.searchsorted(evidence.history.times, knots), 0, E - 1)
    state = np.where(inside, block[near], 0)
    state[~inside] = B + np.arange(int((~inside).sum()))
    _, state = np.unique(state, return_inverse=True)
    pool = csr_array(
        (np.ones(len(knots)), (np.arange(len(knots)), state)),
        shape=(len(knots), int(state.max()) + 1),
    )
    there = np.maximum(np.add.reduceat((evidence.n > 0).astype(float), first), 1.0)
    return replace(
        evidence,
        times=average @ evidence.times + (total == 0) * evidence.times[first],
        N=N,
        b=b,
        yy=yy,
        values=values,
        n=np.add.reduceat(evidence.n, first),
        sigma0=np.sqrt(np.add.reduceat(evidence.sigma0**2, first) / there),
        blocks=Blocks(
            average,
            pool,
            rank * float((evidence.n > 0).sum() - (total > 0).sum()),
            first,
        ),
        hidden=evidence.hidden.in_blocks(first) if evidence.hidden else None,
    )
