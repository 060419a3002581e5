"""The scan of candidates beside a hypothesis, the absolute test of a model, and curvature.

A scan returns the χ² that each trial value of a candidate would explain in addition to a
hypothesis. Over a candidate's whole grid it takes one matrix product with the epochs' normal
equations.

The absolute test is whether a model leaves smooth trajectories in any parameter. An improvement is
no proof: a flexible surrogate improves the fit of one series and even the prediction of another,
but unlike the cause it leaves a misfit. Cosines of growing order are fitted to every independent
combination of the camera's parameters, with the covariance of the fit, in each series separately.

Source: the smooth goodness-of-fit test of Neyman (1937), Skandinavisk Aktuarietidskrift 20,
149-199, in the parameters of the camera.

The second linearisation accounts for the image's movement beyond first order. With a drift of
several pixels, the curvature of the projection amounts to some thousandths of a pixel, which is
more than the misfit that a discovery has to detect. It is computed, epoch by epoch, from the
trajectories estimated so far.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.linalg import (
    eliminate,
    explained,
    orthonormal_combinations,
    scaled_solve,
)
from thermocald.physics import catalogue
from thermocald.physics.model import follow_angle
from thermocald.thermal import criteria
from thermocald.thermal.hypothesis import BASE, Candidate, Fit, Term, make_candidate
from thermocald.thermal.series import ReducedSeries, cosines, solve, unit_directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index
    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.likelihood import Weighting


@dataclass(frozen=True, eq=False)
class Scan:
    """The result of a scan.

    gains [(G,)]: χ² that each trial value explains, in each series if every series has its own
    coefficients, else in all together; coefficients: their number; stacks, parts: of each series
    the trajectories (G, E, m), and A (G, mk, mk), c (G, mk), B (G, mk, K) beside the whole
    hypothesis. The trial values of an event are the epochs but the first.
    """

    gains: tuple[Array, ...]
    coefficients: int
    stacks: tuple[Array, ...]
    parts: tuple[tuple[Array, Array, Array], ...]

    @property
    def best(self) -> int:
        """The index of the best trial value in all series together."""
        return int(np.argmax(np.sum(self.gains, axis=0)))


def lay_stack(fitter: HypothesisFitter, candidate: Candidate, series: int, fit: Fit) -> Array:
    """Return a candidate's trajectories (G, E, m) over its grid in a series."""
    drives = [t for t in fit.terms if t.kind.is_drive]
    chained = candidate.kind.is_drive and bool(drives)
    key = (candidate, series)
    if key in fitter.stacks and not chained:
        return fitter.stacks[key]
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
        fitter.stacks[key] = stack
    return stack


def scan_candidate(fitter: HypothesisFitter, candidate: Candidate, fit: Fit) -> Scan:
    """Scan a candidate over its grid beside a fitted hypothesis."""
    every = range(len(fitter.series))
    stacks = tuple(lay_stack(fitter, candidate, s, fit) for s in every)
    parts = []
    for s in every:
        C, V, index = fit.designs[s]
        A, c, B = fit.weightings[s].scan(stacks[s], candidate.directions, (C, V))
        full = np.zeros((*c.shape, len(fit.coefficients)))
        full[..., index] = B
        parts.append((A, c, full))
    base_A, base_c = fit.normals()
    columns = [(A, c[..., None], B) for A, c, B in parts]
    gains = [g[:, 0] for g in gains_beside(candidate, columns, base_A, base_c[:, None])]
    count = 0 if candidate.kind.is_drive else len(candidate.parameters)
    count *= 2 * len(gains) if candidate.kind.is_periodic else 1
    return Scan(tuple(gains), count, stacks, tuple(parts))


def count_trials(fitter: HypothesisFitter, candidate: Candidate) -> float:
    """Return the number of independent trajectories of a grid: its length in angles / 90°."""
    stack = fitter.stacks.get((candidate, 0))
    if stack is None or len(stack) < 2:
        return max(float(len(candidate.grid)), 1.0)
    s = stack[..., 0]
    s = s - s.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(s, axis=1)
    cosine = np.sum(s[1:] * s[:-1], axis=1) / np.maximum(norm[1:] * norm[:-1], 1e-12)
    return 1.0 + float(np.sum(np.arccos(np.clip(np.abs(cosine), 0, 1)))) / (np.pi / 2)


def gains_beside(
    candidate: Candidate,
    parts: Sequence[tuple[Array, Array, Array]],
    base_A: Array,
    base_c: Array,
) -> list[Array]:
    """Return the χ² (G, n) that a candidate explains beside a base, for n sets of data at once.

    parts: of each series A (G, k, k), c (G, k, n) of the candidate, B (G, k, K) with the base's
    unknowns, whose normal equations are base_A (K, K), base_c (K, n). The list has one element, or
    one for each series if every series has its own coefficients. -inf is for negligible
    trajectories.
    """
    change: Array | float = 0.0
    if candidate.kind.is_drive:  # it replaces T: the base's own rates are dropped
        whole, rest = explained(base_A, base_c, _RIDGE), slice(len(BASE), None)
        base_A, base_c = base_A[rest, rest], base_c[rest]
        parts = [(A, c, B[..., rest]) for A, c, B in parts]
        change = explained(base_A, base_c, _RIDGE) - whole
    by_series = candidate.kind.is_event or candidate.kind.is_periodic
    K, n = base_c.shape
    out = []
    for some in [[p] for p in parts] if by_series else [parts]:
        A, c, B = (np.asarray(sum(p[i] for p in some)) for i in range(3))
        if K:  # the base is eliminated
            right = np.column_stack([base_c, B.reshape(-1, K).T])
            X = scaled_solve(base_A, right, _RIDGE)
            A = A - np.einsum("gir,rgj->gij", B, X[:, n:].reshape(K, *c.shape[:2]))
            c = c - B @ X[:, :n]
        weak = np.einsum("gii->gi", A).min(axis=1) < _FAINT
        out.append(np.where(weak[:, None], -np.inf, explained(A, c, 1e-9)) + change)
    return out


def normals_beside(
    fit: Fit,
    further: Sequence[tuple[Array, Array, Index] | None],
    size: int,
    weightings: Sequence[Weighting] | None = None,
    leave: frozenset[int] = frozenset(),
) -> tuple[Array, Array]:
    """Return normal equations A (size, size), c (size,) of further trajectories beside a fit.

    The fit's own coefficients are eliminated. further: of each series trajectories (E, R),
    directions (P, R) and indices (R,) of the unknowns, or None; weightings: if not the fit's own;
    leave: terms of the fit (-1: the base's rates) to be left out.
    """
    A = np.zeros((size + len(fit.coefficients),) * 2)
    c = np.zeros(len(A))
    left_out = [range(b.start, b.stop) for b in fit.blocks if b.term in leave]
    for s, part in enumerate(further):
        if part is None:
            continue
        C, V, index = fit.designs[s]
        kept = np.array([not any(i in r for r in left_out) for i in index], dtype=bool)
        own, right, _ = (weightings or fit.weightings)[s].reduce(
            np.hstack([part[0], C[:, kept]]), np.hstack([part[1], V[:, kept]])
        )
        at = np.concatenate([part[2], size + index[kept]])
        A[np.ix_(at, at)] += own
        c[at] += right
    return eliminate(A, c, size)


def normals_of_term(
    fitter: HypothesisFitter,
    fit: Fit,
    term: Term,
    names: Sequence[str],
    weightings: Sequence[Weighting] | None = None,
    leave: frozenset[int] = frozenset(),
) -> tuple[Array, Array]:
    """Return normal equations A (k, k), c (k,) of a term's trajectory in the named columns.

    The fit's own coefficients are eliminated, as in `normals_beside`.
    """
    k = len(names)
    further: list[tuple[Array, Array, Index] | None] = []
    for s in range(len(fit.weightings)):
        if term.values(s) is None:
            further.append(None)
            continue
        if term.kind.is_drive:
            trajectory = fitter.drive(fit.terms, s)[0]
        else:
            trajectory = fitter.trajectories(term, s, fit.terms, operators=False)[0][:, 0]
        centred = (trajectory - trajectory.mean())[:, None]
        further.append((np.tile(centred, k), unit_directions(names), np.arange(k)))
    return normals_beside(fit, further, k, weightings, leave)


_MARGIN = 16.0  # χ² that an event has to explain beyond what a search finds by chance


def event_threshold(series: ReducedSeries, coefficients: int) -> float:
    """Return the χ² that an event has to explain, given its coefficients and the times tried."""
    n = max(int((series.n > 0).sum()), 2)
    return float((coefficients + 2) * np.log(n) + _MARGIN)


def make_term(
    fitter: HypothesisFitter, terms: Sequence[Term], effect: ModelEffect, search: bool
) -> Term:
    """Return an effect as a term to add to a hypothesis, which is fitted only for a search.

    search: search the first of its non-linear parameters that is not in `fitter.held` over its
    whole range, if the recording shows that range; the time of an event is always searched, in each
    series.
    """
    kind = catalogue.get(effect.name)
    given = tuple(n for n in kind.linear if n in effect.values) or kind.usual
    names = BASE if kind.is_drive else given
    text = {k: effect.values[k] for k, p in kind.nonlinear.items() if p.text and k in effect.values}
    numbers = {
        k: float(effect.values[k])
        for k, p in kind.nonlinear.items()
        if k in effect.values and not p.text and k not in kind.fresh
    }
    held = {k: v for k, v in numbers.items() if f"{effect.name}.{k}" in fitter.held}
    candidate = make_candidate(kind, names, fitter.series, (*text.items(), *held.items()))
    if kind.is_event:
        found = scan_candidate(fitter, candidate, fitter.fit(terms))
        fresh: list[tuple[tuple[str, Any], ...] | None] = []
        for s, gains in enumerate(found.gains):
            best = int(np.argmax(gains))
            least = event_threshold(fitter.series[s], found.coefficients)
            time = float(fitter.series[s].times[best + 1])
            fresh.append(((candidate.name, time),) if gains[best] > least else None)
        return Term(effect.name, candidate.parameters, candidate.fixed, tuple(fresh))
    if search and candidate.name and (kind.nonlinear[candidate.name].role or not numbers):
        others = tuple((k, v) for k, v in numbers.items() if k != candidate.name and k not in held)
        candidate = replace(candidate, fixed=(*candidate.fixed, *others))
        found = scan_candidate(fitter, candidate, fitter.fit(terms))
        return candidate.term(float(candidate.grid[found.best]), len(fitter.series))
    return Term(effect.name, candidate.parameters, (*text.items(), *numbers.items()))


def without_chance_events(fitter: HypothesisFitter, fit: Fit) -> tuple[Term, ...]:
    """Return a fit's terms without events that explain no more than chance beside the others."""
    terms = list(fit.terms)
    for block in fit.blocks:
        if block.term < 0 or not terms[block.term].kind.is_event or block.series is None:
            continue
        place = slice(block.start, block.stop)
        heights, cofactor = fit.coefficients[place], fit.covariance[place, place]
        gain = float(heights @ np.linalg.solve(cofactor, heights))
        if gain <= event_threshold(fitter.series[block.series], len(heights)):
            fresh = list(terms[block.term].fresh)
            fresh[block.series] = None
            terms[block.term] = replace(terms[block.term], fresh=tuple(fresh))
    return tuple(terms)


_RIDGE = 1e-12  # of a unit diagonal
_FAINT = 1e-6  # χ² of a trajectory of unit size, below which it is negligible

ORDERS = 14


@dataclass(frozen=True, eq=False)
class Adequacy:
    """The absolute test of a model in a series.

    scores (ORDERS, D): standard normal for an adequate model; amplitudes (ORDERS, P): of the
    misfit's trajectories in px-scaled columns; directions (P, D): combinations of px-scaled
    columns; trajectories (ORDERS, E); excess: χ² beyond its expectation; significance: in standard
    deviations; misfit_px: RMS over image coordinates of the smooth misfit.
    """

    JSON: ClassVar = {
        "scores": "", "amplitudes": "", "directions": "", "trajectories": "", "excess": "",
        "significance": "sigmas",
    }  # fmt: skip

    scores: Array
    amplitudes: Array
    directions: Array
    trajectories: Array
    excess: float
    significance: float
    misfit_px: float

    @property
    def movement(self) -> Array:
        """The misfit as a movement (E, P) in px-scaled columns."""
        return np.asarray(self.trajectories.T @ self.amplitudes)

    @property
    def adequate(self) -> bool:
        """Whether the misfit is insignificant or negligible."""
        return self.significance < criteria.SIGNIFICANT or self.misfit_px < criteria.NEGLIGIBLE_PX


def examine_all(fitter: HypothesisFitter, fit: Fit) -> tuple[Adequacy, ...]:
    """Test a fit in each series."""
    return tuple(examine(fitter, fit, s) for s in range(len(fitter.series)))


def examine(fitter: HypothesisFitter, fit: Fit, series: int) -> Adequacy:
    """Test a fit in a series, with fewer orders than ORDERS if it is short."""
    evidence, weighting = fitter.series[series], fit.weightings[series]
    C, V, index = fit.designs[series]
    x = fit.coefficients[index]
    W, good = orthonormal_combinations(evidence.N.mean(axis=0), 1e-4)
    directions = W[:, good]
    orders = min(ORDERS, len(evidence.times) // 2)
    trajectories = cosines(evidence.times, orders)
    A, c, B = weighting.scan(trajectories[:, :, None], directions, (C, V))
    rest = c - B @ x
    scores = np.zeros(rest.shape)
    amplitudes = np.zeros((orders, len(directions)))
    for j in range(orders):
        # whitened, so that directions with the thermometer's error in common count once
        L = np.linalg.cholesky(A[j] + 1e-9 * np.eye(len(A[j])) * np.trace(A[j]) / len(A[j]))
        scores[j] = np.linalg.solve(L, rest[j])
        amplitudes[j] = directions @ np.linalg.solve(L.T, scores[j])
    total = float(np.sum(scores**2))
    free = scores.size
    excess = max(total - free, 0.0)
    coordinates = 2.0 * float(evidence.n.sum())
    misfit_px = evidence.sigma_px * float(np.sqrt(excess * evidence.correlation / coordinates))
    significance = (total - free) / np.sqrt(2.0 * free)
    return Adequacy(scores, amplitudes, directions, trajectories, excess, significance, misfit_px)


_WORTH_PX = 0.0005


def remove_curvature(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """Return the series without the projection's curvature; None if it matters in none."""
    return fitter.replaced([relinearise(fitter, fit, s) for s in range(len(fitter.series))])


def relinearise(
    fitter: HypothesisFitter, fit: Fit, series: int, beyond: Array | None = None
) -> ReducedSeries | None:
    """Return a series with the curvature subtracted from its observations; None if negligible.

    A curvature that was subtracted before is replaced. beyond (E, P): movement in addition to the
    hypothesis, px-scaled.
    """
    e = fitter.series[series]
    if e.blocks is not None:
        return None
    # the image's movement beyond first order, without its mean
    moved = fit.parameters(series) + (0.0 if beyond is None else beyond)
    rest = np.einsum("epq,eq->p", e.N, e.values - moved)
    # levels of combinations that the field cannot determine stay unchanged
    step = moved + np.linalg.lstsq(e.N.sum(axis=0), rest, rcond=1e-6)[0]
    parameters = step / e.scale
    points = e.source.field.points * (1.0 + parameters[:, None, 16:])
    linear = e.at.iop + parameters[:, :10]
    iop = follow_angle(linear, e.at.iop[0]) if e.distortion == "angle" else linear
    seen = project(e.source.sensor, iop, e.at.eop + parameters[:, 10:16], points)
    straight = e.at.predicted + np.einsum("tik,ek->eti", e.columns, step)
    there = e.weights[..., :1] > 0
    bend = np.where(there, np.nan_to_num(seen - straight), 0.0)
    bend = np.where(there, bend - bend.sum(axis=0) / np.maximum(there.sum(axis=0), 1), 0.0)
    change = bend if e.bend is None else bend - e.bend
    if float(np.sqrt(np.mean(change**2))) < _WORTH_PX:
        return None
    weights = e.weights / e.correlation
    b = e.b - np.einsum("eti,tik->ek", weights[..., :2] * change, e.columns)
    values = solve(e.N, b)
    return replace(
        e, b=b, values=values, yy=np.einsum("ek,ek->e", values, b),
        hidden=e.hidden.less(change) if e.hidden else None, bend=bend,
    )  # fmt: skip
