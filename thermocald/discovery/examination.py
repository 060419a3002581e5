"""The examination: from evidence to the effects that explain it, or to none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.adequacy import Adequacy, examine
from thermocald.discovery.condensing import condensed
from thermocald.discovery.curvature import relinearised
from thermocald.discovery.image_space import (
    Displaced,
    NoiseGrowth,
    displaced_targets,
    noise_growth,
)
from thermocald.discovery.laboratory import Laboratory
from thermocald.discovery.left_out import confirmed, gains
from thermocald.discovery.noise import jumps, slowed, with_jumps
from thermocald.discovery.reduction import reweighted
from thermocald.discovery.search import Search, Solution

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.discovery.evidence import Evidence

    Array = NDArray[np.float64]

__all__ = ["Examination", "examine_series"]

MAX_EFFECTS = 2
# how much worse a solution may score and still not be excluded
BAND = 14.0
# a model that leaves less than this share of what the base left has the cause
_LEFT = 0.03
_LAG_OR_DELAY = ("thermal_lag", "time_offset")
# by how much worse (χ²) another way of following the temperature may fit and not be excluded
_SWAP_BAND = 120.0
# slow variances over those of white noise: beyond, what one series shows has to be seen in another
_WANDERING = 3.0
# a second effect beside an adequate one has to explain as much, in px RMS and as a share of the
# first: below that, it is the first one's finer points
_LEFT_PX, _LEFT_SHARE = 0.005, 0.15


@dataclass(frozen=True, eq=False)
class Examination:
    """What the search found.

    laboratory: the series as examined, displaced targets out and noise weighted; base, best:
    solutions; ranking: singles by score; rivals: solutions that cannot be excluded;
    adequacy: of best, per series; left_out: gains (blocks,) of its effects on blocks of time left
    out.
    """

    laboratory: Laboratory
    base: Solution
    best: Solution
    ranking: tuple[Solution, ...]
    rivals: tuple[Solution, ...]
    base_adequacy: tuple[Adequacy, ...]
    adequacy: tuple[Adequacy, ...]
    adequate: bool
    left_out: tuple[Array, ...] = ()
    displaced: tuple[tuple[Displaced, ...], ...] = ()
    defocus: NoiseGrowth | None = None
    original: tuple[Evidence, ...] = ()


def examine_series(
    series: Sequence[Evidence],
    progress: Callable[[str], None] | None = None,
    given: Sequence[tuple[str, dict[str, Any]]] = (),
) -> Examination:
    """Examine one series, or M1 with M2, which share their physical constants.

    given: effects that the model has already, with their values; they are fitted again and stay.
    """
    say = progress or (lambda _: None)
    say("targets that moved")
    displaced, cleaned = [], []
    for e in series:
        groups, without = displaced_targets(e)
        displaced.append(tuple(groups))
        cleaned.append(without)
    say("measuring noise")
    growth = noise_growth(cleaned)
    if growth is not None:
        cleaned = [reweighted(e, n) for e, n in zip(cleaned, growth.noise, strict=True)]
    ready = [condensed(slowed(e)) for e in calibrated_thermometers(cleaned)]
    found = _searched(Laboratory(ready), say, given)
    curved = _curved(found)
    if curved is not None:
        say("curvature of the projection: once more")
        found = _searched(Laboratory(curved), say, given)
    noisy = _noisier(found)
    if noisy is not None:
        say("noise that targets share: once more")
        found = _searched(Laboratory(noisy), say, given)
    return replace(found, displaced=tuple(displaced), defocus=growth, original=tuple(series))


def _curved(found: Examination) -> list[Evidence] | None:
    """The series with the projection's curvature taken off; None where it does not matter."""
    laboratory = found.laboratory
    out = [relinearised(laboratory, found.best.fit, s) for s in range(len(laboratory.series))]
    if all(e is None for e in out):
        return None
    return [e or old for e, old in zip(out, laboratory.series, strict=True)]


def _noisier(found: Examination) -> list[Evidence] | None:
    """The series with what still jumps from epoch to epoch as noise; None where nothing does."""
    laboratory, out = found.laboratory, []
    for s, e in enumerate(laboratory.series):
        if len(e.times) < 60:
            return None
        out.append(with_jumps(e, *jumps(laboratory, found.best.fit, s)))
    if all(e is None for e in out):
        return None
    return [e or old for e, old in zip(out, laboratory.series, strict=True)]


def _searched(
    laboratory: Laboratory,
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
) -> Examination:
    """The search itself, in the courses of the parameters."""
    say("base model")
    search = Search(laboratory, say)
    base = search.base(given)
    base_adequacy = _adequacies(laboratory, base)
    best, ranking = base, []
    frontier = [base]
    seen: list[Solution] = []
    adequate = False
    for level in range(1, MAX_EFFECTS + 1):
        grown: list[Solution] = []
        for solution in frontier:
            say(f"effect {level}: beside {', '.join(solution.names) or 'the base'}")
            wide = 6 if level == 1 else 4
            kept = len(base.terms)
            grown += [search.shrink(s, kept) for s in search.expand(solution, wide)]
        if level == 1:
            ranking = sorted(grown, key=lambda s: s.score)
        seen += grown
        if not grown:
            break
        champion = min(grown, key=lambda s: s.score)
        if champion.score >= best.score:
            break
        if level > 1 and adequate:
            least = max(_LEFT_PX, _LEFT_SHARE * _size_px(laboratory, base, best))
            if _size_px(laboratory, best, champion) < least:
                break
        best = champion
        adequate = _adequate(_adequacies(laboratory, best), base_adequacy)
        # what is adequate may still lack something too fast for the absolute test
        frontier = [best] if adequate else _frontier(grown)
    # larger combinations that were not accepted are no rivals
    seen = [s for s in seen if len(s.terms) <= len(best.terms)]
    if len(best.terms) > len(base.terms):
        best, seen = _contest(search, best, seen)
        best, seen = _lag_or_delay(search, best, seen)
    best, blocks = _confirmed(search, base, best)
    adequacy = _adequacies(laboratory, best)
    adequate = _adequate(adequacy, base_adequacy)
    if len(best.terms) > len(base.terms) and _unverified(laboratory.series):
        adequate = False
    rivals: list[Solution] = []
    for s in sorted(seen, key=lambda s: s.score):
        different = sorted(s.names) != sorted(best.names)
        close = s.score < best.score + BAND
        if _swapped(best, s):
            close = s.fit.chi2 < best.fit.chi2 + _SWAP_BAND
        if different and close and s.names not in [r.names for r in rivals]:
            rivals.append(s)
    return Examination(
        laboratory, base, best, tuple(ranking), tuple(rivals), base_adequacy, adequacy, adequate,
        tuple(blocks),
    )  # fmt: skip


def _lag_or_delay(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Of a lag and a delay the one that fits better, and both among the solutions seen.

    The likelihood holds every course of the temperature for equally probable. A lag smooths the
    thermometer's noise, a delay does not; so a smooth image, which all temperatures give, would
    speak for a lag whatever the cause. Between these two the fit alone decides.
    """
    other = _with_the_other(search, best)
    if other is None:
        return best, seen
    if other.fit.chi2 < best.fit.chi2 - 0.5 * _SWAP_BAND:
        return other, [*seen, other]
    return best, [*seen, other]


def _with_the_other(search: Search, solution: Solution) -> Solution | None:
    """The solution with a delay in place of its lag, or a lag in place of its delay."""
    for i, term in enumerate(solution.terms):
        if term.effect not in _LAG_OR_DELAY:
            continue
        name = _LAG_OR_DELAY[1 - _LAG_OR_DELAY.index(term.effect)]
        seconds = float(term.nonlinear[0][1])
        if seconds <= 0 or name in solution.names:
            return None
        candidate = next(c for c in search.candidates if c.effect == name)
        swapped = candidate.term(seconds, len(search.laboratory.series))
        terms = (*solution.terms[:i], swapped, *solution.terms[i + 1 :])
        return search.refine(terms, solution.penalties, solution.fit)
    return None


def _swapped(one: Solution, other: Solution) -> bool:
    """Whether the two differ in one way of following the temperature for another only."""
    mine = [t for t in one.terms if t.effect not in other.names]
    theirs = [t for t in other.terms if t.effect not in one.names]
    return len(mine) == len(theirs) == 1 and mine[0].is_drive and theirs[0].is_drive


def _unverified(series: Sequence[Evidence]) -> bool:
    """Single targets wander so much that one series alone carries no name."""
    return len(series) < 2 and max(e.correlation for e in series) > _WANDERING


def _confirmed(search: Search, base: Solution, best: Solution) -> tuple[Solution, list[Array]]:
    """The solution without effects that do not predict blocks left out, and what the others gain
    on each block.
    """
    kept = len(base.terms)
    while len(best.terms) > kept:
        blocks = gains(search.laboratory, best.fit, kept)
        bad = [i for i, g in enumerate(blocks) if not confirmed(g)]
        if not bad:
            return best, blocks
        worst = kept + min(bad, key=lambda i: float(blocks[i].sum()))
        search.progress(f"{best.names[worst]} does not predict the blocks left out")
        terms = [t for i, t in enumerate(best.terms) if i != worst]
        penalties = [p for i, p in enumerate(best.penalties) if i != worst]
        best = search.refine(terms, penalties, best.fit) if terms else base
    return best, []


def calibrated_thermometers(series: Sequence[Evidence]) -> list[Evidence]:
    """The series with the noise of the reference thermometer as the images confirm it.

    The images tell the temperature too, through the linear terms: with an unknown slow error, but
    sharper than most thermometers. Where a fast effect spoils that, the readings alone count. One
    thermometer has one noise.
    """
    laboratory = Laboratory([condensed(e) for e in series])
    fit = laboratory.fit(())
    laboratory = Laboratory(series)
    d = fit.direction(fit.blocks[0])[0]
    variances, weights = [], []
    for s, e in enumerate(series):
        instrument = e.channels[e.history.reference]
        precision = np.einsum("p,epq,q->e", d, e.N, d)
        ok = precision > 0
        own = instrument.noise**2
        if ok.sum() > 20:
            course = laboratory.drive_course((), s)
            matrix = e.history.temperature_matrix() @ instrument.mixing
            shown = course + matrix @ instrument.deviation
            # what the image says of T beyond its level, in K
            rest = (e.b @ d)[ok] / precision[ok] - shown[ok]
            second = np.diff(rest, 2)
            image = 6.0 * float(np.mean(1.0 / precision[ok]))
            shown_by_image = (_clipped(second) ** 2 - image) / 6.0
            if shown_by_image < 1.5 * own:
                own = max(0.5 * (own + shown_by_image), 0.25 * own)
        variances.append(own)
        weights.append(float(ok.sum()))
    noise = float(np.sqrt(np.average(variances, weights=weights)))
    out = []
    for e in series:
        name = e.history.reference
        old = e.channels[name]
        ratio = noise / old.noise
        channels = {**e.channels, name: replace(old, sd=old.sd * ratio, noise=noise)}
        out.append(replace(e, channels=channels))
    return out


def _clipped(values: Array) -> float:
    """Standard deviation of a normal distribution whose tails are spoiled."""
    scale = float(np.sqrt(np.mean(values**2)))
    for _ in range(20):
        kept = values[np.abs(values) <= 2.2 * scale]
        scale = float(np.sqrt(np.mean(kept**2))) / 0.9162 if len(kept) > 5 else scale
    return scale


def _contest(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Near ties again, each under the thermometer noise that suits it best."""
    close = {s.terms: s for s in seen if s.score < best.score + 60.0}
    if len({s.names for s in close.values()}) < 2:
        return best, seen
    laboratory = search.laboratory
    again: list[Solution] = []
    for s in sorted(close.values(), key=lambda s: s.score)[:6]:
        _, objective = laboratory.thermometer_scale(s.fit)
        again.append(replace(s, fit=replace(s.fit, logdet=objective - s.fit.chi2)))
    again.sort(key=lambda s: s.score)
    others = [s for s in seen if s.terms not in close]
    return again[0], [*again, *others]


def _size_px(laboratory: Laboratory, without: Solution, with_it: Solution) -> float:
    """RMS px that one more effect explains."""
    gain = max(without.score - with_it.score, 0.0)
    coordinates = 2.0 * sum(float(e.n.sum()) for e in laboratory.series)
    weights = np.concatenate([e.weights[..., 0].ravel() for e in laboratory.series])
    return float(np.sqrt(gain / coordinates / np.mean(weights[weights > 0])))


def _frontier(grown: list[Solution], width: int = 4) -> list[Solution]:
    """The best solutions of a level, one per set of names."""
    out: list[Solution] = []
    for s in sorted(grown, key=lambda s: s.score):
        if all(sorted(s.names) != sorted(o.names) for o in out):
            out.append(s)
    return out[:width]


def _adequacies(laboratory: Laboratory, solution: Solution) -> tuple[Adequacy, ...]:
    return tuple(examine(laboratory, solution.fit, s) for s in range(len(laboratory.series)))


def _adequate(now: Sequence[Adequacy], base: Sequence[Adequacy]) -> bool:
    return all(
        a.adequate or a.misfit_px < _LEFT * b.misfit_px for a, b in zip(now, base, strict=True)
    )
