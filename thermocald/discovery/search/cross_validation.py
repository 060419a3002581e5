"""Cross-validation in blocks of time: does what was fitted to the rest predict them?

Each series is cut into blocks; a block of every series is left out, the coefficients are fitted to
the others, and the likelihood of the block is taken at them, with a level of its own. An effect
that only follows the noise, or bends to a trajectory that is not its own, predicts nothing.

Source: cross-validation in blocks as Burman, Chow, Nolan (1994), Biometrika 81, 351-358.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.fit import HypothesisFitter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.series import ReducedSeries

__all__ = ["confirmed", "cross_validation", "gains", "predictive"]

BLOCKS = 6
# -2 log L by which a block may be worse off for a cause that is one: of chance, and of what the
# noise model does not know, as a share of all that the effect explains
_WORSE, _WORSE_SHARE = 10.0, 0.02
_PRIOR = 1e-6  # of a coefficient's whole information, where the other blocks hold none


def predictive(
    fitter: HypothesisFitter, fit: Fit, series: Sequence[int], blocks: int = BLOCKS
) -> tuple[Array, Array]:
    """χ² and -2 log likelihood (blocks,) of the blocks as predicted without them.

    series: those that take part. Non-linear parameters stay as they are. The coefficients' own
    uncertainty is in the prediction: a step that happened in the block itself is not foreseen, and
    not held against its cause.
    """
    chi2, objective = np.zeros(blocks), np.zeros(blocks)
    for k in range(blocks):
        masks = [_block(e, k, blocks) for e in fitter.series]
        trained = _part(fitter, [~m for m in masks]).fit(fit.terms, fit.coefficients, 1, series)
        tested = _part(fitter, masks).fit(fit.terms, fit.coefficients, 1, series)
        whole = np.diag(_normal(fit, series)[0])
        own = np.where(whole > 0, _PRIOR * whole, 1.0)  # 1: of a series that takes no part
        known = _normal(trained, series)[0] + np.diag(own)
        B, c = _normal(tested, series)
        g = c - B @ trained.coefficients
        both = np.linalg.slogdet(known + B)[1] - np.linalg.slogdet(known)[1]
        for s in series:
            chi2[k] += tested.chi2_of(s, trained.coefficients)
            objective[k] += tested.reduced[s].logdet
        chi2[k] -= float(g @ np.linalg.solve(known + B, g))
        objective[k] += chi2[k] + both
    return chi2, objective


def _normal(fit: Fit, series: Sequence[int]) -> tuple[Array, Array]:
    """Normal equations A (K, K), c (K,) of all coefficients over some series."""
    K = len(fit.coefficients)
    A, c = np.zeros((K, K)), np.zeros(K)
    for s in series:
        index = fit.designs[s][2]
        A[np.ix_(index, index)] += fit.reduced[s].A
        c[index] += fit.reduced[s].c
    return A, c


def gains(fitter: HypothesisFitter, fit: Fit, kept: int = 0) -> list[Array]:
    """By how much each effect beyond the first `kept` improves the prediction of blocks (blocks,).

    The others are fitted again without it; in -2 log likelihood, all series together.
    """
    every = range(len(fitter.series))
    whole = predictive(fitter, fit, every)[1]
    out = []
    for i in range(kept, len(fit.terms)):
        fewer = fitter.fit([t for j, t in enumerate(fit.terms) if j != i])
        out.append(predictive(fitter, fitter.refine(fewer), every)[1] - whole)
    return out


def confirmed(gain: Array) -> bool:
    """A cause predicts blocks it has not seen, and makes none of them worse."""
    total = float(gain.sum())
    return total > 0 and float(gain.min()) > -(_WORSE + _WORSE_SHARE * total)


def cross_validation(fitter: HypothesisFitter, fit: Fit) -> tuple[float, float]:
    """Parameter χ² per degree of freedom on blocks of M1 that the fit did not see, and on M1."""
    e = fitter.series[0]
    outside = float(predictive(fitter, fit, [0])[0].sum())
    free = e.rank * float((e.n > 0).sum())
    return outside / max(free - BLOCKS * e.rank, 1.0), fit.chi2_of(0) / max(free - e.rank, 1.0)


def _block(evidence: ReducedSeries, number: int, blocks: int) -> NDArray[np.bool_]:
    edges = np.linspace(0, len(evidence.times), blocks + 1).astype(int)
    inside = np.zeros(len(evidence.times), dtype=bool)
    inside[edges[number] : edges[number + 1]] = True
    return inside


def _part(fitter: HypothesisFitter, masks: Sequence[NDArray[np.bool_]]) -> HypothesisFitter:
    """The fitter with the weight of some epochs alone; trajectories are the same."""
    part = HypothesisFitter([_only(e, m) for e, m in zip(fitter.series, masks, strict=True)])
    part.thermometer_factor = fitter.thermometer_factor
    part.share_trajectories(fitter)
    return part


def _only(evidence: ReducedSeries, epochs: NDArray[np.bool_]) -> ReducedSeries:
    w = epochs.astype(float)
    return replace(
        evidence,
        N=evidence.N * w[:, None, None],
        b=evidence.b * w[:, None],
        yy=evidence.yy * w,
        n=evidence.n * epochs,
        hidden=evidence.hidden.scaled(w) if evidence.hidden else None,
    )
