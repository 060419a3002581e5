"""What all epochs of a running series share, estimated epoch after epoch.

A camera that stands still has one exterior orientation (`exterior: series`), and a target that is
not where the test field says errs in every epoch by the same vector (`target_offsets`). Each epoch
adds its normal equations with its own parameters eliminated; its own parameters then follow from
what all epochs so far say of the common ones. The standard deviations hold the noise of the epoch
and what is still uncertain of the common unknowns, which is the same for all epochs.

Source: the reduction of common unknowns as Helmert blocking, Wolf, H. (1978): The Helmert block
method; `photogrammetry.series` does the same with all epochs at hand.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.series.normals import ObservationGrid, linearise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment, AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import Partials

    Array = NDArray[np.float64]

__all__ = ["CommonUnknowns"]

log = logging.getLogger(__name__)

_EOP = np.arange(10, 16)
_MOST_TARGETS = 300  # 1 GFLOP and 14 MB whenever they are solved for
_ROUNDS = 4
_STRAIGHT_PX = 1.0  # a step that the partial derivatives carry to 1e-3 of itself
_TINY = 1e-12  # px²: a target without sigma has no offset
_VARIANCE_MEMORY = 50  # epochs over which the variance of unit weight is averaged
_MOVED = 38.3  # chi-square, 6 degrees of freedom, error probability 1e-6
_SOLVED_AFTER = 0.05  # share of new epochs from which the common unknowns are solved for again


@dataclass(frozen=True, slots=True)
class _Reduced:
    """One epoch: own cofactors Q (p, p), their product with the coupling QC (p, q), with the right
    hand side Qn (p,); the common unknowns' S (q, q), s (q,); lPl less the own part.
    """

    Q: Array
    QC: Array
    Qn: Array
    S: Array
    s: Array
    lPl: float


class CommonUnknowns:
    """The common unknowns of one series; `refine` takes epochs in any order, one thread at a time.

    still: one exterior orientation for all epochs; offsets: one offset per target, with the test
    field's sigmas as prior, for up to 300 targets: their normal matrix is a full one. epochs: how
    many were taken in since the beginning or the last reset.
    """

    def __init__(
        self, sensor: Sensor, testfield: TestField, settings: AdjustmentSettings,
        *, still: bool, offsets: bool,
    ) -> None:  # fmt: skip
        self.epochs = 0
        self._sensor = sensor
        self._field = testfield
        self._settings = settings
        free = [i for i, name in enumerate(IOP_NAMES) if name in settings.free]
        self._own = np.array(free + ([] if still else _EOP.tolist()), dtype=np.int64)
        self._still = still
        self._offsets = offsets and bool((testfield.sigmas > 0).any())
        if self._offsets and len(testfield) > _MOST_TARGETS:
            log.warning("%d targets are too many for target_offsets", len(testfield))
            self._offsets = False
        self._at: Partials | None = None
        self._surprised = False

    @property
    def any(self) -> bool:
        """Whether there is something that epochs share."""
        return (self._still or self._offsets) and len(self._own) > 0

    def reset(self) -> None:
        """Forget all: the camera was moved and sees its targets from elsewhere."""
        self._at = None
        self.epochs = 0

    def refine(
        self, observations: Observations, apart: Adjustment, *, moved: bool = False
    ) -> Adjustment:
        """An epoch's result given all epochs so far, this one included.

        apart: the epoch's adjustment by itself, whose rejected targets stay rejected; returned as
        it is where it is no result. moved: the epoch contradicts the others in what the caller
        knows. With a common orientation such an epoch has no result; the second one in a row begins
        anew.
        """
        if not self.any or not apart.ok:
            return apart
        if self.epochs > 1 and (moved or self._contradicted(apart)):
            if not self._still:
                return apart
            if not self._surprised:
                self._surprised = True
                why = "it contradicts the one exterior orientation of its series: was it moved?"
                return failed("moved", why, observations, apart.free)
            self.reset()
        self._surprised = False
        at = self._at or self._begin(apart)
        grid = ObservationGrid.from_observations(self._field, [observations])
        weights, points = grid.weights[0], grid.points[0]
        weights[list(apart.rejected)] = 0.0
        own = apart.values.copy()
        if self._still:
            own[10:] = at.eop
        for _ in range(_ROUNDS):
            one = self._reduce(at, weights, points, own)
            if self._solved is None or self.epochs + 1 > (1 + _SOLVED_AFTER) * self._solved[0]:
                self._solve(self._H + one.S, self._h + one.s)
            assert self._solved is not None
            _, g, cofactor = self._solved
            step = one.Qn - one.QC @ g
            own[self._own] += step
            if np.abs(at.A[:, :, self._own] @ step).max(initial=0.0) < _STRAIGHT_PX:
                break
        self._H += one.S
        self._h += one.s
        self.epochs += 1
        vPv = one.lPl - 2.0 * float(one.s @ g) + float(g @ one.S @ g)
        variance = max(vPv, 0.0) / max(apart.redundancy, 1)
        self._variance += (variance - self._variance) / min(self.epochs, _VARIANCE_MEMORY)
        return self._result(apart, own, g, cofactor, one, variance)

    def _contradicted(self, apart: Adjustment) -> bool:
        """Whether the epoch's own exterior orientation is another one than the common one."""
        if not self._still or self._at is None or self._solved is None:
            return False
        _, g, cofactor = self._solved
        d = apart.values[10:] - self._at.eop - g[:6]
        covariance = apart.covariance[10:, 10:] + cofactor[:6, :6] * self._variance
        return float(d @ _inverse(covariance) @ d) > _MOVED

    def _begin(self, apart: Adjustment) -> Partials:
        """Linearise at an epoch; nothing but the priors is known of the common unknowns."""
        values, T = apart.values, len(self._field)
        self._at = at = linearise(self._sensor, self._field, values[:10], values[10:])
        first = 6 if self._still else 0
        q = first + (2 * T if self._offsets else 0)
        self._H, self._h = np.zeros((q, q)), np.zeros(q)
        self._variance = max(apart.sigma0**2, 1e-6)
        self._solved: tuple[int, Array, Array] | None = None
        for i in _EOP if self._still else []:
            if (known := self._settings.priors.get(PARAMETER_NAMES[i])) is not None:
                self._H[i - 10, i - 10] = 1.0 / known[1] ** 2
                self._h[i - 10] = (known[0] - values[i]) / known[1] ** 2
        if self._offsets:
            variance = self._field.sigmas**2
            xx, yy = ((at.B[:, k] ** 2 * variance).sum(axis=1) + _TINY for k in (0, 1))
            xy = (at.B[:, 0] * at.B[:, 1] * variance).sum(axis=1)
            self._prior = np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None]
        return at

    def _reduce(self, at: Partials, weights: Array, points: Array, own: Array) -> _Reduced:
        """Normal equations at the epoch's own parameters and the linearisation's common ones."""
        r = points - project(self._sensor, own[:10], own[10:], self._field.points)
        r[weights[:, 0] == 0] = 0.0
        A, E = at.A[:, :, self._own], at.A[:, :, _EOP]
        PA, Pr = _weighted(weights, A), _weighted(weights, r[:, :, None])[:, :, 0]
        N, n = np.einsum("tik,til->kl", A, PA), np.einsum("tik,ti->k", A, Pr)
        for k, i in enumerate(self._own):
            if (known := self._settings.priors.get(PARAMETER_NAMES[i])) is not None:
                N[k, k] += 1.0 / known[1] ** 2
                n[k] += (known[0] - own[i]) / known[1] ** 2
        Q = _inverse(N)
        q = len(self._h)
        S, C, s = np.zeros((q, q)), np.empty((len(N), q)), np.empty(q)
        first = 6 if self._still else 0
        if self._still:
            PE = _weighted(weights, E)
            S[:6, :6] = np.einsum("tik,til->kl", E, PE)
            C[:, :6] = np.einsum("tik,til->kl", A, PE)
            s[:6] = np.einsum("tik,ti->k", E, Pr)
        if self._offsets:
            _add_blocks(S[first:, first:], weights)
            C[:, first:] = PA.reshape(-1, len(N)).T
            s[first:] = Pr.ravel()
            if self._still:
                S[:6, 6:] = PE.reshape(-1, 6).T
                S[6:, :6] = S[:6, 6:].T
        QC, Qn = Q @ C, Q @ n
        return _Reduced(Q, QC, Qn, S - C.T @ QC, s - C.T @ Qn, float((Pr * r).sum() - n @ Qn))

    def _solve(self, H: Array, h: Array) -> None:
        """Estimate and cofactors; the prior is weighted against image points, and added to H."""
        if self._offsets:
            first = 6 if self._still else 0
            _add_blocks(H[first:, first:], self._variance * self._prior)
        cofactor = _inverse(H)
        self._solved = self.epochs + 1, cofactor @ h, cofactor

    def _result(
        self, apart: Adjustment, own: Array, g: Array, cofactor: Array, one: _Reduced,
        variance: float,
    ) -> Adjustment:  # fmt: skip
        covariance = np.zeros((16, 16))
        shared = one.QC @ cofactor
        covariance[np.ix_(self._own, self._own)] = one.Q + shared @ one.QC.T
        if self._still:
            own[10:] += g[:6]
            covariance[10:, 10:] = cofactor[:6, :6]
            covariance[np.ix_(self._own, _EOP)] = -shared[:, :6]
            covariance[np.ix_(_EOP, self._own)] = -shared[:, :6].T
        factor = self._variance if self._settings.scale == "posterior" else 1.0
        return replace(
            apart,
            interior=InteriorOrientation.from_array(own[:10]),
            exterior=ExteriorOrientation.from_array(own[10:]),
            covariance=covariance * factor,
            sigma0=float(np.sqrt(variance)),
        )


def _weighted(weights: Array, columns: Array) -> Array:
    """P times columns (T, 2, k); weights (T, 3): the elements xx, yy, xy."""
    out: Array = weights[:, :2, None] * columns
    out += weights[:, 2, None, None] * columns[:, ::-1]
    return out


def _add_blocks(matrix: Array, blocks: Array) -> None:
    """Add (T, 3) elements xx, yy, xy to the 2 × 2 blocks on the diagonal."""
    x = 2 * np.arange(len(blocks))
    matrix[x, x] += blocks[:, 0]
    matrix[x + 1, x + 1] += blocks[:, 1]
    matrix[x, x + 1] += blocks[:, 2]
    matrix[x + 1, x] += blocks[:, 2]


def _inverse(N: Array) -> Array:
    """The inverse of a symmetric matrix whose unknowns differ in scale by many powers of ten."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-30))
    inverse: Array = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    return inverse
