"""The search: all candidates compete, combinations grow step by step, superfluous effects go.

A scan over each candidate's grid costs one matrix product on the epochs' normal equations; the
best are fitted in full, with the thermometer's error carried through them. The score is

    -2 log L + Σ over effects (coefficients · ln n + 2 ln(trials) + 2 ln(candidates) + margin),

n the number of epochs, trials the number of independent places the scan looked at.

Source: Schwarz (1978), Annals of Statistics 6, 461-464; the trials as Gross, Vitells (2010),
European Physical Journal C 70, 525-530 (look-elsewhere effect).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.search.candidates import Candidate, candidates
from thermocald.reduction.hypothesis import BASE, Fit, Term
from thermocald.reduction.series import COLUMNS
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.reduction.fit import HypothesisFitter

    Array = NDArray[np.float64]

__all__ = ["MARGIN", "Scanned", "Search", "Solution"]

# beyond the penalty for the search: what errors of the noise model itself may feign
MARGIN = 16.0
# of an effect's best parameter set that another of its sets has to promise
_SET_FRACTION = 0.95


@dataclass(frozen=True, eq=False)
class Scanned:
    """What a scan of one candidate promises: the best term, gain in χ², penalty."""

    candidate: Candidate
    term: Term
    gain: float
    penalty: float

    @property
    def net(self) -> float:
        return self.gain - self.penalty


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted hypothesis with its penalty; the smaller the score the better."""

    fit: Fit
    penalties: tuple[float, ...]

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.fit.terms

    @property
    def score(self) -> float:
        return self.fit.objective + sum(self.penalties)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(t.effect for t in self.fit.terms)


class Search:
    """One examination of a fitter's series."""

    def __init__(
        self, fitter: HypothesisFitter, progress: Callable[[str], None] | None = None
    ) -> None:
        self.fitter = fitter
        self.candidates = candidates(fitter.series)
        self.epochs = sum(int((e.n > 0).sum()) for e in fitter.series)
        # the more noise is correlated, the less is known of it
        self.margin = MARGIN * max(e.correlation for e in fitter.series)
        self.progress = progress or (lambda _: None)
        self._trials: dict[tuple[str, tuple[str, ...]], float] = {}
        self._trajectories: dict[tuple[int, int], Array] = {}
        self._refined: dict[tuple[Term, ...], Fit] = {}

    def base(self, given: Sequence[tuple[str, dict[str, Any]]] = ()) -> Solution:
        """The base model, with the effects that a model has already, fitted."""
        if not given:
            return Solution(self.fitter.fit(()), ())
        terms = tuple(_given_term(name, values, len(self.fitter.series)) for name, values in given)
        return Solution(self.fitter.refine(self.fitter.fit(terms)), (0.0,) * len(terms))

    # -- scanning --------------------------------------------------------------------------

    def _stack(self, number: int, series: int, fit: Fit) -> Array:
        """Trajectories (G, E, m) of a candidate over its grid in one series."""
        candidate = self.candidates[number]
        fitter = self.fitter
        drives = [t for t in fit.terms if t.is_drive]
        key = (number, series)
        if key in self._trajectories and not (candidate.is_drive and drives):
            return self._trajectories[key]
        rows = []
        if candidate.is_event:
            times = fitter.series[series].times
            return (times[None, :, None] >= times[1:, None, None]).astype(float)
        for value in candidate.grid if len(candidate.grid) else [None]:
            term = candidate.term(value, len(fitter.series))
            if candidate.is_drive:
                rows.append(fitter.drive_trajectory([*drives, term], series)[:, None])
            else:
                rows.append(fitter.trajectories(term, series, operators=False)[0])
        stack: Array = np.stack(rows)
        stack -= stack.mean(axis=1, keepdims=True)
        if not (candidate.is_drive and drives):
            self._trajectories[key] = stack
        return stack

    def scan(self, number: int, solution: Solution) -> Scanned | None:
        """The best place of one candidate added to a solution."""
        candidate, fit = self.candidates[number], solution.fit
        series = range(len(self.fitter.series))
        directions = np.zeros((len(COLUMNS), len(candidate.parameters)))
        for j, name in enumerate(candidate.parameters):
            directions[COLUMNS.index(name), j] = 1.0
        K = len(fit.coefficients)
        parts = []
        base_A, base_c = np.zeros((K, K)), np.zeros(K)
        for s in series:
            C, V, index = fit.designs[s]
            stack = self._stack(number, s, fit)
            A, c, B = fit.weightings[s].scan(stack, directions, (C, V))
            full = np.zeros((*c.shape, K))
            full[..., index] = B
            parts.append((A, c, full))
            base_A[np.ix_(index, index)] += fit.reduced[s].A
            base_c[index] += fit.reduced[s].c
        count = len(candidate.parameters)
        reference = float(base_c @ _solve(base_A, base_c[:, None])[:, 0])
        if candidate.is_drive:
            # the drive takes the place of T: the base's own rates leave
            keep = np.arange(len(BASE), K)
            base_A, base_c = base_A[np.ix_(keep, keep)], base_c[keep]
            parts = [(A, c, B[..., keep]) for A, c, B in parts]
            count = 0
        rest = float(base_c @ _solve(base_A, base_c[:, None])[:, 0]) if len(base_c) else 0.0
        if candidate.is_event:
            return self._event(candidate, parts, base_A, base_c, count)
        if candidate.is_periodic and len(parts) > 1:
            gains = sum(_gain([p], base_A, base_c) for p in parts)
            count *= 2 * len(parts)
        else:
            gains = _gain(parts, base_A, base_c)
            count *= 2 if candidate.is_periodic else 1
        gains = np.asarray(gains) + rest - reference
        best = int(np.argmax(gains))
        value = float(candidate.grid[best]) if len(candidate.grid) else None
        term = candidate.term(value, len(parts))
        return Scanned(candidate, term, float(gains[best]), self._penalty(candidate, count))

    def _event(
        self, candidate: Candidate, parts: list[tuple[Array, Array, Array]],
        base_A: Array, base_c: Array, count: int,
    ) -> Scanned:  # fmt: skip
        """An event may have come in each series, at its own time, or not at all."""
        fresh: list[tuple[tuple[str, float], ...] | None] = []
        total, penalty = 0.0, 0.0
        single = count * np.log(self.epochs) + 2 * np.log(self.epochs)
        for s, part in enumerate(parts):
            gains = _gain([part], base_A, base_c)
            gains = np.where(np.isfinite(gains), gains, 0.0)
            best = int(np.argmax(gains))
            if gains[best] > single + self.margin or s == 0:
                fresh.append(((candidate.name, float(self.fitter.series[s].times[best + 1])),))
                total += float(gains[best])
                penalty += single
            else:
                fresh.append(None)
        term = replace(candidate.term(None, len(parts)), fresh=tuple(fresh))
        return Scanned(candidate, term, total, penalty + self._once())

    def _once(self) -> float:
        return 2 * float(np.log(len(self.candidates))) + self.margin

    def _penalty(self, candidate: Candidate, count: int) -> float:
        key = (candidate.effect, candidate.parameters)
        if key not in self._trials:
            number = self.candidates.index(candidate)
            stack = self._trajectories.get((number, 0))
            trials = float(len(candidate.grid)) if len(candidate.grid) else 1.0
            if stack is not None and len(stack) > 1:
                trials = _independent(stack)
            self._trials[key] = trials
        searched = np.log(self.epochs) if len(candidate.grid) else 0.0
        return float(
            count * np.log(self.epochs)
            + searched
            + 2 * np.log(max(self._trials[key], 1.0))
            + self._once()
        )

    # -- growing and shrinking ----------------------------------------------------------------

    def refine(self, terms: Sequence[Term], penalties: Sequence[float]) -> Solution:
        """Fit a hypothesis in full, once; its penalties depend on how it was found."""
        key = tuple(terms)
        if key not in self._refined:
            self._refined[key] = self.fitter.refine(self.fitter.fit(terms), max_iterations=5)
        return Solution(self._refined[key], tuple(penalties))

    def expand(self, solution: Solution, width: int = 6) -> list[Solution]:
        """The best solutions with one effect more, best first."""
        promises = []
        for number, candidate in enumerate(self.candidates):
            taken = [t for t in solution.terms if t.effect == candidate.effect]
            if taken:
                continue
            found = self.scan(number, solution)
            if found is not None and np.isfinite(found.gain):
                promises.append(found)
        grown = [
            self.refine((*solution.terms, promise.term), (*solution.penalties, promise.penalty))
            for promise in _worth_fitting(promises, width)
        ]
        grown.sort(key=lambda s: s.score)
        return grown

    def shrink(self, solution: Solution, kept: int = 0) -> Solution:
        """Without every effect that is no longer worth its penalty; the first `kept` stay."""
        while len(solution.terms) > kept + 1:
            fewer = []
            for i in range(kept, len(solution.terms)):
                terms = tuple(t for j, t in enumerate(solution.terms) if j != i)
                penalties = tuple(p for j, p in enumerate(solution.penalties) if j != i)
                fewer.append(self.refine(terms, penalties))
            best = min(fewer, key=lambda s: s.score)
            if best.score > solution.score:
                break
            solution = best
        return solution


def _worth_fitting(promises: Sequence[Scanned], width: int) -> list[Scanned]:
    """The `width` most promising effects, each with the sets that promise as much as its best.

    A scan is right to some percent, with a drive to half: what promises a tenth cannot win.
    """
    ordered = sorted((p for p in promises if p.net > 0), key=lambda p: -p.net)
    out: list[Scanned] = []
    best: dict[str, float] = {}
    for p in ordered:
        name = p.candidate.effect
        if name in best:
            if p.net > _SET_FRACTION * best[name]:
                out.append(p)
        elif len(best) < width and (len(best) < 3 or p.net >= 0.1 * ordered[0].net):
            best[name] = p.net
            out.append(p)
    return out


def _given_term(name: str, values: dict[str, Any], series: int) -> Term:
    """A term of an effect that a model holds: its non-linear values as a start."""
    effect = catalogue.get(name)
    parameters = tuple(effect.column(p) for p in effect.linear if p in values)
    shared = tuple(
        (k, v if isinstance(v, str) else float(v))
        for k, v in values.items()
        if k in effect.nonlinear and k not in effect.fresh
    )
    fresh: tuple[tuple[tuple[str, Any], ...] | None, ...] = ()
    if effect.is_event:
        own = tuple((k, float(values[k])) for k in effect.fresh if k in values)
        fresh = (own, *(None,) * (series - 1))
    return Term(name, parameters or BASE, shared, fresh)


def _gain(parts: list[tuple[Array, Array, Array]], base_A: Array, base_c: Array) -> Array:
    """χ² explained by candidates (G,) beyond the base."""
    A = sum(p[0] for p in parts)
    c = sum(p[1] for p in parts)
    B = sum(p[2] for p in parts)
    assert not isinstance(A, int)
    assert not isinstance(c, int)
    assert not isinstance(B, int)
    if len(base_c):
        X = _solve(base_A, np.column_stack([base_c, B.reshape(-1, len(base_c)).T]))
        c = c - B @ X[:, 0]
        BX = np.einsum("gir,rgj->gij", B, X[:, 1:].reshape(len(base_c), *c.shape))
        A = A - BX
    scale = np.sqrt(np.maximum(np.einsum("gii->gi", A), 1e-12))
    own = A / scale[:, :, None] / scale[:, None, :]
    own = own + 1e-9 * np.eye(A.shape[-1])
    right = c / scale
    weak = scale.min(axis=1) < 1e-3
    out: Array = np.einsum("gi,gi->g", right, np.linalg.solve(own, right[..., None])[..., 0])
    return np.where(weak, -np.inf, out)


def _solve(A: Array, right: Array) -> Array:
    if not len(A):
        return np.zeros((0, right.shape[1]))
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    x: Array = (
        np.linalg.solve(A / np.outer(d, d) + 1e-12 * np.eye(len(A)), right / d[:, None])
        / d[:, None]
    )
    return x


def _independent(stack: Array) -> float:
    """How many independent trajectories a grid (G, E, m) holds: its length in angles over 90°."""
    s = stack[..., 0]
    s = s - s.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(s, axis=1)
    cosine = np.sum(s[1:] * s[:-1], axis=1) / np.maximum(norm[1:] * norm[:-1], 1e-12)
    return 1.0 + float(np.sum(np.arccos(np.clip(np.abs(cosine), 0, 1)))) / (np.pi / 2)
