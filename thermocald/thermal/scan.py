"""What a candidate would add to a hypothesis, what the hypothesis leaves, and what curvature does.

The scan: how much χ² each trial value of a candidate would explain beyond a hypothesis.

A scan over a candidate's whole grid costs one matrix product on the epochs' normal equations.

The absolute test: does a model leave smooth trajectories in any parameter?

An improvement is not honesty: a flexible surrogate improves M1 and even M2. What tells it from the
cause is what it leaves. Cosines of growing order are offered to every independent combination of
the camera's parameters, under the same covariance as the fit, in each series by itself.

Source: the smooth goodness-of-fit test of Neyman (1937), Skandinavisk Aktuarietidskrift 20,
149-199, in the parameters of the camera.

The second linearisation: what the image does beyond first order.

A drift of several pixels leaves some thousandths of a pixel to the curvature of the projection,
which is more than a discovery has to see. The trajectories found so far say how much, epoch by
epoch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.linalg import (
    eliminate,
    explained,
    orthonormal_combinations,
    scaled_solve,
)
from thermocald.thermal import criteria
from thermocald.thermal.hypothesis import BASE, Candidate, Fit
from thermocald.thermal.series import ReducedSeries, solve, unit_directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Term
    from thermocald.thermal.likelihood import Weighting


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
        self._stacks: dict[tuple[Candidate, int], Array] = like._stacks if like else {}

    def stack(self, candidate: Candidate, series: int, fit: Fit) -> Array:
        """Return trajectories (G, E, m) of a candidate over its grid in one series."""
        fitter = self.fitter
        drives = [t for t in fit.terms if t.is_drive]
        chained = candidate.kind.is_drive and bool(drives)
        key = (candidate, series)
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
        return stack

    def scan(self, candidate: Candidate, fit: Fit) -> Scan:
        """Try one candidate over its grid beside a fitted hypothesis."""
        every = range(len(self.fitter.series))
        stacks = tuple(self.stack(candidate, s, fit) for s in every)
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
        if candidate.kind.is_event:
            events = tuple(np.where(np.isfinite(g), g, 0.0) for g in gains)
            return Scan(np.zeros(0), events, count, stacks, tuple(parts))
        count *= 2 * len(gains) if candidate.kind.is_periodic else 1
        return Scan(np.sum(gains, axis=0), (), count, stacks, tuple(parts))

    def trials(self, candidate: Candidate) -> float:
        """Count the independent trajectories of the grid: its length in angles over 90°."""
        stack = self._stacks.get((candidate, 0))
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
    """Return the χ² (G, n) that a candidate explains beyond a base, for n sets of data at once.

    parts: of each series A (G, k, k), c (G, k, n) of the candidate, B (G, k, K) alongside the
    base's unknowns, whose normal equations are base_A (K, K), base_c (K, n). A list with one
    element, or with one for each series where every series has coefficients of its own.
    """
    change: Array | float = 0.0
    if candidate.kind.is_drive:  # it takes the place of T: the base's own rates leave
        whole, rest = explained(base_A, base_c, _RIDGE), slice(len(BASE), None)
        base_A, base_c = base_A[rest, rest], base_c[rest]
        parts = [(A, c, B[..., rest]) for A, c, B in parts]
        change = explained(base_A, base_c, _RIDGE) - whole
    by_series = candidate.kind.is_event or candidate.kind.is_periodic
    sets = [[p] for p in parts] if by_series else [parts]
    return [_sum_gains(some, base_A, base_c) + change for some in sets]


def normals_beside(
    fit: Fit,
    further: Sequence[tuple[Array, Array, Index] | None],
    size: int,
    weightings: Sequence[Weighting] | None = None,
    leave: frozenset[int] = frozenset(),
) -> tuple[Array, Array]:
    """Return normal equations A (size, size), c (size,) of further trajectories beside a fit's.

    The fit's own coefficients are eliminated. further: of each series trajectories (E, R),
    directions (P, R) and places (R,) among the unknowns, or None; weightings: other covariances
    than the fit's; leave: terms of the fit (-1: the base's rates) that are left out.
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
    """Return normal equations A (k, k), c (k,) of a term's trajectory in some columns.

    The fit's own coefficients are eliminated, as `normals_beside` does.
    """
    k = len(names)
    further: list[tuple[Array, Array, Index] | None] = []
    for s in range(len(fit.weightings)):
        if term.values(s) is None:
            further.append(None)
            continue
        if term.is_drive:
            trajectory = fitter.drive(fit.terms, s)[0]
        else:
            trajectory = fitter.trajectories(term, s, fit.terms, operators=False)[0][:, 0]
        centred = (trajectory - trajectory.mean())[:, None]
        further.append((np.tile(centred, k), unit_directions(names), np.arange(k)))
    return normals_beside(fit, further, k, weightings, leave)


def _sum_gains(parts: Sequence[tuple[Array, Array, Array]], base_A: Array, base_c: Array) -> Array:
    """Sum the parts, eliminate the base: χ² (G, n), -inf where a trajectory is next to nothing."""
    A, c, B = (np.asarray(sum(p[i] for p in parts)) for i in range(3))
    K, n = base_c.shape
    if K:
        X = scaled_solve(base_A, np.column_stack([base_c, B.reshape(-1, K).T]), _RIDGE)
        A = A - np.einsum("gir,rgj->gij", B, X[:, n:].reshape(K, *c.shape[:2]))
        c = c - B @ X[:, :n]
    weak = np.einsum("gii->gi", A).min(axis=1) < _FAINT
    return np.where(weak[:, None], -np.inf, explained(A, c, 1e-9))


_RIDGE = 1e-12  # of a unit diagonal
_FAINT = 1e-6  # χ² of a trajectory of unit size below which it is taken for none

ORDERS = 14


@dataclass(frozen=True, eq=False)
class Adequacy:
    """What a model leaves in one series.

    scores (ORDERS, D): unit normal where nothing is left; amplitudes (ORDERS, P): of the
    trajectories in px-scaled columns, which take the rest up; directions (P, D): combinations of
    px-scaled columns; excess: χ² beyond its expectation; significance: in standard deviations;
    misfit_px: RMS over image coordinates of the smooth rest.
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
    def adequate(self) -> bool:
        """Nothing significant is left, or nothing that matters."""
        return self.significance < criteria.SIGNIFICANT or self.misfit_px < criteria.NEGLIGIBLE_PX


def cosines(times: Array, orders: int) -> Array:
    """Smooth trajectories (orders, E) over a series, order 1 being half a wave."""
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    rows: Array = np.cos(np.pi * np.arange(1, orders + 1)[:, None] * u[None])
    rows -= rows.mean(axis=1, keepdims=True)
    return rows


def examine_all(fitter: HypothesisFitter, fit: Fit) -> tuple[Adequacy, ...]:
    """Test each series."""
    return tuple(examine(fitter, fit, s) for s in range(len(fitter.series)))


def examine(fitter: HypothesisFitter, fit: Fit, series: int) -> Adequacy:
    """Test one series; a short one for fewer orders than ORDERS."""
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
        # whitened, so that directions that share the thermometer's error count once
        L = np.linalg.cholesky(A[j] + 1e-9 * np.eye(len(A[j])) * np.trace(A[j]) / len(A[j]))
        scores[j] = np.linalg.solve(L, rest[j])
        amplitudes[j] = directions @ np.linalg.solve(L.T, scores[j])
    total = float(np.sum(scores**2))
    free = scores.size
    excess = max(total - free, 0.0)
    coordinates = 2.0 * float(evidence.n.sum())
    return Adequacy(
        scores,
        amplitudes,
        directions,
        trajectories,
        excess,
        (total - free) / np.sqrt(2.0 * free),
        evidence.sigma_px * float(np.sqrt(excess * evidence.correlation / coordinates)),
    )


_WORTH_PX = 0.0005


def remove_curvature(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """Take the curvature off all series; None where it matters in none."""
    out = [relinearise(fitter, fit, s) for s in range(len(fitter.series))]
    if all(e is None for e in out):
        return None
    return [e or old for e, old in zip(out, fitter.series, strict=True)]


def relinearise(
    fitter: HypothesisFitter, fit: Fit, series: int, beyond: Array | None = None
) -> ReducedSeries | None:
    """Take the curvature off the observations of one series; None where it does not matter.

    What was taken off before is taken into account. beyond (E, P): trajectories that the hypothesis
    leaves, px-scaled.
    """
    e = fitter.series[series]
    if e.blocks is not None:
        return None
    bend = _compute_bend(fitter, fit, series, beyond)
    change = bend if e.bend is None else bend - e.bend
    if float(np.sqrt(np.mean(change**2))) < _WORTH_PX:
        return None
    weights = e.weights / e.correlation
    b = e.b - np.einsum("eti,tik->ek", weights[..., :2] * change, e.columns)
    values = solve(e.N, b)
    return replace(
        e,
        b=b,
        values=values,
        yy=np.einsum("ek,ek->e", values, b),
        hidden=e.hidden.less(change) if e.hidden else None,
        bend=bend,
    )


def _compute_bend(fitter: HypothesisFitter, fit: Fit, series: int, beyond: Array | None) -> Array:
    """Return what the image (E, T, 2) px of a series does beyond first order, but for its mean."""
    e = fitter.series[series]
    moved = fit.parameters(series) + (0.0 if beyond is None else beyond)
    rest = np.einsum("epq,eq->p", e.N, e.values - moved)
    # levels along combinations that the field cannot determine stay where they were
    level = np.linalg.lstsq(e.N.sum(axis=0), rest, rcond=1e-6)[0]
    step = moved + level
    parameters = step / e.scale
    points = e.source.field.points * (1.0 + parameters[:, None, 16:])
    seen = project(e.source.sensor, e.orientations(parameters),
                   e.at.eop + parameters[:, 10:16], points)  # fmt: skip
    straight = e.at.predicted + np.einsum("tik,ek->eti", e.columns, step)
    there = e.weights[..., :1] > 0
    bend = np.where(there, np.nan_to_num(seen - straight), 0.0)
    total = np.maximum(there.sum(axis=0), 1)
    out: Array = np.where(there, bend - bend.sum(axis=0) / total, 0.0)
    return out
