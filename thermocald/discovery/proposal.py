"""The proposal of a formula in place of a name, if the data allow one.

A formula is searched in both series together with the likelihood of the catalogue. It must pass the
tests of a name, and more: fewer than one in a hundred surrogates whose cause was not recorded reach
its share of the misfit, and constants from either series alone close the gap of the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.formulas import FormulaSearch, condense
from thermocald.discovery.gap import image_chi2
from thermocald.discovery.search import by_score
from thermocald.discovery.validation import SurrogateTest
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.linalg import explained
from thermocald.physics.formula import parse
from thermocald.thermal import criteria as noise_criteria
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term
from thermocald.thermal.scan import examine_all, normals_of_term, relinearise

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.discovery.examination import Examination
    from thermocald.discovery.formulas import Found
    from thermocald.discovery.search import Solution
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries


_FITTED = 8  # formulas per pass that are fitted in full
_REFINED = 2  # of these, with exact constants
_TURNS = 3
_SEED = 16


@dataclass(frozen=True, eq=False)
class Proposal:
    """A formula proposed.

    base, best: solutions without and with it, in the series where it was found; closed: share of
    M2's misfit that constants from M1 explain, and of M1's by M2's; surrogates: the test with the
    shares in surrogates; rivals: other formulas, as simple, and by how much they score worse.
    """

    base: Solution
    best: Solution
    closed: tuple[float, float]
    surrogates: SurrogateTest
    rivals: tuple[tuple[Term, float], ...]


def propose(
    x: Examination, parameters: Sequence[str], progress: Callable[[str], None] | None = None
) -> Proposal | None:
    """Find a formula for what an examination leaves unnamed; None if the data allow none.

    parameters: columns in which the image moves. A single series allows no formula.
    """
    # with the base's own, which may be well determined even if they move the image little
    moving = [p for p in PARAMETER_NAMES if p in {*parameters, *BASE}]
    if len(x.fitter.series) < 2:
        return None
    (progress or (lambda _: None))("looking for a formula beyond the catalogue")
    # without the projection's curvature along all movements
    series: list[ReducedSeries] = []
    for s, (e, a) in enumerate(zip(x.fitter.series, x.base_adequacy, strict=True)):
        series.append(relinearise(x.fitter, x.base.fit, s, a.movement) or e)
    fitter = HypothesisFitter(series)
    fit = fitter.fit(x.base.terms, x.base.fit.coefficients)
    base = replace(x.base, fit=fit, fitter=fitter)
    search = FormulaSearch(condense(fitter, base.fit, moving))
    test = SurrogateTest(
        *search.surrogates(criteria.FORMULA_SURROGATES, np.random.default_rng(_SEED))
    )
    if not test.passed:
        return None
    tried: dict[str, Solution] = {}
    best = base
    for turn in range(_TURNS):
        before = best
        if turn:
            here = condense(fitter, base.fit, moving, best.fit.weightings)
            search = FormulaSearch(here, search)
        _fit_formulas(base, moving, search.best(further=turn > 0), tried)
        best = min([base, *tried.values()], key=by_score)
        if best.score > before.score - criteria.MARGIN or all(
            a.adequate for a in examine_all(fitter, best.fit)
        ):
            break
    if best is base:
        return None
    best = _choose_parameters(base, _simplify(base, best))
    closed = _cross_check(base, best)
    if closed is None:
        return None
    by_m1, by_m2 = closed  # by_m2 is NaN if M2 does not determine the constants
    if not (
        by_m1 > criteria.CLOSED_ALONE
        if np.isnan(by_m2)
        else by_m1 > criteria.CLOSED and by_m2 > criteria.CLOSED_BACK
    ):
        return None
    size = parse(best.terms[-1].effect).size
    rivals = sorted(
        ((s.terms[-1], float(s.score - best.score)) for s in tried.values()
         if s.terms[-1].effect != best.terms[-1].effect and parse(s.terms[-1].effect).size <= size),
        key=lambda r: r[1],
    )  # fmt: skip
    return Proposal(base, best, closed, test, tuple(rivals))


def _fit_formulas(
    base: Solution,
    parameters: Sequence[str],
    formulas: Sequence[Found],
    tried: dict[str, Solution],
) -> None:
    """Fit formulas in the full likelihood, the best of them with exact constants, into `tried`."""
    here: dict[str, Solution] = {}
    for found in formulas[:_FITTED]:
        structure, values = found.node.named()
        term = Term(structure.text(), tuple(parameters), tuple(values.items()))
        penalty = found.penalty + criteria.MARGIN * structure.size
        fit = _fit(base.fitter, (*base.terms, term))
        if fit is not None:
            here[term.effect] = replace(base, fit=fit, penalties=(*base.penalties, penalty))
    for text, solution in sorted(here.items(), key=lambda h: h[1].score)[:_REFINED]:
        better = _fit(base.fitter, solution.terms, refined=True)
        here[text] = solution if better is None else replace(solution, fit=better)
    for text, solution in here.items():
        if text not in tried or solution.score < tried[text].score:
            tried[text] = solution


def _fit(
    fitter: HypothesisFitter,
    terms: Sequence[Term],
    only: Sequence[int] | None = None,
    refined: bool = False,
) -> Fit | None:
    """Fit in the full likelihood; None if a formula is too steep for the readings' noise."""
    try:
        fit = fitter.fit(terms, only=only)
        fit = fitter.refine(fit, 4, only) if refined else fit
    except np.linalg.LinAlgError:
        return None
    return fit if np.isfinite(fit.objective) else None


def _leaves_nothing(fitter: HypothesisFitter, fit: Fit) -> bool:
    """Test whether no smooth trajectory remains significant, however small."""
    return all(a.significance < noise_criteria.SIGNIFICANT for a in examine_all(fitter, fit))


def _simplify(base: Solution, best: Solution) -> Solution:
    """Remove operators one by one while the formula fits as well without them."""
    fitter = base.fitter
    nothing_left = _leaves_nothing(fitter, best.fit)
    while True:
        term = best.terms[-1]
        node = parse(term.effect).bound(dict(term.nonlinear))
        solutions = []
        for simpler in node.simpler():
            structure, values = simpler.named()
            if not structure.inputs:
                continue
            own = Term(structure.text(), term.parameters, tuple(values.items()))
            fit = _fit(fitter, (*base.terms, own), refined=True)
            if fit is not None:
                penalties = (*base.penalties, best.penalties[-1] - criteria.MARGIN)
                solution = replace(base, fit=fit, penalties=penalties)
                if solution.score < best.score or (nothing_left and _leaves_nothing(fitter, fit)):
                    solutions.append(solution)
        if not solutions:
            return best
        best = min(solutions, key=by_score)


def _choose_parameters(base: Solution, best: Solution) -> Solution:
    """Choose the parameters in which the formula is needed, one by one."""
    term, fitter = best.terms[-1], base.fitter
    A, c = normals_of_term(fitter, base.fit, term, PARAMETER_NAMES, best.fit.weightings)
    n = float(np.log(sum(int((e.n > 0).sum()) for e in fitter.series)))
    chosen = [PARAMETER_NAMES.index(p) for p in term.parameters]

    def gain(some: Sequence[int]) -> float:
        at = list(some)
        return float(explained(A[np.ix_(at, at)], c[at], 1e-9)) - n * len(at)

    while len(chosen) > 1:
        fewer = max(([j for j in chosen if j != i] for i in chosen), key=gain)
        if gain(fewer) < gain(chosen):
            break
        chosen = fewer
    least = max(criteria.MARGIN, criteria.PARAMETER_SHARE * gain(chosen))
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
    return replace(best, fit=fit, penalties=(*best.penalties[:-1], best.penalties[-1] + change))


def _cross_check(base: Solution, best: Solution) -> tuple[float, float] | None:
    """Return the share of M2's misfit that constants from M1 alone explain, and the reverse.

    The latter is NaN if M2 alone does not determine the constants. None if M1 does not.
    """
    shares, fitter = [], base.fitter
    for here, there in ((0, 1), (1, 0)):
        without = fitter.fit(base.terms, only=[here])
        whole = _fit(fitter, best.terms, [here], refined=True)
        if whole is None:
            if here == 0:
                return None
            shares.append(float("nan"))
            continue
        # mean squares, px², beyond the noise of the free cameras
        e = fitter.series[there]
        noise = e.rank * float((e.n > 0).sum() - 1)
        unit = e.sigma_px**2 * e.correlation / (2.0 * float(e.n.sum()))
        left, before = (unit * max(image_chi2(e, f, there) - noise, 0.0) for f in (whole, without))
        shares.append(1.0 - left / max(before, 1e-18))
    return shares[0], shares[1]
