"""The examination: from evidence to the effects that explain it, or to none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from thermocald.discovery.evidence.image_space import Displaced, displaced_targets
from thermocald.discovery.evidence.moved_field import moved_boards, wandering_apart
from thermocald.discovery.search.cross_validation import confirmed, gains
from thermocald.discovery.search.mounted import convincing, search_beside_mount, without_slips
from thermocald.discovery.search.search import Search, Solution
from thermocald.discovery.search.standing import (
    BAND,
    SWAP_BAND,
    adequacies,
    adequate,
    search_standing,
)
from thermocald.discovery.search.surrogates import SurrogateTest, surrogate_test
from thermocald.reduction.blocks import in_blocks
from thermocald.reduction.calibrated import calibrated_thermometers
from thermocald.reduction.curvature import curved
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.movement import WAVES, combinations, steadied
from thermocald.reduction.noise import noisier, trembles, trembling, with_correlated_noise
from thermocald.reduction.noise_growth import NoiseGrowth, noise_growth
from thermocald.reduction.reduce import reweighted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.series.field_motion import FieldMovement
    from thermocald.reduction.adequacy import Adequacy
    from thermocald.reduction.hypothesis import Term
    from thermocald.reduction.movement import Mount
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Examination", "examine_series"]

# variance of slow trajectories over that of white noise from which on a mount is asked for
_MEMORY = 1.9
# effects of which one says how far the image moves
_GUIDES = 3
# how much more a movement has in its slowest half-waves than a random walk has
_SMOOTH = 30.0
# slow variances over those of white noise: beyond, what one series shows has to be seen in another
_WANDERING = 3.0


@dataclass(frozen=True, eq=False)
class Examination:
    """What the search found.

    fitter: the series as examined, displaced targets out and noise weighted; base, best: solutions;
    ranking: singles by score; rivals: solutions that cannot be excluded; adequacy: of best, per
    series; cross_validation: gains (blocks,) of its effects on blocks of time left out; surrogates:
    each of its effects against surrogates; mount: its movement, where it moves; knocks: of the
    mount, terms of the base; field_movements: boards and targets that moved, per series.
    """

    fitter: HypothesisFitter
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
    surrogates: tuple[SurrogateTest, ...] = ()
    mount: Mount | None = None
    knocks: tuple[Term, ...] = ()
    original: tuple[ReducedSeries, ...] = ()
    field_movements: tuple[tuple[FieldMovement, ...], ...] = ()


def examine_series(
    series: Sequence[ReducedSeries],
    progress: Callable[[str], None] | None = None,
    given: Sequence[tuple[str, dict[str, Any]]] = (),
    jobs: int = 1,
) -> Examination:
    """Examine one series, or M1 with M2, which share their physical constants.

    given: effects that the model has already, with their values; they are fitted again and stay;
    jobs: candidates that surrogates try at a time.
    """
    say = progress or (lambda _: None)
    say("targets that moved")
    displaced, cleaned, field = [], [], []
    for e in series:
        boards, still = moved_boards(e)
        groups, without = displaced_targets(still)
        wandering, without = wandering_apart(without)
        field.append((*boards, *wandering))
        displaced.append(tuple(groups))
        cleaned.append(without)
    say("measuring noise")
    growth = noise_growth(cleaned)
    if growth is not None:
        cleaned = [reweighted(e, n) for e, n in zip(cleaned, growth.noise, strict=True)]
    calibrated = calibrated_thermometers(cleaned)
    ready = [in_blocks(with_correlated_noise(e)) for e in calibrated]
    found = None
    wanders = max(e.correlation for e in calibrated) > _MEMORY
    if wanders:
        found = _beside_mount(calibrated, say, given, jobs)
    if found is None:
        shaking = calibrated if not wanders and any(map(trembles, calibrated)) else []
        found = _still(ready, shaking, say, given, jobs)
    return replace(
        found, displaced=tuple(displaced), noise_growth=growth, original=tuple(series),
        field_movements=tuple(field),
    )  # fmt: skip


def _still(
    ready: list[ReducedSeries],
    shaking: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
    jobs: int,
) -> Examination:
    """The search where the mount stands still.

    shaking: the series where all targets jump together. What a thermometer's errors take up of that
    depends on the effect; unless an effect explains it, each is fitted with the tremble it leaves.
    """
    say("base model")
    fitter = HypothesisFitter(ready)
    search = Search(fitter, say)
    base = search.base(given)
    # one effect moves the image by most of what it moves at all
    guide = min([base, *search.expand(base, _GUIDES)], key=lambda s: s.score).fit
    bent = curved(fitter, guide)
    if bent:
        search = Search(HypothesisFitter(bent), say)
        base = search.base(given)
    found = _searched(search, base, say, jobs)
    if not found.adequate:
        again = curved(found.fitter, found.best.fit)
        if again is not None and _explained(again, found):
            say("curvature of the projection: once more")
            search = Search(HypothesisFitter(again), say)
            found = _searched(search, search.base(given), say, jobs)
    noisy = noisier(found.fitter, found.best.fit)
    if shaking and (noisy is not None or not found.adequate):
        alongside = _beside_mount(shaking, say, given, jobs)
        if alongside is not None:
            return alongside
    if noisy is not None and (found.adequate or _explained(noisy, found)):
        say("noise that targets share: once more")
        search = Search(HypothesisFitter(noisy), say)
        found = _searched(search, search.base(given), say, jobs)
    return found


def _explained(series: list[ReducedSeries], found: Examination) -> bool:
    """Whether the effects found leave nothing over in other states of the series."""
    fitter = HypothesisFitter(series)
    refined = fitter.refine(fitter.fit(found.best.terms, found.best.fit.coefficients))
    now = adequacies(fitter, replace(found.best, fit=refined))
    return adequate(now, found.base_adequacy)


def _searched(
    search: Search,
    base: Solution,
    say: Callable[[str], None],
    jobs: int,
) -> Examination:
    found = search_standing(search, base, say)
    fitter, best = search.fitter, found.best
    blocks: list[Array] = []
    tests: tuple[SurrogateTest, ...] = ()
    if found.adequate(best):
        best, blocks, tests = _named(search, base, best, jobs)
    adequacy = adequacies(fitter, best)
    complete = adequate(adequacy, found.base_adequacy)
    if len(best.terms) > len(base.terms) and _unverified(fitter.series):
        complete = False
    return Examination(
        fitter, base, best, found.ranking, found.rivals(best), found.base_adequacy, adequacy,
        complete, tuple(blocks), surrogates=tests,
    )  # fmt: skip


def _beside_mount(
    calibrated: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
    jobs: int,
) -> Examination | None:
    """The search alongside a mount that moves; None where the movement is not one of a mount.

    A smooth influence that nobody recorded is not a wander of a mount.
    """
    fitter = HypothesisFitter([in_blocks(replace(e, correlation=1.0)) for e in calibrated])
    fitter = HypothesisFitter(steadied(fitter, fitter.fit(()), combinations(fitter.series)))
    shaken = trembling(fitter, fitter.fit(()), WAVES)
    found = search_beside_mount(HypothesisFitter(shaken), say, given)
    if found.mount.smoothness(found.fitter, found.best.fit) > _SMOOTH:
        return None
    search = Search(found.fitter, say, found.like)
    best, blocks, tests = _named(search, found.base, found.best, jobs)
    if any(t.kind.is_event and t not in best.terms for t in found.best.terms):
        found = without_slips(found, len(given))  # steps that cannot be named are still there
        best, blocks, tests = _named(search, found.base, found.best, jobs)
    base = found.base
    if not convincing(found.fitter, base, best):
        best, blocks, tests = base, [], ()
    adequacy = adequacies(found.fitter, best)
    rivals: list[Solution] = []
    for s in sorted(found.seen, key=lambda s: s.score):
        names = [t.effect for t in s.terms if t not in found.knocks]
        own = [t.effect for t in best.terms if t not in found.knocks]
        # between two readings nobody knows the temperature: a delay and its rate look alike
        differ = [t for t in (*s.terms, *best.terms) if (t in s.terms) != (t in best.terms)]
        band = SWAP_BAND if any(t.kind.delay for t in differ) else BAND
        close = s.score < best.score + band and len(names) <= len(own)
        if close and sorted(names) != sorted(own) and s.names not in [r.names for r in rivals]:
            rivals.append(s)
    return Examination(
        found.fitter, base, best, found.ranking, tuple(rivals), adequacies(found.fitter, base),
        adequacy, True, tuple(blocks), surrogates=tests, mount=found.mount, knocks=found.knocks,
    )  # fmt: skip


def _unverified(series: Sequence[ReducedSeries]) -> bool:
    """Single targets wander so much that one series alone carries no name."""
    return len(series) < 2 and max(e.correlation for e in series) > _WANDERING


def _named(
    search: Search, base: Solution, best: Solution, jobs: int
) -> tuple[Solution, list[Array], tuple[SurrogateTest, ...]]:
    """The solution without effects that blocks left out or surrogates speak against."""
    kept = len(base.terms)
    best, blocks = _confirmed(search, base, best)
    while len(best.terms) > kept:
        tests = []
        for i in range(kept, len(best.terms)):
            without = _without(search, base, best, i)
            gain = without.score - best.score
            tests.append(surrogate_test(search, best.fit, without, gain, jobs=jobs))
        worst = max(range(len(tests)), key=lambda i: tests[i].p)
        if tests[worst].passed:
            return best, blocks, tuple(tests)
        search.progress(f"{best.names[kept + worst]} is not more than noise may give")
        best, blocks = _confirmed(search, base, _without(search, base, best, kept + worst))
    return best, blocks, ()


def _without(search: Search, base: Solution, best: Solution, number: int) -> Solution:
    """The solution without one of its effects, the others fitted again."""
    terms = [t for i, t in enumerate(best.terms) if i != number]
    penalties = [p for i, p in enumerate(best.penalties) if i != number]
    return search.refine(terms, penalties) if len(terms) > len(base.terms) else base


def _confirmed(search: Search, base: Solution, best: Solution) -> tuple[Solution, list[Array]]:
    """The solution without effects that do not predict blocks left out, and what the others gain
    on each block.
    """
    kept = len(base.terms)
    while len(best.terms) > kept:
        blocks = gains(search.fitter, best.fit, kept)
        bad = [i for i, g in enumerate(blocks) if not confirmed(g)]
        if not bad:
            return best, blocks
        worst = kept + min(bad, key=lambda i: float(blocks[i].sum()))
        search.progress(f"{best.names[worst]} does not predict the blocks left out")
        best = _without(search, base, best, worst)
    return best, []
