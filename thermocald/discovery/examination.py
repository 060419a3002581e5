"""The examination of series: the search for the effects that explain them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.evidence import (
    Displaced,
    drop_wandering_targets,
    find_displaced_targets,
    replace_moved_boards,
)
from thermocald.discovery.lag import Late, search_behind_lag
from thermocald.discovery.mounted import (
    KNOCKS,
    contradict,
    fit_beside_walk,
    is_convincing,
    make_own_rates,
    moves_interior,
    search_beside_mount,
    split_knocks,
)
from thermocald.discovery.rivals import does_better, list_rivals, may_replace, settle_ties
from thermocald.discovery.search import Search, Solution, by_score, say_searched
from thermocald.discovery.validation import (
    SurrogateTest,
    compare_with_surrogates,
    is_confirmed,
    measure_block_gains,
)
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES
from thermocald.physics import catalogue
from thermocald.physics.formula import Node
from thermocald.thermal.fit import HypothesisFitter, choose_distortion
from thermocald.thermal.hypothesis import BASE, Term, make_candidate, targets_of
from thermocald.thermal.movement import (
    add_jumps_to_noise,
    add_tremble,
    detect_tremble,
    find_combinations,
    leaves_kinks,
    weight_leaps_down,
)
from thermocald.thermal.noise import (
    NoiseGrowth,
    calibrate_thermometers,
    estimate_noise_slope,
    noise_growth,
    weight_slow_noise,
)
from thermocald.thermal.reduce import reweight
from thermocald.thermal.scan import examine_all, remove_curvature, scan_candidate
from thermocald.thermal.series import in_blocks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.series.field_motion import FieldMovement
    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.movement import Mount
    from thermocald.thermal.scan import Adequacy
    from thermocald.thermal.series import ReducedSeries

_EFFECTS = 3
_COMBINATIONS = 8  # fitted in full per level
_WIDTH = 4  # solutions of a level that are extended
_GUIDES = 3  # effects fitted to estimate how far the image moves


@dataclass(frozen=True, eq=False)
class Examination:
    """The result of the search.

    base, best: solutions in the series as examined, without displaced targets and with weighted
    noise. ranking: single effects by score. rivals: solutions that cannot be excluded. adequacy: of
    best, per series. cross_validation: gains (blocks,) of its effects in blocks of time left out.
    surrogates: the test of each of its effects. mount: its movement, if it moves; knocks: of the
    mount, as terms of the base; as_slips: whether a slip inside the camera explains each equally
    well. unblocked: the series as examined, not averaged in blocks. field_movements: of boards and
    targets, per series. distortion_sigmas: significance of what the distortion follows.
    knows_noise: whether the model has the growth of the noise already. walks: whether an effect of
    `best` may be a random walk of the camera. late: a lag of the thermometer that with few
    effects explains what no or many effects do.
    """

    base: Solution
    best: Solution
    ranking: tuple[Solution, ...]
    rivals: tuple[Solution, ...]
    base_adequacy: tuple[Adequacy, ...]
    adequacy: tuple[Adequacy, ...]
    adequate: bool
    cross_validation: tuple[Array, ...] = ()
    displaced: tuple[tuple[Displaced, ...], ...] = ()
    noise_growth: NoiseGrowth | None = None
    knows_noise: bool = False
    surrogates: tuple[SurrogateTest, ...] = ()
    mount: Mount | None = None
    knocks: tuple[Term, ...] = ()
    as_slips: tuple[bool, ...] = ()
    unblocked: tuple[ReducedSeries, ...] = ()
    field_movements: tuple[tuple[FieldMovement, ...], ...] = ()
    distortion_sigmas: float = 0.0
    walks: bool = False
    late: Late | None = None

    @property
    def fitter(self) -> HypothesisFitter:
        """The fitter of the series as examined."""
        return self.best.fitter

    @property
    def image_places(self) -> list[str]:
        """The places of effects that move no trajectory, in the document's order."""
        places = ["targets"] if self.displaced[0] else []
        return [*places, "noise"] if self.noise_growth and not self.knows_noise else places


def examine_series(
    series: Sequence[ReducedSeries],
    progress: Callable[[str], None] | None = None,
    given: Sequence[ModelEffect] = (),
    jobs: int = 1,
) -> Examination:
    """Examine one series, or M1 and further series with the same physical constants.

    given: effects that the model has already; they are fitted again and stay. jobs: number of
    candidates tested with surrogates at a time.
    """
    say = progress or (lambda _: None)
    known, loose = {catalogue.get(m.name).seen_in for m in given}, set(targets_of(given))
    given = [m for m in given if catalogue.get(m.name).seen_in == "trajectory"]
    say("looking for targets that moved")
    displaced, cleaned, field = [], [], []
    for e in series:
        boards, still = replace_moved_boards(e)
        groups, without = find_displaced_targets(still)
        wandering, without = drop_wandering_targets(without)
        field.append((*boards, *wandering))
        names = e.source.field.names
        displaced.append(tuple(g for g in groups if not {names[r] for r in g.rows} <= loose))
        cleaned.append(without)
    # only after the movements of the field are removed
    distortion, sure = choose_distortion(cleaned)
    cleaned = [e.in_basis(distortion) for e in cleaned]
    say("measuring noise")
    growth = (estimate_noise_slope if "noise" in known else noise_growth)(cleaned)
    if growth is not None:
        cleaned = [reweight(e, n) for e, n in zip(cleaned, growth.noise, strict=True)]
    calibrated = calibrate_thermometers(cleaned)
    ready = [in_blocks(weight_slow_noise(e)) for e in calibrated]
    wanders = max(e.correlation for e in calibrated) > criteria.MEMORY
    result = _examine_beside_mount(calibrated, say, given, jobs) if wanders else None
    if result is None:
        shaking = calibrated if not wanders and any(map(detect_tremble, calibrated)) else []
        result = _examine_standing(ready, shaking, say, given, jobs)
        if result.walks:
            say("the camera may have moved at random: searching again")
            result = _examine_beside_mount(calibrated, say, given, jobs, result.best) or result
    if _may_be_late(result):
        say("the thermometer may lag behind the camera: searching again")

        def search_in(led: Sequence[ReducedSeries]) -> tuple[Solution, bool]:
            found = _search_in(led, say, given, jobs)
            return found.best, found.adequate

        result = replace(result, late=search_behind_lag(result.best, len(given), search_in))
    return replace(
        result, displaced=tuple(displaced), noise_growth=growth, knows_noise="noise" in known,
        unblocked=tuple(cleaned), field_movements=tuple(field), distortion_sigmas=sure,
    )  # fmt: skip


def _search_in(
    series: Sequence[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[ModelEffect],
    jobs: int,
) -> Examination:
    search = Search(HypothesisFitter(series), say)
    return _search_standing(search, search.base(given), jobs)


def _examine_standing(
    ready: list[ReducedSeries],
    shaking: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[ModelEffect],
    jobs: int,
) -> Examination:
    """Search with a mount that stands still, and again with what the effects found show.

    These show the projection's curvature and the noise that targets share. shaking: the series, if
    all targets jump together. How much of these jumps a thermometer's errors explain depends on the
    effect; unless an effect explains them, each is fitted beside the tremble that it leaves.
    """
    search_in = partial(_search_in, say=say, given=given, jobs=jobs)
    say("fitting the model without a further effect")
    search = Search(HypothesisFitter(ready), say)
    base = search.base(given)
    # a single effect accounts for most of the image's movement
    guide = min([base, *search.expand(base, _GUIDES)], key=by_score).fit
    bent = remove_curvature(search.fitter, guide)
    found = search_in(bent) if bent else _search_standing(search, base, jobs)
    if not found.adequate:
        again = remove_curvature(found.fitter, found.best.fit)
        if again is not None and _is_explained(again, found):
            say("searching again with the projection's curvature, which the effects found show")
            found = search_in(again)
    noisy = add_jumps_to_noise(found.fitter, found.best.fit)
    if shaking and (noisy is not None or not found.adequate):
        known = found.best if _is_short(search, base, found.best) else None
        alongside = _examine_beside_mount(shaking, say, given, jobs, known)
        if alongside is not None:
            return alongside
    if noisy is not None and (found.adequate or _is_explained(noisy, found)):
        say("searching again with the noise that targets share")
        found = search_in(noisy)
    if not found.adequate or any(t.kind.is_event for t in found.best.terms):
        knocked = _search_beside_knocks(found, say, jobs)
        most = len(found.best.terms) if found.adequate else np.inf
        if knocked is not None and len(knocked.best.terms) <= most:
            return knocked
    return found


def _may_be_late(x: Examination) -> bool:
    """Test whether a lag of the thermometer may explain a series better.

    What follows T then follows T + τ dT/dt, which a gradient adds to the linear terms only, so that
    further effects imitate the rest.
    """
    found = x.best.terms[len(x.base.terms) :]
    leaves = max(a.significance for a in x.adequacy) > criteria.LEFT_SIGMAS
    many = len(found) > 2 or (len(found) == 2 and leaves)
    return not x.adequate or (many and any(t.kind.follows_rate or t.kind.delay for t in found))


def _search_beside_knocks(
    found: Examination, say: Callable[[str], None], jobs: int
) -> Examination | None:
    """Search beside knocks of a mount that otherwise stands still; None if these do not suffice.

    A knock is a step of the camera that explains much more than a step inside it at that time.
    """
    search, base, series = Search(found.fitter, say), found.base, found.fitter.series
    event = catalogue.find(lambda kind: kind.is_event and kind.seen_in == "trajectory")
    whole, inside = (make_candidate(event, names, series) for names in (EOP_NAMES, BASE))
    knocks: tuple[Term, ...] = ()
    for _ in range(KNOCKS):
        steps = (scan_candidate(search.fitter, c, base.fit).gains for c in (whole, inside))
        differences = [a - np.maximum(b, 0.0) for a, b in zip(*steps, strict=True)]
        fresh = tuple(
            ((whole.name, float(e.times[np.argmax(more) + 1])),)
            if np.max(more) > criteria.SLIP_NOT_KNOCK
            else None
            for e, more in zip(series, differences, strict=True)
        )
        if not any(fresh):
            break
        knocks = (*knocks, Term(event.name, EOP_NAMES, (), fresh))
        say("the mount was knocked: searching again")
        base = search.refine((*base.terms, knocks[-1]), (*base.penalties, 0.0))
        again = _search_standing(search, base, jobs)
        # beside steps with six free coefficients each, several effects could imitate anything
        effects = [term for term in again.best.terms if term not in base.terms]
        if again.adequate and len(effects) <= 1:
            return replace(again, knocks=knocks, as_slips=(False,) * len(knocks))
    return None


def _is_explained(series: list[ReducedSeries], found: Examination) -> bool:
    """Test whether the effects found are adequate in the series under another noise model."""
    fitter = HypothesisFitter(series)
    refined = fitter.refine(fitter.fit(found.best.terms, found.best.fit.coefficients))
    return _is_adequate(examine_all(fitter, refined), found.base_adequacy)


def _search_standing(search: Search, base: Solution, jobs: int) -> Examination:
    """Search with a mount that stands still, extending combinations while the score improves."""
    fitter = search.fitter
    kept = len(base.terms)
    base_adequacy = examine_all(fitter, base.fit)
    best, ranking, seen = base, list[Solution](), list[Solution]()
    frontier, larger = [base], base
    complete = False
    for level in range(1, min(_EFFECTS, max(search.epochs // criteria.EPOCHS_EACH, 1)) + 1):
        beside = " or ".join(" with ".join(s.names) for s in frontier) if level > 1 else ""
        search.progress(say_searched(beside))
        if level == 1:
            grown = ranking = search.expand(base)
        else:
            # beyond an adequate solution, others must promise more than it explains
            below = best.score if complete else np.inf
            more = search.expand_all(frontier, _WIDTH, _COMBINATIONS, below)
            grown = [search.shrink(s, kept) for s in more]
        seen += grown
        if complete:
            equal = [s for s in frontier if s.score < best.score + criteria.BAND]
            larger = min(grown, key=by_score, default=best)
            grown = [s for s in grown if may_replace(base, best, equal, s)]
        if not grown:
            break
        champion = min(grown, key=by_score)
        if champion.score >= best.score:
            break
        best = search.with_events_moved(champion)
        seen.append(best)
        complete = _is_adequate(examine_all(fitter, best.fit), base_adequacy)
        # an adequate solution may still lack an effect too fast for the absolute test, and an
        # effect with many coefficients may imitate two that have not been combined yet
        frontier = [best]
        if complete or level == 1:  # the best solutions, one per set of names
            sets = {tuple(sorted(s.names)): s for s in sorted(grown, key=lambda s: -s.score)}
            frontier = sorted(sets.values(), key=by_score)[:_WIDTH]
    # a larger combination that was rejected is a rival if two effects in it do better than one here
    seen = [s for s in seen if len(s.terms) <= len(best.terms) or does_better(s, best)]
    if len(best.terms) > kept:
        best, seen = settle_ties(search, best, larger, seen)
    blocks: list[Array] = []
    tests: tuple[SurrogateTest, ...] = ()
    if _is_adequate(examine_all(fitter, best.fit), base_adequacy):
        best, blocks, tests = _keep_named(search, base, best, jobs)
    adequacy = examine_all(fitter, best.fit)
    complete = _is_adequate(adequacy, base_adequacy)
    walks = complete and _imitates_walk(search, base, best)
    complete = complete and not walks and not _magnitude_does_better(search, base, best)
    if len(best.terms) > kept and len(fitter.series) < 2:
        # if single targets wander much, one series alone names no effect
        complete = complete and fitter.series[0].correlation <= criteria.WANDERING
    elif len(best.terms) > kept:
        complete = complete and not _own_rates_do_better(search, base, best)
    return Examination(
        base, best, tuple(ranking), list_rivals(best, seen), base_adequacy, adequacy,
        complete, tuple(blocks), surrogates=tests, walks=walks,
    )  # fmt: skip


def _imitates_walk(search: Search, base: Solution, best: Solution) -> bool:
    """Test whether a random walk of the camera in place of an effect found is not excluded.

    In few epochs, several flexible effects imitate a walk; as they leave only noise, surrogates do
    not show it.
    """
    found = range(len(base.terms), len(best.terms))
    if not _is_short(search, base, best):
        return False
    limit = fit_beside_walk(best).score + criteria.BAND
    return any(fit_beside_walk(_drop_effect(search, base, best, i)).score < limit for i in found)


def _magnitude_does_better(search: Search, base: Solution, best: Solution) -> bool:
    """Test whether |dT/dt| alone, which has no name, does better than a gradient and the others."""
    rate = Node("rate", (Node("", name=search.fitter.series[0].history.reference),))
    kept = len(base.terms)
    return any(
        search.refine(
            (*base.terms, Term(Node("magnitude", (rate,)).text(), term.parameters)),
            (*base.penalties, penalty),
        ).score
        < best.score - criteria.BAND
        for term, penalty in zip(best.terms[kept:], best.penalties[kept:], strict=True)
        if term.kind.follows_rate
    )


def _is_short(search: Search, base: Solution, best: Solution) -> bool:
    """Test whether effects found in so few epochs could imitate a random walk."""
    return search.epochs < criteria.NO_WALK_EACH * (len(best.terms) - len(base.terms))


def _own_rates_do_better(search: Search, base: Solution, best: Solution) -> bool:
    """Test whether rates of its own for each further series do better than the effects found.

    The series then contradict each other, as those of two cameras do.
    """
    count = len(search.fitter.series)
    own = [make_own_rates(s, count) for s in range(1, count)]
    penalty = len(BASE) * float(np.log(search.epochs))
    other = search.refine((*base.terms, *own), (*base.penalties, *[penalty] * len(own)))
    return other.score < best.score - criteria.BAND


def _is_adequate(now: Sequence[Adequacy], base: Sequence[Adequacy]) -> bool:
    """Test whether a solution leaves no misfit, or next to none of the base model's."""
    return all(
        a.adequate or a.misfit_px < min(criteria.LEFT_SHARE * b.misfit_px, criteria.LEFT_PX)
        for a, b in zip(now, base, strict=True)
    )


def _examine_beside_mount(
    calibrated: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[ModelEffect],
    jobs: int,
    guide: Solution | None = None,
) -> Examination | None:
    """Search beside a moving mount; None if that explains no movement as smooth as this one.

    It is then an influence that was not recorded; None also if the series contradict each other or
    if what is left is smooth but for kinks, or moves the camera's interior.
    guide: if the camera may walk, the effects beside which the tremble is measured, as the ends of
    a strong one look like it.
    """
    walks = guide is not None
    fitter = HypothesisFitter([in_blocks(replace(e, correlation=1.0)) for e in calibrated])
    still = HypothesisFitter(
        weight_leaps_down(fitter, fitter.fit(()), find_combinations(fitter.series))
    )
    shaken = HypothesisFitter(add_tremble(still, still.fit(guide.terms if guide else ())))
    beside, ranking, seen, like = search_beside_mount(shaken, say, given, walks)
    fitter, mount = beside.fitter, beside.mount
    base, whole, knocks = split_knocks(beside, len(given))
    if mount is None or mount.smoothness(fitter, whole.fit) > criteria.SMOOTH:
        return None
    search = Search(fitter, say, like)
    best, blocks, tests = _keep_named(search, base, whole, jobs)
    if any(t.kind.is_event and t not in best.terms for t in whole.terms):
        # steps that cannot be named stay in the model
        base, whole, knocks = split_knocks(whole, len(given), slips=True)
        best, blocks, tests = _keep_named(search, base, whole, jobs)
    if not is_convincing(base, best):
        best, blocks, tests = base, [], ()
    if (
        contradict(best)
        or leaves_kinks(fitter, best.fit)
        or moves_interior(still, best.terms, walks)
    ):
        return None
    tried = iter(beside.as_slips)
    as_slips = tuple(t.parameters != EOP_NAMES or next(tried) for t in knocks)
    rivals: list[Solution] = []
    for s in sorted(seen, key=by_score):
        names = [t.effect for t in s.terms if t not in knocks]
        own = [t.effect for t in best.terms if t not in knocks]
        # between readings the temperature is unknown, so that a delay and its rate look alike
        differ = [t for t in (*s.terms, *best.terms) if (t in s.terms) != (t in best.terms)]
        band = criteria.DRIVES_BAND if any(t.kind.delay for t in differ) else criteria.BAND
        close = s.score < best.score + band and len(names) <= len(own)
        if close and sorted(names) != sorted(own) and s.names not in [r.names for r in rivals]:
            rivals.append(s)
    return Examination(
        base, best, tuple(ranking), tuple(rivals), examine_all(fitter, base.fit),
        examine_all(fitter, best.fit), True, tuple(blocks), surrogates=tests, mount=mount,
        knocks=knocks, as_slips=as_slips,
    )  # fmt: skip


def _keep_named(
    search: Search, base: Solution, best: Solution, jobs: int
) -> tuple[Solution, list[Array], tuple[SurrogateTest, ...]]:
    """Drop the effects that do not predict blocks left out or do not pass the surrogate test.

    A knee at the end of the recorded temperatures is dropped too: it is a straight line. Returns
    also the gains of the others in each block, and their tests.
    """
    kept, (low, high) = len(base.terms), search.fitter.knee_range()
    while len(best.terms) > kept:
        blocks = measure_block_gains(search.fitter, best.fit, kept)
        ends = [bool({low, high} & set(dict(t.nonlinear).values())) for t in best.terms[kept:]]
        bad = [i for i, g in enumerate(blocks) if ends[i] or not is_confirmed(g)]
        if bad:
            worst = min(bad, key=lambda i: float(blocks[i].sum()))
            search.progress(f"{best.names[kept + worst]} predicts no period left out: dropped")
            best = _drop_effect(search, base, best, kept + worst)
            continue
        tests = []
        for i in range(kept, len(best.terms)):
            without = _drop_effect(search, base, best, i)
            gain = without.score - best.score
            tests.append(compare_with_surrogates(search, best.fit, without, gain, jobs=jobs))
        worst = max(range(len(tests)), key=lambda i: tests[i].p)
        if tests[worst].passed:
            return best, blocks, tuple(tests)
        search.progress(f"{best.names[kept + worst]} may be noise: dropped")
        best = _drop_effect(search, base, best, kept + worst)
    return best, [], ()


def _drop_effect(search: Search, base: Solution, best: Solution, number: int) -> Solution:
    """Fit a solution again without one of its effects."""
    terms = best.terms[:number] + best.terms[number + 1 :]
    penalties = best.penalties[:number] + best.penalties[number + 1 :]
    if len(terms) == len(base.terms):
        return base
    return replace(search.refine(terms, penalties), mount=best.mount, as_slips=best.as_slips)
