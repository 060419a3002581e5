"""A proposal: a formula that takes the place of a name, where the data allow one.

Searched on both series together under the likelihood of the catalogue, it has to pass what a
name has to pass, and more: surrogates whose cause was not recorded reach its share of the misfit
in less than one of a hundred, and constants from either series alone close the gap of the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.grammar.condensed import condensed
from thermocald.discovery.grammar.search import FormulaSearch
from thermocald.discovery.search.search import MARGIN, Solution
from thermocald.discovery.search.surrogates import SurrogateTest
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.reduction.adequacy import examine
from thermocald.reduction.curvature import relinearised
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.hypothesis import BASE, Term
from thermocald.reduction.series import COLUMNS
from thermocald.simulation.formula.expression import parse

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array
    from thermocald.discovery.grammar.search import Found
    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Proposal", "propose"]

_FITTED = 8  # formulas of a pass that are fitted in full
_REFINED = 2  # of them with exact constants
_MATTERS = 0.01  # of the misfit that one more parameter has to explain
_TURNS = 3
_SECOND = 0.02  # share of the base's misfit that one formula leaves and a second is asked for
_COUNT = 199
_SEED = 16
# of the base's misfit on the other series that constants of one alone have to explain: of M2 by M1,
# and the other way round, where M2 may hold less than M1
_CLOSED, _CLOSED_BACK, _CLOSED_ALONE = 0.8, 0.5, 0.95


@dataclass(frozen=True, eq=False)
class Proposal:
    """What was found.

    fitter: the series it was found on; base, best: solutions in it; closed: share of the misfit of
    M2 that constants of M1 explain, and of M1 by constants of M2; surrogates: shares of
    surrogates; rivals: other formulas, as simple, and by how much they score worse.
    """

    fitter: HypothesisFitter
    base: Solution
    best: Solution
    closed: tuple[float, float]
    surrogates: SurrogateTest
    rivals: tuple[tuple[Term, float], ...]

    @property
    def terms(self) -> tuple[Term, ...]:
        """The formulas, without what the base model has already."""
        return self.best.terms[len(self.base.terms) :]


def propose(
    x: Examination, parameters: Sequence[str], progress: Callable[[str], None] | None = None
) -> Proposal | None:
    """A formula for what an examination leaves without a name; None where the data allow none.

    parameters: columns in which the image moves. One series alone allows none.
    """
    # what moves the image little may still be seen well
    moving = [p for p in PARAMETER_NAMES if p in {*parameters, *BASE}]
    if len(x.fitter.series) < 2:
        return None
    (progress or (lambda _: None))("beyond the catalogue")
    fitter, base = _straightened(x)
    search = FormulaSearch(condensed(fitter, base.fit, moving), MARGIN)
    test = _surrogate_test(search)
    if not test.passed:
        return None
    tried: dict[str, Solution] = {}
    best = base
    for turn in range(_TURNS):
        before = best
        if turn:
            here = condensed(fitter, base.fit, moving, best.fit.weightings)
            search = FormulaSearch(here, MARGIN, search)
        _try(fitter, base, moving, search.best(further=turn > 0), tried)
        best = min([base, *tried.values()], key=lambda s: s.score)
        if best.score > before.score - MARGIN or _adequate(fitter, best.fit):
            break
    if best is base:
        return None
    best = _parameters_chosen(fitter, base, _simplified(fitter, base, best))
    closed = _closed(fitter, base, best)
    if closed is None or not _transferable(closed):
        return None
    size = _operators(best.terms[-1])
    rivals = sorted(
        ((s.terms[-1], float(s.score - best.score)) for s in tried.values()
         if s.terms[-1].effect != best.terms[-1].effect and _operators(s.terms[-1]) <= size),
        key=lambda r: r[1],
    )  # fmt: skip
    return Proposal(fitter, base, best, closed, test, tuple(rivals))


def _straightened(x: Examination) -> tuple[HypothesisFitter, Solution]:
    """The series without the curvature of the projection along everything that moves, and the base
    model in them.
    """
    series: list[ReducedSeries] = []
    for s, (e, a) in enumerate(zip(x.fitter.series, x.base_adequacy, strict=True)):
        bridge = a.trajectories.T @ a.amplitudes
        series.append(relinearised(x.fitter, x.base.fit, s, bridge) or e)
    fitter = HypothesisFitter(series)
    return fitter, replace(x.base, fit=fitter.fit(x.base.terms, x.base.fit.coefficients))


def _surrogate_test(search: FormulaSearch) -> SurrogateTest:
    own, shares = search.surrogates(_COUNT, np.random.default_rng(_SEED))
    return SurrogateTest(own, shares)


def _try(
    fitter: HypothesisFitter,
    base: Solution,
    parameters: Sequence[str],
    formulas: Sequence[Found],
    tried: dict[str, Solution],
) -> None:
    """Fit formulas in the full likelihood, those that are best then exactly."""
    here: dict[str, Solution] = {}
    for found in formulas[:_FITTED]:
        structure, values = found.node.named()
        term = Term(structure.text(), tuple(parameters), tuple(values.items()))
        penalty = found.penalty + MARGIN * _operators(term)
        fit = _fit(fitter, (*base.terms, term))
        if fit is not None:
            here[term.effect] = Solution(fit, (*base.penalties, penalty))
    for text, solution in sorted(here.items(), key=lambda h: h[1].score)[:_REFINED]:
        better = _fit(fitter, solution.terms, refined=True)
        here[text] = solution if better is None else replace(solution, fit=better)
    for text, solution in here.items():
        if text not in tried or solution.score < tried[text].score:
            tried[text] = solution


def _operators(term: Term) -> int:
    return sum(not n.is_leaf for n in parse(term.effect).walk())


def _fit(
    fitter: HypothesisFitter,
    terms: Sequence[Term],
    only: Sequence[int] | None = None,
    refined: bool = False,
) -> Fit | None:
    """A fit in the full likelihood; None where a formula is too steep for the readings' noise."""
    try:
        fit = fitter.fit(terms, only=only)
        fit = fitter.refine(fit, 4, only) if refined else fit
    except np.linalg.LinAlgError:
        return None
    return fit if np.isfinite(fit.objective) else None


def _adequate(fitter: HypothesisFitter, fit: Fit) -> bool:
    return all(examine(fitter, fit, s).adequate for s in range(len(fitter.series)))


def _nothing_left(fitter: HypothesisFitter, fit: Fit) -> bool:
    """Whether no smooth trajectory is significant any more, however small."""
    return all(examine(fitter, fit, s).significance < 6.0 for s in range(len(fitter.series)))


def _simplified(fitter: HypothesisFitter, base: Solution, best: Solution) -> Solution:
    """The same without operators that it does as well without, one after the other."""
    nothing_left = _nothing_left(fitter, best.fit)
    while True:
        term = best.terms[-1]
        node = parse(term.effect).bound(dict(term.nonlinear))
        found = []
        for simpler in node.simpler():
            structure, values = simpler.named()
            if not structure.inputs:
                continue
            own = Term(structure.text(), term.parameters, tuple(values.items()))
            fit = _fit(fitter, (*base.terms, own), refined=True)
            if fit is not None:
                solution = Solution(fit, (*base.penalties, best.penalties[-1] - MARGIN))
                if solution.score < best.score or (nothing_left and _nothing_left(fitter, fit)):
                    found.append(solution)
        if not found:
            return best
        best = min(found, key=lambda s: s.score)


def _parameters_chosen(fitter: HypothesisFitter, base: Solution, best: Solution) -> Solution:
    """The same formula in the parameters that it is needed in, found one after the other."""
    term = best.terms[-1]
    A, c = _all_parameters(fitter, base, best, term)
    n = float(np.log(sum(int((e.n > 0).sum()) for e in fitter.series)))
    chosen = [PARAMETER_NAMES.index(p) for p in term.parameters]

    def gain(some: Sequence[int]) -> float:
        ix = np.ix_(list(some), list(some))
        d = np.sqrt(np.diag(A)[list(some)])
        own = A[ix] / np.outer(d, d) + 1e-9 * np.eye(len(d))
        right = c[list(some)] / d
        return float(right @ np.linalg.solve(own, right)) - n * len(some)

    while len(chosen) > 1:
        fewer = max(([j for j in chosen if j != i] for i in chosen), key=gain)
        if gain(fewer) < gain(chosen):
            break
        chosen = fewer
    least = max(MARGIN, _MATTERS * gain(chosen))
    while True:
        more = [[*chosen, j] for j in range(len(c)) if j not in chosen and A[j, j] > 1e-6]
        wider = max(more, key=gain, default=chosen)
        if gain(wider) < gain(chosen) + least:
            break
        chosen = wider
    names = tuple(PARAMETER_NAMES[i] for i in sorted(chosen))
    if names == term.parameters:
        return best
    terms = (*best.terms[:-1], replace(term, parameters=names))
    fit = _fit(fitter, terms, refined=True)
    if fit is None:
        return best
    change = n * (len(names) - len(term.parameters))
    return Solution(fit, (*best.penalties[:-1], best.penalties[-1] + change))


def _all_parameters(
    fitter: HypothesisFitter, base: Solution, best: Solution, term: Term
) -> tuple[Array, Array]:
    """Normal equations A (16, 16), c (16,) of a trajectory in each parameter of the camera, beside
    the base model.
    """
    count, K = len(PARAMETER_NAMES), len(base.fit.coefficients)
    directions = np.eye(len(COLUMNS))[:, :count]
    A, c, B = np.zeros((count, count)), np.zeros(count), np.zeros((count, K))
    own, right = np.zeros((K, K)), np.zeros(K)
    for s in range(len(fitter.series)):
        C, V, index = base.fit.designs[s]
        trajectory = fitter.trajectories(term, s, operators=False)[0]
        w = best.fit.weightings[s]
        a, b, cross = w.scan((trajectory - trajectory.mean())[None], directions, (C, V))
        A, c = A + a[0], c + b[0]
        B[:, index] += cross[0]
        reduced = w.reduce(C, V)
        own[np.ix_(index, index)] += reduced.A
        right[index] += reduced.c
    X = np.linalg.solve(own, np.column_stack([right, B.T]))
    return A - B @ X[:, 1:], c - B @ X[:, 0]


def _transferable(closed: tuple[float, float]) -> bool:
    by_m1, by_m2 = closed
    if np.isnan(by_m2):  # M2 says too little to be held against M1
        return by_m1 > _CLOSED_ALONE
    return by_m1 > _CLOSED and by_m2 > _CLOSED_BACK


def _closed(fitter: HypothesisFitter, base: Solution, best: Solution) -> tuple[float, float] | None:
    """Share of the misfit of M2 that constants of M1 alone explain, and the other way round, NaN
    where M2 alone does not determine them; None where M1 does not.
    """
    shares = []
    for here, there in ((0, 1), (1, 0)):
        without = fitter.fit(base.terms, only=[here])
        whole = _fit(fitter, best.terms, [here], refined=True)
        if whole is None:
            if here == 0:
                return None
            shares.append(float("nan"))
            continue
        left, before = (_misfit_px(fitter, f, there) for f in (whole, without))
        shares.append(1.0 - (left / max(before, 1e-9)) ** 2)
    return shares[0], shares[1]


def _misfit_px(fitter: HypothesisFitter, fit: Fit, series: int) -> float:
    """RMS px that constants leave in one series, beyond the noise of its free cameras."""
    e = fitter.series[series]
    C, V, index = fit.designs[series]
    r = e.values - (C * fit.coefficients[index]) @ V.T
    level = np.linalg.lstsq(e.N.sum(axis=0), np.einsum("epq,eq->p", e.N, r), rcond=1e-12)[0]
    r = r - level
    chi2 = float(np.einsum("ep,epq,eq->", r, e.N, r)) - e.rank * float((e.n > 0).sum() - 1)
    coordinates = 2.0 * float(e.n.sum())
    return e.sigma_px * float(np.sqrt(max(chi2, 0.0) * e.correlation / coordinates))
