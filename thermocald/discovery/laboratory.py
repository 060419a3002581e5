"""The laboratory: the series under examination, in which hypotheses are fitted.

Linear coefficients come from generalised least squares under the likelihood of `likelihood`,
non-linear ones by Gauss-Newton on the same normal equations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.evidence import COLUMNS
from thermocald.discovery.hypothesis import BASE, EVENTS, OSCILLATIONS, Block, Fit, Term
from thermocald.discovery.likelihood import Carried, Reduced, Weighting, prepare
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.discovery.evidence import Evidence
    from thermocald.simulation.history import History

    Array = NDArray[np.float64]

__all__ = ["Laboratory"]

# relative standard deviation with which the readings themselves tell their noise
_NOISE_KNOWN = 0.05


class Laboratory:
    """The series under examination, and everything that is computed once for all hypotheses."""

    def __init__(self, series: Sequence[Evidence]) -> None:
        self.series = tuple(series)
        self.thermometer_factor = 1.0
        self._courses: dict[Any, tuple[Array, Array | None, str]] = {}
        self._drives: dict[Any, tuple[Array, Array]] = {}

    def share_courses(self, other: Laboratory) -> None:
        """Use the courses that a laboratory of the same histories has computed."""
        self._courses, self._drives = other._courses, other._drives

    # -- courses ---------------------------------------------------------------------------

    def drive(self, terms: Sequence[Term], series: int) -> tuple[Array, Array]:
        """The course (E,) that drives the linear terms, and its operator (E, states)."""
        key = (series, tuple((t.effect, t.nonlinear) for t in terms if t.is_drive))
        if key not in self._drives:
            evidence = self.series[series]
            history, operator = self._through(terms, series, last=False)
            drives = [t for t in terms if t.is_drive]
            if drives:
                effect, values = catalogue.get(drives[-1].effect), drives[-1].values(series) or {}
                course = effect.drive(history, **values)
                own = effect.sensitivity(history, **values)
            else:
                course, own = history.temperature(), history.temperature_matrix()
            whole = own if operator is None else own @ operator
            if len(self._drives) > 60:
                self._drives.clear()
            self._drives[key] = (
                evidence.averaged(course),
                evidence.states(history.reference, whole),
            )
        return self._drives[key]

    def drive_course(self, terms: Sequence[Term], series: int) -> Array:
        """The course (E,) alone: for scanning, where no operator is needed."""
        history, _ = self._through(terms, series, last=False, operators=False)
        drives = [t for t in terms if t.is_drive]
        course = history.temperature()
        if drives:
            course = catalogue.get(drives[-1].effect).drive(
                history, **(drives[-1].values(series) or {})
            )
        return self.series[series].averaged(course)

    def _through(
        self, terms: Sequence[Term], series: int, last: bool, operators: bool = True
    ) -> tuple[History, csr_array | None]:
        """The history with its reference sent through the drives (but for the last, unless asked),
        and the matrix from the knots' errors to what they are then.
        """
        history = self.series[series].history
        drives = [t for t in terms if t.is_drive]
        operator: csr_array | None = None
        for term in drives if last else drives[:-1]:
            effect, values = catalogue.get(term.effect), term.values(series) or {}
            at_knots = history.at(history.reading_times)
            if operators:
                own = effect.sensitivity(at_knots, **values)
                operator = own if operator is None else own @ operator
            history = history.with_reference(effect.drive(at_knots, **values))
        return history, operator

    def courses(
        self, term: Term, series: int, terms: Sequence[Term] = (), operators: bool = True
    ) -> tuple[Array, Array | None, str]:
        """Courses (E, m) of a signal, operator (E, states) of the first or None, channel."""
        effect = catalogue.get(term.effect)
        values = term.values(series)
        evidence = self.series[series]
        if values is None:
            return np.zeros((len(evidence.times), 1)), None, evidence.history.reference
        drives = tuple((t.effect, t.nonlinear) for t in terms if t.is_drive)
        through = term.through_drive and bool(drives)
        key = (
            series, term.effect, tuple(sorted(values.items())), drives if through else None,
            operators,
        )  # fmt: skip
        if key not in self._courses:
            history = evidence.history
            before: csr_array | None = None
            if through:
                history, before = self._through(terms, series, last=True)
            course = evidence.averaged(effect.signal(history, **values))
            operator = None
            channel = effect.channel(history, **values)
            if operators and course.shape[1] == 1:
                sparse = effect.sensitivity(history, **values)
                if sparse.nnz:
                    whole = sparse if before is None else sparse @ before
                    operator = evidence.states(channel, whole)
            if len(self._courses) > 600:
                self._courses.clear()
            self._courses[key] = (course, operator, channel)
        return self._courses[key]

    # -- fitting ---------------------------------------------------------------------------

    def _layout(self, terms: Sequence[Term]) -> tuple[list[Block], int]:
        blocks = [Block(-1, None, 0, 1, BASE)]
        start = len(BASE)
        for i, term in enumerate(terms):
            if term.is_drive:
                continue
            separate = term.effect in EVENTS + OSCILLATIONS
            m = 2 if term.effect in OSCILLATIONS else 1
            for s in range(len(self.series)) if separate else (None,):
                if s is not None and term.values(s) is None:
                    continue
                blocks.append(Block(i, s, start, m, term.parameters))
                start = blocks[-1].stop
        return blocks, start

    def design(
        self, terms: Sequence[Term], blocks: Sequence[Block], series: int
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Courses (E, K), directions (P, K) and places in the unknowns (K,) of one series."""
        columns: list[Array] = []
        directions: list[Array] = []
        index: list[int] = []
        for block in blocks:
            if block.series not in (None, series):
                continue
            if block.term < 0:
                course = self.drive(terms, series)[0][:, None]
            else:
                course = self.courses(terms[block.term], series, terms, operators=False)[0]
            course = course - course.mean(axis=0)  # conditioning; the level is eliminated anyway
            for m in range(block.courses):
                for j, name in enumerate(block.parameters):
                    unit = np.zeros(len(COLUMNS))
                    unit[COLUMNS.index(name)] = 1.0
                    columns.append(course[:, m])
                    directions.append(unit)
                    index.append(block.start + m * len(block.parameters) + j)
        return np.stack(columns, axis=1), np.stack(directions, axis=1), np.array(index)

    def weighting(
        self, terms: Sequence[Term], blocks: Sequence[Block], x: Array, series: int
    ) -> Weighting:
        """The covariance of a series at some coefficients."""
        carried = []
        for block in blocks:
            if block.series not in (None, series) or block.courses > 1:
                continue
            d = np.zeros(len(COLUMNS))
            d[[COLUMNS.index(p) for p in block.parameters]] = x[block.start : block.stop]
            if block.term < 0:
                operator: Array | None = self.drive(terms, series)[1]
                channel = self.series[series].history.reference
            else:
                _, operator, channel = self.courses(terms[block.term], series, terms)
            if operator is not None and d.any():
                unresolved = self._unresolved(terms, block, series)
                carried.append(Carried(d, operator, channel, unresolved))
        return prepare(self.series[series], carried, self.thermometer_factor)

    def _unresolved(self, terms: Sequence[Term], block: Block, series: int) -> Array | None:
        """What a course leaves open at single epochs (E,), beside the readings' errors; or None.

        The rate beside a switched lamp; where a play turns, which reading was the extreme.
        """
        evidence = self.series[series]
        history = evidence.history
        instrument = evidence.channels[history.reference]
        if block.term >= 0:
            if terms[block.term].effect != "thermal_gradient":
                return None
            return instrument.slope_jump(evidence.times)
        drives = [t for t in terms if t.is_drive]
        if not drives:
            return None
        before, _ = self._through(terms, series, last=False, operators=False)
        last = catalogue.get(drives[-1].effect)
        turns = last.turns(before, **(drives[-1].values(series) or {}))
        if not turns.any():
            return None
        step = float(np.median(np.diff(history.reading_times[instrument.real])))
        bend = 0.5 * step * instrument.slope_jump(evidence.times)
        shares = evidence.averaged(turns.astype(float))
        out: Array = shares * np.sqrt(instrument.noise**2 + bend**2)
        return out

    def fit(
        self,
        terms: Sequence[Term],
        start: Array | None = None,
        turns: int = 3,
        only: Sequence[int] | None = None,
    ) -> Fit:
        """Linear coefficients of a hypothesis; the covariance follows them, `turns` times.

        only: the series that decide (default all); the others are evaluated.
        """
        terms = tuple(terms)
        blocks, K = self._layout(terms)
        which = range(len(self.series))
        designs = [self.design(terms, blocks, s) for s in which]
        x = np.zeros(K) if start is None or len(start) != K else start
        weightings: list[Weighting] = []
        reduced: list[Reduced] = []
        A, c = np.zeros((K, K)), np.zeros(K)
        for turn in range(turns + (0 if x.any() else 1)):
            weightings = [self.weighting(terms, blocks, x, s) for s in which]
            reduced = [w.reduce(d[0], d[1]) for w, d in zip(weightings, designs, strict=True)]
            A, c = np.zeros((K, K)), np.zeros(K)
            for s in which if only is None else only:
                index = designs[s][2]
                A[np.ix_(index, index)] += reduced[s].A
                c[index] += reduced[s].c
            new = _solve(A, c)
            done = turn > 0 and np.max(np.abs(new - x)) <= 1e-3 * np.max(np.abs(new))
            x = new
            if done:
                break
        fitted = Fit(
            terms, tuple(blocks), x, _inverse(A), 0.0, 0.0, tuple(weightings), tuple(designs),
            tuple(reduced),
        )  # fmt: skip
        chosen = which if only is None else only
        return replace(
            fitted,
            chi2=sum(fitted.chi2_of(s) for s in chosen),
            logdet=sum(reduced[s].logdet for s in chosen),
        )

    def thermometer_scale(self, fit: Fit) -> tuple[float, float]:
        """The factor of the readings' noise that makes a hypothesis most likely, and the objective
        there. Hypotheses that smooth the readings more than others are else told apart by nothing
        but an error of the noise.
        """
        from scipy.optimize import minimize_scalar

        kept = self.thermometer_factor

        def objective(log_factor: float) -> float:
            self.thermometer_factor = kept * float(np.exp(log_factor))
            here = self.fit(fit.terms, fit.coefficients, 1).objective
            return here + (log_factor / _NOISE_KNOWN) ** 2

        try:
            found = minimize_scalar(
                objective, bounds=(-0.5, 0.5), method="bounded", options={"xatol": 0.02}
            )
        finally:
            self.thermometer_factor = kept
        return kept * float(np.exp(found.x)), float(found.fun)

    # -- non-linear parameters ------------------------------------------------------------

    def searched(self, terms: Sequence[Term]) -> list[tuple[int, str]]:
        """The shared numeric non-linear parameters of a hypothesis."""
        return [
            (i, name)
            for i, term in enumerate(terms)
            for name, value in term.nonlinear
            if isinstance(value, float)
        ]

    def _derivatives(
        self, fit: Fit, searched: Sequence[tuple[int, str]], series: int
    ) -> tuple[Array, Array, Array]:
        """Columns of ∂(prediction)/∂(non-linear): courses (E, D), directions (P, D), map (D, L)."""
        courses: list[Array] = []
        directions: list[Array] = []
        owner: list[int] = []
        for position, (i, name) in enumerate(searched):
            value = dict(fit.terms[i].nonlinear)[name]
            step = _step(fit.terms[i].effect, name, value)
            sides = []
            for sign in (1.0, -1.0):
                terms = list(fit.terms)
                terms[i] = terms[i].with_value(name, value + sign * step)
                sides.append(self.design(terms, fit.blocks, series)[0])
            slope = (sides[0] - sides[1]) / (2 * step)
            _, V, index = fit.designs[series]
            for k in np.flatnonzero(np.abs(slope).max(axis=0) > 0):
                courses.append(slope[:, k])
                directions.append(V[:, k] * fit.coefficients[index[k]])
                owner.append(position)
        if not courses:
            E, P = fit.designs[series][0].shape[0], len(COLUMNS)
            return np.zeros((E, 0)), np.zeros((P, 0)), np.zeros((0, len(searched)))
        mapping = np.zeros((len(owner), len(searched)))
        mapping[np.arange(len(owner)), owner] = 1.0
        return np.stack(courses, axis=1), np.stack(directions, axis=1), mapping

    def normal_equations(
        self, fit: Fit, only: Sequence[int] | None = None
    ) -> tuple[Array, Array, list[tuple[int, str]]]:
        """A (K + L, K + L) and gradient (K + L,) with the non-linear parameters as unknowns."""
        searched = self.searched(fit.terms)
        K, L = len(fit.coefficients), len(searched)
        A, g = np.zeros((K + L, K + L)), np.zeros(K + L)
        for s in range(len(self.series)) if only is None else only:
            C, V, index = fit.designs[s]
            dC, dV, mapping = self._derivatives(fit, searched, s)
            joint = fit.weightings[s].reduce(np.hstack([C, dC]), np.hstack([V, dV]))
            T = np.zeros((C.shape[1] + dC.shape[1], K + L))
            T[np.arange(C.shape[1]), index] = 1.0
            T[C.shape[1] :, K:] = mapping
            at = np.zeros(T.shape[0])
            at[: C.shape[1]] = fit.coefficients[index]
            A += T.T @ joint.A @ T
            g += T.T @ (joint.c - joint.A @ at)
        return A, g, searched

    def refine(self, fit: Fit, turns: int = 6, only: Sequence[int] | None = None) -> Fit:
        """Gauss-Newton on the non-linear parameters; never makes the objective worse."""
        searched = self.searched(fit.terms)
        if searched:
            for _ in range(turns):
                A, g, _ = self.normal_equations(fit, only)
                step = _solve(A, g)[len(fit.coefficients) :]
                improved = False
                for damping in (1.0, 0.3, 0.1):
                    terms = list(fit.terms)
                    for (i, name), d in zip(searched, damping * step, strict=True):
                        old = dict(terms[i].nonlinear)[name]
                        terms[i] = terms[i].with_value(
                            name, _bounded(terms[i].effect, name, old, old + float(d))
                        )
                    trial = self.fit(terms, fit.coefficients, 2, only)
                    if trial.objective < fit.objective:
                        gain, fit, improved = fit.objective - trial.objective, trial, True
                        break
                if not improved or gain < 0.05:
                    break
        A, _, searched = self.normal_equations(fit, only)
        return replace(fit, covariance=_inverse(A), searched=tuple(searched))


def _step(effect: str, name: str, value: float) -> float:
    """A step for differences, small against the parameter's effect and large against rounding."""
    if catalogue.get(effect).nonlinear[name].log:
        return 1e-3 * max(abs(value), 1e-6)
    return {"T_k": 0.02, "d": 0.05}.get(name, 1e-3)


def _bounded(effect: str, name: str, old: float, new: float) -> float:
    parameter = catalogue.get(effect).nonlinear[name]
    if parameter.log:
        # the bounds are of what a simulation makes sense of; data may ask for less
        return float(
            np.clip(np.clip(new, old / 2.0, old * 2.0), 0.1 * parameter.low, parameter.high)
        )
    return float(np.clip(new, parameter.low, parameter.high))


def _solve(A: Array, c: Array) -> Array:
    empty = np.diag(A) <= 0  # columns of series that take no part
    A = A + np.diag(empty.astype(float))
    d = np.sqrt(np.diag(A))
    x: Array = np.linalg.solve(A / np.outer(d, d) + 1e-12 * np.eye(len(A)), c / d) / d
    return x


def _inverse(A: Array) -> Array:
    A = A + np.diag((np.diag(A) <= 0).astype(float))
    d = np.sqrt(np.diag(A))
    x: Array = np.linalg.inv(A / np.outer(d, d) + 1e-12 * np.eye(len(A))) / np.outer(d, d)
    return x
