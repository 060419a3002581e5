"""What all epochs of a running series share, estimated epoch after epoch.

A camera that stands still has one exterior orientation (`exterior: series`), or one and movements
of its mount (`mount`, `auto`), and a target that is not where the test field says errs in every
epoch by the same vector (`target_offsets`). Each epoch adds its normal equations with its own
parameters eliminated; its own parameters then follow from what all epochs so far say of the common
ones. The standard deviations hold the noise of the epoch, the movements of the mount, and what is
still uncertain of the common unknowns, which is the same for all epochs.

How far the mount moves is estimated from the last epochs, as `photogrammetry.series.mount` does;
until there are enough of them the mount is loose, as with `per_epoch`.

Source: the reduction of common unknowns as Helmert blocking, Wolf, H. (1978): The Helmert block
method; `photogrammetry.series` does the same with all epochs at hand.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.linalg import scaled_inverse
from thermocald.photogrammetry.parameters import (
    EOP,
    EOP_COLUMNS,
    IOP,
    PARAMETER_NAMES,
    free_columns,
)
from thermocald.photogrammetry.series.mount import (
    FASTEST_DRIFT_S,
    FEWEST_EPOCHS,
    estimate_movement,
)
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    linearise,
    normal_matrices,
    right_hand_sides,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment, AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.mount import Movement
    from thermocald.photogrammetry.series.normals import Partials
    from thermocald.photogrammetry.series.result import Exterior

    Array = NDArray[np.float64]

__all__ = ["CommonUnknowns"]

log = logging.getLogger(__name__)

_MOST_TARGETS = 300  # 1 GFLOP and 14 MB whenever they are solved for
_ROUNDS = 4
_STRAIGHT_PX = 1.0  # a step that the partial derivatives carry to 1e-3 of itself
_TINY = 1e-12  # px²: a target without sigma has no offset
_VARIANCE_MEMORY = 50  # epochs over which the variance of unit weight is averaged
_MOVED = 38.3  # chi-square, 6 degrees of freedom, error probability 1e-6
_LOOSE_PX = 3.0  # what an unknown mount may move by
_WINDOW = 240  # epochs that tell how far the mount moves
_WINDOW_POINTS = 60_000  # image points kept for that
_SOLVED_AFTER = 0.05  # share of new epochs from which the common unknowns are solved for again


@dataclass(frozen=True, slots=True)
class _Reduced:
    """One epoch: own cofactors Q (p, p), their product with the coupling QC (p, q), with the right
    hand side Qn (p,); the common unknowns' S (q, q), s (q,); lPl less the own part; used: how many
    observations its own parameters use up.
    """

    Q: Array
    QC: Array
    Qn: Array
    S: Array
    s: Array
    lPl: float
    used: float


@dataclass(frozen=True, slots=True)
class _Solved:
    """The common unknowns g (q,) from so many epochs, their cofactors (q, q), and how many
    observations they use up.
    """

    epochs: int
    g: Array
    cofactor: Array
    used: float


class CommonUnknowns:
    """The common unknowns of one series; `refine` takes epochs in any order, one thread at a time.

    exterior: `per_epoch`, `series`, or `mount` and `auto`, which are the same here: where no
    movement is found the mount is held. offsets: one offset per target, with the test field's
    sigmas as prior, for up to 300 targets: their normal matrix is a full one. interval_s: between
    epochs. epochs: how many were taken in since the start or the last reset; movement: of the
    mount, as far as it is known.
    """

    def __init__(
        self,
        sensor: Sensor,
        testfield: TestField,
        settings: AdjustmentSettings,
        *,
        exterior: Exterior,
        offsets: bool,
        interval_s: float = 10.0,
    ) -> None:
        self.epochs = 0
        self._sensor = sensor
        self._field = testfield
        self._settings = settings
        self._free = np.array(free_columns(settings.free), dtype=np.int64)
        self._still = exterior != "per_epoch"
        self._moves = exterior in ("mount", "auto")
        own_eop = EOP_COLUMNS if exterior != "series" else EOP_COLUMNS[:0]
        self._own = np.concatenate([self._free, own_eop])
        self._period = max(FASTEST_DRIFT_S / interval_s, 12.0)
        size = min(_WINDOW, max(_WINDOW_POINTS // max(len(testfield), 1), FEWEST_EPOCHS))
        self._recent: deque[tuple[Array, Array]] = deque(maxlen=size)
        self._looked = 0
        self.movement: Movement | None = None
        self._solved: _Solved | None = None
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
        self._recent.clear()
        self._looked = 0
        self.movement = None

    def refine(
        self, observations: Observations, apart: Adjustment, *, moved: bool = False
    ) -> Adjustment:
        """An epoch's result given all epochs so far, this one included.

        apart: the epoch's adjustment by itself, whose rejected targets stay rejected; returned as
        it is where it is not a result. moved: the epoch contradicts the others in what the caller
        knows. With a common orientation such an epoch has no result; the second one in a row starts
        again.
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
        at = self._at or self._start(apart)
        grid = ObservationGrid.from_observations(self._field, [observations])
        weights, points = grid.weights[0], grid.points[0]
        weights[list(apart.rejected)] = 0.0
        own = apart.values.copy()
        if self._still:
            own[EOP] = at.eop
        one, solved = self._take(at, weights, points, own)
        self._H += one.S
        self._h += one.s
        self.epochs += 1
        g = solved.g
        vPv = one.lPl - 2.0 * float(one.s @ g) + float(g @ one.S @ g)
        n = 2 * int((weights[:, 0] > 0).sum())
        redundancy = n - one.used - solved.used / max(self.epochs, solved.epochs)
        variance = self._variance
        if redundancy > 0:
            # Early on the common unknowns use up most of an epoch: what is left says little.
            variance = max(vPv, 0.0) / redundancy
            weight = redundancy / max(n - one.used, 1.0) / min(self.epochs, _VARIANCE_MEMORY)
            self._variance += (variance - self._variance) * min(weight, 1.0)
        result = self._result(apart, own, solved, one, variance)
        if self._moves:
            self._recent.append((weights, points))
            self._watch_mount(at)
        return result

    def _take(
        self, at: Partials, weights: Array, points: Array, own: Array
    ) -> tuple[_Reduced, _Solved]:
        """Reduce an epoch and move its own parameters (16,), in place, to their solution."""
        for _ in range(_ROUNDS):
            one = self._reduce(at, weights, points, own)
            if self._solved is None or self.epochs + 1 > (1 + _SOLVED_AFTER) * self._solved.epochs:
                self._solve(self._H + one.S, self._h + one.s)
            assert self._solved is not None
            solved: _Solved = self._solved
            step = one.Qn - one.QC @ solved.g
            own[self._own] += step
            if np.abs(at.A[:, :, self._own] @ step).max(initial=0.0) < _STRAIGHT_PX:
                break
        return one, solved

    def _watch_mount(self, at: Partials) -> None:
        """Estimate how far the mount moves whenever the epochs have doubled, or a window passed."""
        first_look = self._looked == 0 and self.epochs >= FEWEST_EPOCHS
        doubled = self._looked > 0 and self.epochs >= 2 * self._looked
        passed = self._looked > 0 and self.epochs >= self._looked + _WINDOW
        if not (first_look or doubled or passed):
            return
        self._looked = self.epochs
        weights = np.array([w for w, _ in self._recent])
        points = np.array([p for _, p in self._recent])
        left = np.where(weights[..., :1] > 0, points - at.predicted, 0.0)
        if self._offsets and self._solved is not None:
            left = left - self._solved.g[6:].reshape(-1, 2)
        N = normal_matrices(weights, at.A)
        b = right_hand_sides(weights, left, at.A)
        scale = 1.0 / max(self._variance, 1e-6)
        good = np.ones(len(N), dtype=bool)
        self.movement = estimate_movement(N * scale, b * scale, self._free, good, self._period)
        self._bound = self.movement.precision()
        if self.epochs > len(self._recent):
            return  # older epochs keep the weight they had
        self._H, self._h = self._empty(at)
        self._solved = None
        for w, p in list(self._recent):
            one = self._reduce(at, w, p, np.concatenate([at.iop, at.eop]))
            self._H += one.S
            self._h += one.s
        self._solve(self._H, self._h, self.epochs)

    def _contradicted(self, apart: Adjustment) -> bool:
        """Whether the epoch's own exterior orientation is another one than the common one."""
        if not self._still or self._at is None or self._solved is None:
            return False
        d = apart.values[EOP] - self._at.eop - self._solved.g[:6]
        covariance = apart.covariance[EOP, EOP] + self._solved.cofactor[:6, :6] * self._variance
        if self._moves:
            covariance = covariance + np.linalg.inv(self._bound)
        return float(d @ scaled_inverse(covariance) @ d) > _MOVED

    def _start(self, apart: Adjustment) -> Partials:
        """Linearise at an epoch; nothing but the priors is known of the common unknowns."""
        values = apart.values
        self._at = at = linearise(self._sensor, self._field, values[IOP], values[EOP])
        self._variance = max(apart.sigma0**2, 1e-6)
        self._solved = None
        self._bound = np.diag((at.A[..., EOP] ** 2).sum(axis=1).mean(axis=0)) / _LOOSE_PX**2
        self._H, self._h = self._empty(at)
        if self._offsets:
            variance = self._field.sigmas**2
            xx, yy = ((at.B[:, k] ** 2 * variance).sum(axis=1) + _TINY for k in (0, 1))
            xy = (at.B[:, 0] * at.B[:, 1] * variance).sum(axis=1)
            self._prior = np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None]
        return at

    def _empty(self, at: Partials) -> tuple[Array, Array]:
        """Normal equations of the common unknowns from their priors alone."""
        q = (6 if self._still else 0) + (2 * len(self._field) if self._offsets else 0)
        H, h = np.zeros((q, q)), np.zeros(q)
        for k, i in enumerate(EOP_COLUMNS if self._still else ()):
            if (known := self._settings.priors.get(PARAMETER_NAMES[i])) is not None:
                H[k, k] = 1.0 / known[1] ** 2
                h[k] = (known[0] - at.eop[k]) / known[1] ** 2
        return H, h

    def _reduce(self, at: Partials, weights: Array, points: Array, own: Array) -> _Reduced:
        """Normal equations at the epoch's own parameters and the linearisation's common ones."""
        r = points - project(self._sensor, own[IOP], own[EOP], self._field.points)
        r[weights[:, 0] == 0] = 0.0
        A, E = at.A[:, :, self._own], at.A[:, :, EOP_COLUMNS]
        PA, Pr = _weighted(weights, A), _weighted(weights, r[:, :, None])[:, :, 0]
        N, n = np.einsum("tik,til->kl", A, PA), np.einsum("tik,ti->k", A, Pr)
        bound = np.zeros_like(N)
        if self._moves:
            # The mount's movement is drawn to zero by its variance.
            bound[-6:, -6:] = self._bound * self._variance
            n[-6:] -= bound[-6:, -6:] @ (own[EOP] - at.eop)
        N += bound
        for k, i in enumerate(self._own):
            if i >= EOP.start and self._still:
                continue  # known is the common one
            if (known := self._settings.priors.get(PARAMETER_NAMES[i])) is not None:
                N[k, k] += 1.0 / known[1] ** 2
                n[k] += (known[0] - own[i]) / known[1] ** 2
        Q = scaled_inverse(N)
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
        used = len(N) - float(np.einsum("pq,qp->", Q, bound))
        lPl = float((Pr * r).sum() - n @ Qn)
        return _Reduced(Q, QC, Qn, S - C.T @ QC, s - C.T @ Qn, lPl, used)

    def _solve(self, H: Array, h: Array, epochs: int | None = None) -> None:
        """Estimate and cofactors; the prior is weighted against image points, and added to H."""
        used = float(len(H))
        first = 6 if self._still else 0
        if self._offsets:
            prior = np.zeros_like(H[first:, first:])
            _add_blocks(prior, self._variance * self._prior)
            H = H.copy()
            H[first:, first:] += prior
        cofactor = scaled_inverse(H)
        if self._offsets:
            used -= float(np.einsum("pq,qp->", cofactor[first:, first:], prior))
        self._solved = _Solved(epochs or self.epochs + 1, cofactor @ h, cofactor, used)

    def _result(
        self, apart: Adjustment, own: Array, solved: _Solved, one: _Reduced, variance: float
    ) -> Adjustment:
        covariance = np.zeros((16, 16))
        covariance[np.ix_(self._own, self._own)] = one.Q
        sensitivity = np.zeros((16, len(solved.g)))
        sensitivity[self._own] = -one.QC
        if self._still:
            own[EOP] += solved.g[:6]
            sensitivity[EOP_COLUMNS, np.arange(6)] += 1.0
        covariance += sensitivity @ solved.cofactor @ sensitivity.T
        factor = self._variance if self._settings.scale == "posterior" else 1.0
        return replace(
            apart,
            interior=InteriorOrientation.from_array(own[IOP]),
            exterior=ExteriorOrientation.from_array(own[EOP]),
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
