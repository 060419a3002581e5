"""Shift or tilt: whether a recording separates a principal point that moves from a camera that
turns.

Seen from one place both move the image alike; only the perspective differs. How far a recording
shows that is in its reduced normal equations: with both in the model along the trajectory of the
effect, their correlation, and by how much the one explains the image better than the other.

Source: canonical correlations as Hotelling (1936), Biometrika 28, 321-377.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.series import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit

__all__ = ["ShiftOrTilt", "shift_or_tilt"]

_SHIFT = ("x0", "y0")
_TILT = ("omega", "phi")
_BOTH = ("c", "kappa")  # a scale and a turn about the axis are seen whatever the rest is
# χ² by which the one has to explain more: of four coefficients, once in a thousand by chance
_SURE = 18.5


@dataclass(frozen=True)
class ShiftOrTilt:
    """correlation: the largest of a combination of x0, y0 with one of omega, phi; difference: χ²
    that the shift explains beyond what the tilt does.
    """

    correlation: float
    difference: float

    @property
    def separable(self) -> bool:
        """Whether this recording separates them."""
        return abs(self.difference) > _SURE

    @property
    def sentence(self) -> str:
        """What is added to the statement of an effect; nothing where they are separated."""
        if self.separable:
            return ""
        return (
            "; its cause in time is named, but in this recording a shift of the principal point "
            f"and a tilt of the camera are not separable (correlation {self.correlation:.4f}, "
            f"χ² differs by {abs(self.difference):.1f})"
        )

    def as_json(self) -> dict[str, Any]:
        """For the effect's evidence."""
        return {
            "correlation": self.correlation,
            "chi2_difference": self.difference,
            "separable": self.separable,
        }


def shift_or_tilt(fitter: HypothesisFitter, fit: Fit, number: int) -> ShiftOrTilt | None:
    """Compare the two for one term of a fit; None where it moves neither."""
    term = fit.terms[number]
    if not {*_SHIFT, *_TILT} & set(term.parameters):
        return None
    rest = tuple(p for p in term.parameters if p not in (*_SHIFT, *_TILT, *_BOTH))
    names = (*_SHIFT, *_TILT, *_BOTH, *rest)
    shift, tilt, both = np.arange(2), np.arange(2, 4), np.arange(4, len(names))
    own = -1 if term.is_drive else number
    # of the estimates, c and kappa estimated too; an effect that is T itself has its shift in the
    # base's rates
    Q = np.linalg.inv(_scaled(*_normal_equations(fitter, fit, number, names, {own, -1}))[0])
    low_s, low_t = (np.linalg.cholesky(Q[np.ix_(i, i)]) for i in (shift, tilt))
    whitened = np.linalg.solve(low_s, np.linalg.solve(low_t, Q[np.ix_(tilt, shift)]).T)
    correlation = float(min(np.linalg.svd(whitened, compute_uv=False)[0], 1.0))
    A, c = _scaled(*_normal_equations(fitter, fit, number, names, {own}))
    gains = [_explained(A, c, np.concatenate([i, both])) for i in (shift, tilt)]
    return ShiftOrTilt(correlation, gains[0] - gains[1])


def _normal_equations(
    fitter: HypothesisFitter, fit: Fit, number: int, names: Sequence[str], own: set[int]
) -> tuple[Array, Array]:
    """A (k, k), c (k,) of a term's trajectory in some columns, the other coefficients eliminated.

    own: the terms whose coefficients are left out, -1 being the base's rates.
    """
    term = fit.terms[number]
    directions = np.zeros((len(COLUMNS), len(names)))
    directions[[COLUMNS.index(n) for n in names], np.arange(len(names))] = 1.0
    k, K = len(names), len(fit.coefficients)
    A, c = np.zeros((k + K, k + K)), np.zeros(k + K)
    for s, weighting in enumerate(fit.weightings):
        if term.values(s) is None:
            continue
        if term.is_drive:
            trajectory = fitter.drive(fit.terms, s)[0]
        else:
            trajectory = fitter.trajectories(term, s, fit.terms, operators=False)[0][:, 0]
        trajectory = trajectory - trajectory.mean()
        C, V, index = fit.designs[s]
        mine = [range(b.start, b.stop) for b in fit.blocks if b.term in own]
        kept = np.array([not any(i in r for r in mine) for i in index], dtype=bool)
        joint = weighting.reduce(
            np.hstack([np.tile(trajectory[:, None], k), C[:, kept]]),
            np.hstack([directions, V[:, kept]]),
        )
        at = np.concatenate([np.arange(k), k + index[kept]])
        A[np.ix_(at, at)] += joint.A
        c[at] += joint.c
    used = np.flatnonzero(np.diag(A)[k:] > 0) + k
    if not len(used):
        return A[:k, :k], c[:k]
    d = np.sqrt(np.diag(A)[used])
    inner = A[np.ix_(used, used)] / np.outer(d, d) + 1e-12 * np.eye(len(used))
    X = np.linalg.solve(inner, np.column_stack([A[used, :k], c[used]]) / d[:, None])
    outer = A[:k, used] / d
    return A[:k, :k] - outer @ X[:, :k], c[:k] - outer @ X[:, k]


def _scaled(A: Array, c: Array) -> tuple[Array, Array]:
    """The same with a unit diagonal."""
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    return A / np.outer(d, d) + 1e-12 * np.eye(len(d)), c / d


def _explained(A: Array, c: Array, some: NDArray[np.int64]) -> float:
    return float(c[some] @ np.linalg.solve(A[np.ix_(some, some)], c[some]))
