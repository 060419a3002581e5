"""The gap between simulation and measurement, as CONVENTIONS §4 defines it.

rms_px: image points, measured minus simulated. chi2_reduced: the same over its noise, which is that
of the image and that of the thermometers propagated to the prediction; 1 is the floor.
object_mm_at_10m: rms_px on a plane at 10 m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd, scaled_solve
from thermocald.thermal.scan import examine

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.discovery.evidence import Displaced
    from thermocald.discovery.examination import Examination
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.scan import Adequacy
    from thermocald.thermal.series import ReducedSeries


_DISTANCE_MM = 10_000.0


@dataclass(frozen=True)
class Gap:
    """A gap, G of CONVENTIONS §4.

    floor: of chi2_reduced, from the measurement's residuals about its own cameras.
    """

    JSON: ClassVar = {"floor": ""}

    rms_px: float
    chi2_reduced: float
    object_mm_at_10m: float
    floor: float = 1.0


def fit_first(fitter: HypothesisFitter, terms: Sequence[Term]) -> Fit:
    """Fit a hypothesis to the first series alone and apply its constants to the others.

    What each series has separately is estimated again: an oscillation's phase, a slip's time and
    size.
    """
    fit = fitter.refine(fitter.fit(terms, only=[0]), only=[0])
    x = fit.coefficients.copy()
    for block in fit.blocks:
        if not block.series:
            continue
        _, _, index = fit.designs[block.series]
        whole, c, _ = fit.reduced[block.series]
        inside = (index >= block.start) & (index < block.stop)
        A = whole[np.ix_(inside, inside)]
        right = c[inside] - whole[np.ix_(inside, ~inside)] @ x[index[~inside]]
        own = index[inside]
        if block.term >= 0 and fit.terms[block.term].kind.is_periodic:
            model = next(b for b in fit.blocks if b.term == block.term and b.series == 0)
            pair = x[model.start : model.stop].reshape(2, -1)
            _, s, v = np.linalg.svd(pair, full_matrices=False)
            angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
            sides = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            trial = np.kron(sides, s[0] * v[0])
            cost = np.einsum("ai,ij,aj->a", trial, A, trial) - 2 * trial @ right
            x[own] = trial[int(np.argmin(cost))]
        else:
            x[own] = scaled_solve(A, right, 1e-9)
    return replace(fit, coefficients=x)


def image_chi2(
    evidence: ReducedSeries, fit: Fit, series: int, beyond: Array | float = 0.0
) -> float:
    """Return χ² of a series' misfit in the image, with the level estimated again.

    beyond (E, P): movement in addition to the fit, px-scaled.
    """
    return float(evidence.squares(evidence.values - fit.parameters(series) - beyond).sum())


@dataclass(frozen=True, eq=False)
class Stage:
    """A step of the discovery: the effect added, and the gap after it in each series, M1 first."""

    added: str
    gaps: tuple[Gap, ...]

    @property
    def fit(self) -> Gap:
        """The gap in M1."""
        return self.gaps[0]

    @property
    def verify(self) -> Gap | None:
        """The gap in M2, None if there is no M2."""
        return self.gaps[1] if len(self.gaps) > 1 else None


def measure_stage(x: Examination, added: str, fit: Fit, known: int) -> Stage:
    """Measure the gaps at a fit, with the first `known` effects of image space in the model."""
    every = range(len(x.fitter.series))
    return Stage(added, tuple(measure_gap(x, fit, s, known) for s in every))


def measure_gap(
    x: Examination, fit: Fit, series: int, known: int, bridge: Adequacy | None = None
) -> Gap:
    """Measure the gap of one series at a fit.

    known: number of effects of image space in the model; bridge: a misfit that a smooth term
    bridges beside the model.
    """
    e, in_model = x.fitter.series[series], x.image_places[:known]
    residuals = np.nan_to_num(e.residuals)
    within = float(np.sum(e.weights[..., :2] * residuals**2))
    coordinates = 2.0 * float(e.n.sum())
    targets = float((e.n.sum() > 0) * np.sum(e.weights[..., 0].any(axis=0)))
    # changes of a camera within a block of a long series are not compared
    unused = e.blocks.within_free if e.blocks is not None else 0.0
    free = max(coordinates - 2.0 * targets - e.rank - unused, 1.0)
    # the weights include correlated noise; the floor is that of single epochs
    k = e.correlation
    excess, beyond = (bridge.excess, bridge.movement) if bridge else (0.0, 0.0)
    total = within + k * max(fit.chi2_of(series) - excess, 0.0)
    image = within + k * image_chi2(e, fit, series, beyond)
    whole = e if e.blocks is None else x.unblocked[series]
    moved, count = _measure_moved(whole, x.displaced[series], "targets" in in_model)
    total, image, free = total + moved, image + moved, free + count
    chi2 = total / free
    if x.noise_growth and "noise" in x.image_places[known:]:
        noise = x.noise_growth.noise[series]
        chi2 *= float(np.mean(noise**2)) / float(np.min(noise) ** 2)
    rms = e.sigma_px * float(np.sqrt(image / free))
    floor = 1.0
    if e.movement is not None:
        # the camera's own noise in this series, which no smooth trajectory explains
        floor = chi2 - k * examine(x.fitter, fit, series).excess / free
    mm = rms * e.source.sensor.pixel_pitch / float(e.at.iop[0]) * _DISTANCE_MM
    return Gap(rms, chi2, mm, floor)


def _measure_moved(
    evidence: ReducedSeries, displaced: Sequence[Displaced], known: bool
) -> tuple[float, float]:
    """Return displaced targets' χ² about the others' camera, and its degrees of freedom.

    known: whether their displacement is in the model.
    """
    total = count = 0.0
    w = evidence.weights[..., 0]
    weight = float(np.mean(w[w > 0]))
    for group in displaced:
        v = evidence.left_by_cameras(group.rows)
        after = evidence.times >= group.time
        if known:
            v = np.where(after[:, None, None], v - group.steps, v)
        middle = np.nanmedian(v, axis=0)
        v = v - middle
        spread = mad_sd(v, axis=0)
        inside = np.abs(v) < np.maximum(8.0 * spread, 1e-9)
        inside &= (evidence.n > 0)[:, None, None]
        total += weight * float(np.sum(np.where(inside, v, 0.0) ** 2))
        count += float(np.sum(inside))
    return total, count
