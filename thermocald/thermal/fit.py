"""The fit of hypotheses to series: generalised least squares and Gauss-Newton.

Linear coefficients are estimated by generalised least squares with the likelihood of `likelihood`,
non-linear parameters by Gauss-Newton with the same normal equations.

The distortion of a warming camera follows either the angle or the place in the image; both bases
have equally many unknowns. The basis is chosen before any hypothesis is fitted: the camera and, if
that pays for its unknowns, the mount move along a straight line in the temperature and some cosines
in time, and the basis that leaves less is chosen if the difference is significant.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import explained, scaled_inverse, scaled_solve
from thermocald.physics import catalogue
from thermocald.physics.catalogue import drive, drive_matrix, driven_history
from thermocald.physics.model import BASES, Distortion, choose_basis
from thermocald.thermal.hypothesis import BASE, Block, Fit, Term
from thermocald.thermal.likelihood import Weighting, prepare
from thermocald.thermal.series import Carried, ReducedSeries, cosines, unit_directions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.thermal.hypothesis import Candidate


T = TypeVar("T")

# relative standard deviation of the readings' noise, as estimated from the readings alone
_NOISE_KNOWN = 0.05

_RIDGE = 1e-12  # of a unit diagonal: constrains coefficients that no series determines

_ENDS = 0.01  # share of the recorded temperatures at either end in which a knee is a straight line
_PERIODS = 1.6  # least number of periods in a series; a scan begins at 1.8


class HypothesisFitter:
    """The fitter of hypotheses to some series, with what all hypotheses have in common.

    like: a fitter of the same histories, whose trajectories are shared; stacks: those of scans.
    """

    def __init__(
        self, series: Sequence[ReducedSeries], like: HypothesisFitter | None = None
    ) -> None:
        self.series = tuple(series)
        self.thermometer_factor: float = like.thermometer_factor if like else 1.0
        self.stacks: dict[tuple[Candidate, int], Array] = like.stacks if like else {}
        self.held: frozenset[str] = frozenset()  # non-linear parameters, such as `effect.tau`
        self.priors: dict[str, tuple[float, float]] = {}  # {non-linear parameter: value, sd}
        self._caches: dict[str, dict[Any, Any]] = like._caches if like else {}

    def _once(self, what: str, key: Any, compute: Callable[[], T], most: int = 60) -> T:
        """Compute a value once; a cache with more than `most` values is emptied first."""
        cache = self._caches.setdefault(what, {})
        if key not in cache:
            if len(cache) > most:
                cache.clear()
            cache[key] = compute()
        value: T = cache[key]
        return value

    def _carry(self, series: int, channel: str, operator: csr_array) -> Carried:
        """Return what readings do to a trajectory; equal operators share one."""
        operator.sort_indices()
        key = (series, channel, operator.data.tobytes(), operator.indices.tobytes())
        return self._once("states", key, lambda: self.series[series].carry(channel, operator))

    # -- trajectories ---------------------------------------------------------------------------

    def drive(self, terms: Sequence[Term], series: int) -> tuple[Array, Carried]:
        """Return the trajectory (E,) of the linear terms, and what readings do to it."""
        drives = _drives(terms, series)

        def compute() -> tuple[Array, Carried]:
            reduced = self.series[series]
            operator = drive_matrix(reduced.history, drives, reduced.averages)
            carried = self._carry(series, reduced.history.reference, operator)
            return self.drive_trajectory(terms, series), carried

        key = (series, tuple((name, tuple(values.items())) for name, values in drives))
        return self._once("drive", key, compute)

    def drive_trajectory(self, terms: Sequence[Term], series: int) -> Array:
        """Return the trajectory (E,) of the linear terms without its operator, for scans."""
        reduced = self.series[series]
        return reduced.averaged(drive(reduced.history, _drives(terms, series)))

    def trajectories(
        self, term: Term, series: int, terms: Sequence[Term] = (), operators: bool = True
    ) -> tuple[Array, list[tuple[Carried, str]]]:
        """Return a signal's trajectories (E, m), and what readings of each channel do to it.

        The latter is missing if there are several trajectories, if the readings' errors do not
        reach the signal, or without `operators`.
        """
        effect = catalogue.get(term.effect)
        values = term.values(series)
        evidence = self.series[series]
        if values is None:
            return np.zeros((len(evidence.times), 1)), []
        drives = tuple((t.effect, t.nonlinear) for t in terms if t.kind.is_drive)
        through = term.through_drive and bool(drives)
        key = (
            series, term.effect, tuple(sorted(values.items())), drives if through else None,
            operators,
        )  # fmt: skip

        def compute() -> tuple[Array, list[tuple[Carried, str]]]:
            chain = _drives(terms, series) if through else ()
            own, history = evidence.history, driven_history(evidence.history, chain)
            trajectory = evidence.averaged(effect.signal(history, **values))
            found: list[tuple[Carried, str]] = []
            if operators and trajectory.shape[1] == 1:
                by_channel = effect.sensitivities(history, evidence.averages, **values)
                for channel, matrix in by_channel.items():
                    if matrix.nnz and chain and channel == own.reference:
                        matrix = drive_matrix(own.at(own.reading_times), chain, matrix)
                    if matrix.nnz:
                        found.append((self._carry(series, channel, matrix), channel))
            return trajectory, found

        return self._once("trajectory", key, compute, 600)

    def list_operators(
        self, terms: Sequence[Term], blocks: Sequence[Block], series: int
    ) -> Iterator[tuple[Block, Carried, str]]:
        """Yield each block with what the readings of each channel do to it."""
        for block in blocks:
            if block.series not in (None, series) or block.trajectories > 1:
                continue
            if block.term < 0:
                reference = self.series[series].history.reference
                yield block, self.drive(terms, series)[1], reference
                continue
            for reach, channel in self.trajectories(terms[block.term], series, terms)[1]:
                yield block, reach, channel

    # -- fitting ---------------------------------------------------------------------------

    def _layout(self, terms: Sequence[Term]) -> tuple[list[Block], int]:
        blocks = [Block(-1, None, 0, 1, BASE)]
        start = len(BASE)
        for i, term in enumerate(terms):
            if term.kind.is_drive:
                continue
            m = 2 if term.kind.is_periodic else 1
            for s in range(len(self.series)) if term.is_separate else (None,):
                if s is not None and term.values(s) is None:
                    continue
                blocks.append(Block(i, s, start, m, term.parameters))
                start = blocks[-1].stop
        return blocks, start

    def design(
        self, terms: Sequence[Term], blocks: Sequence[Block], series: int, centred: bool = True
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return a series' trajectories (E, K), directions (P, K) and indices of unknowns (K,).

        centred: whether the means are subtracted, for conditioning, as the levels are eliminated
        anyway; otherwise the trajectories are the model's, 0 at T0.
        """
        columns: list[Array] = []
        names: list[str] = []
        index: list[int] = []
        for block in blocks:
            if block.series not in (None, series):
                continue
            if block.term < 0:
                trajectory = self.drive(terms, series)[0][:, None] - self.series[series].T0
            else:
                trajectory = self.trajectories(terms[block.term], series, terms, operators=False)[0]
            if centred:
                trajectory = trajectory - trajectory.mean(axis=0)
            for m in range(block.trajectories):
                columns += [trajectory[:, m]] * len(block.parameters)
                names += block.parameters
            index += range(block.start, block.stop)
        return np.stack(columns, axis=1), unit_directions(names), np.array(index)

    def weighting(
        self, terms: Sequence[Term], blocks: Sequence[Block], x: Array, series: int
    ) -> Weighting:
        """Return the weighting of a series with the covariance for some coefficients."""
        carried: dict[int, tuple[Array, Carried, str]] = {}  # each once, directions added
        unresolved: dict[int, tuple[Array, Array]] = {}
        for block, reach, channel in self.list_operators(terms, blocks, series):
            (d,) = block.directions(x)
            if d.any():
                before, *_ = carried.get(id(reach), (0.0,))
                carried[id(reach)] = (d + before, reach, channel)
                unresolved[block.start] = d, self._unresolved(terms, block, series)
        factor = self.thermometer_factor
        bends = [*unresolved.values(), *((d, factor * c.sd) for d, c, _ in carried.values())]
        return prepare(self.series[series], list(carried.values()), bends, factor)

    def _unresolved(self, terms: Sequence[Term], block: Block, series: int) -> Array:
        """Return the sd (E,) of a trajectory beyond the readings' errors.

        It is that of the rate next to a switched lamp, of the temperature between the readings
        there, and of the extreme reading where a play turns.
        """
        evidence = self.series[series]
        history = evidence.history
        instrument = evidence.thermometers[history.reference]
        if block.term >= 0:
            term = terms[block.term]
            values = term.values(series) or {}
            # the rows' times represent the frames of a long series
            here = history.at(evidence.times)
            return term.kind.unresolved(here, self._slope_jump(series), **values)
        nothing: Array = np.zeros(len(evidence.times))
        drives = _drives(terms, series)
        delays = [
            float(values[key])
            for name, values in drives
            for key, p in catalogue.get(name).nonlinear.items()
            if p.role == "delay"
        ]
        if len(delays) == len(drives):  # a memory smooths what happens between two readings
            if evidence.slope_jumps is None:
                return nothing
            between = instrument.between(history.times, evidence.slope_jumps, sum(delays))
            return evidence.averaged(between)
        before = driven_history(history, drives[:-1])
        name, values = drives[-1]
        turns = catalogue.get(name).turns(before, **values)
        if not turns.any():
            return nothing
        step = float(np.median(np.diff(history.reading_times[instrument.real])))
        bend = 0.5 * step * self._slope_jump(series)
        shares = evidence.averaged(turns.astype(float))
        return np.asarray(shares * np.sqrt(instrument.noise**2 + bend**2))

    def _slope_jump(self, series: int) -> Array:
        """Return the sd (E,) of the reference temperature's rate due to its jumps."""
        evidence = self.series[series]
        instrument = evidence.thermometers[evidence.history.reference]
        return self._once("slope", series, lambda: instrument.slope_jump(evidence.times))

    def fit(
        self,
        terms: Sequence[Term],
        start: Array | None = None,
        max_iterations: int = 3,
        only: Sequence[int] | None = None,
    ) -> Fit:
        """Fit a hypothesis's linear coefficients; the covariance is updated in each iteration.

        only: the series to fit (default: all); the others are only evaluated.
        """
        terms = tuple(terms)
        blocks, K = self._layout(terms)
        which = range(len(self.series))
        designs = [self.design(terms, blocks, s) for s in which]
        x = np.zeros(K) if start is None or len(start) != K else start
        for turn in range(max_iterations + (0 if x.any() else 1)):
            weightings = [self.weighting(terms, blocks, x, s) for s in which]
            reduced = [w.reduce(d[0], d[1]) for w, d in zip(weightings, designs, strict=True)]
            fitted = Fit(
                terms, tuple(blocks), x, np.zeros((K, K)), 0.0, 0.0, tuple(weightings),
                tuple(designs), tuple(reduced),
            )  # fmt: skip
            A, c = fitted.normals(only)
            new = scaled_solve(A, c, _RIDGE)
            done = turn > 0 and np.max(np.abs(new - x)) <= 1e-3 * np.max(np.abs(new))
            x = new
            if done:
                break
        chosen = which if only is None else only
        return replace(
            fitted,
            coefficients=x,
            covariance=scaled_inverse(A, _RIDGE),
            chi2=sum(fitted.chi2_of(s, x) for s in chosen),
            logdet=sum(weightings[s].logdet for s in chosen),
        )

    def suit_thermometers(self, fit: Fit) -> float:
        """Return a hypothesis's objective with the readings' noise that makes it most likely.

        An error of that noise alone could otherwise decide between hypotheses that smooth the
        readings differently.
        """
        from scipy.optimize import minimize_scalar

        factor = self.thermometer_factor

        def objective(log_factor: float) -> float:
            self.thermometer_factor = factor * float(np.exp(log_factor))
            here = self.fit(fit.terms, fit.coefficients, 1).objective
            return here + (log_factor / _NOISE_KNOWN) ** 2

        try:
            best = minimize_scalar(
                objective, bounds=(-0.5, 0.5), method="bounded", options={"xatol": 0.02}
            )
        finally:
            self.thermometer_factor = factor
        return float(best.fun)

    # -- non-linear parameters ------------------------------------------------------------

    def searched(self, terms: Sequence[Term]) -> list[tuple[int, str]]:
        """Return the non-linear parameters to search, [(term, name)]: shared, numeric, not held."""
        return [
            (i, name)
            for i, term in enumerate(terms)
            for name, value in term.nonlinear
            if isinstance(value, float) and f"{term.effect}.{name}" not in self.held
        ]

    def tangent(
        self, fit: Fit, searched: Sequence[tuple[int, str]], series: int, centred: bool = True
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return the design extended by ∂ prediction / ∂ non-linear parameters.

        Trajectories (E, R), directions (P, R), and indices (R,) among the K coefficients and L
        searched parameters.
        """
        C, V, index = self.design(fit.terms, fit.blocks, series, centred)
        trajectories, directions, places = [C], [V], [index]
        for place, (i, name) in enumerate(searched, len(fit.coefficients)):
            value = dict(fit.terms[i].nonlinear)[name]
            step = fit.terms[i].kind.nonlinear[name].difference_step(value)
            sides = []
            for sign in (1.0, -1.0):
                terms = list(fit.terms)
                terms[i] = terms[i].with_value(name, value + sign * step)
                sides.append(self.design(terms, fit.blocks, series, centred)[0])
            slope = (sides[0] - sides[1]) / (2 * step)
            moved = np.flatnonzero(np.abs(slope).max(axis=0) > 0)
            trajectories.append(slope[:, moved])
            directions.append(V[:, moved] * fit.coefficients[index[moved]])
            places.append(np.full(len(moved), place))
        return np.hstack(trajectories), np.hstack(directions), np.concatenate(places)

    def normal_equations(
        self, fit: Fit, only: Sequence[int] | None = None
    ) -> tuple[Array, Array, list[tuple[int, str]]]:
        """Return A (K + L, K + L), gradient (K + L,) and the L searched parameters."""
        searched = self.searched(fit.terms)
        K, L = len(fit.coefficients), len(searched)
        A, g = np.zeros((K + L, K + L)), np.zeros(K + L)
        for s in range(len(self.series)) if only is None else only:
            X, V, places = self.tangent(fit, searched, s)
            own, right, _ = fit.weightings[s].reduce(X, V)
            T = np.eye(K + L)[places]
            A += T.T @ own @ T
            g += T.T @ (right - own @ np.append(fit.coefficients, np.zeros(L))[places])
        for row, (left, information) in enumerate(self.prior_terms(fit), K):
            A[row, row] += information
            g[row] += information * left
        return A, g, searched

    def prior_terms(self, fit: Fit) -> list[tuple[float, float]]:
        """Return prior minus value of each searched parameter, and the prior's weight (0: none)."""
        out = []
        for i, name in self.searched(fit.terms):
            term = fit.terms[i]
            value, sd = self.priors.get(f"{term.effect}.{name}", (0.0, np.inf))
            out.append((value - float(dict(term.nonlinear)[name]), 1.0 / sd**2))
        return out

    def knee_range(self) -> tuple[float, float]:
        """Return the recorded temperatures, °C, between which a knee shows."""
        T = np.concatenate([e.history.temperature() for e in self.series])
        margin = _ENDS * float(np.ptp(T))
        return float(T.min()) + margin, float(T.max()) - margin

    def refine(
        self,
        fit: Fit,
        max_iterations: int = 6,
        only: Sequence[int] | None = None,
        least_squares: bool = False,
    ) -> Fit:
        """Improve the non-linear parameters by Gauss-Newton, without increasing the objective.

        least_squares: without increasing χ² alone. The objective's determinant prefers parameters
        that smooth the readings' errors more (Neyman-Scott), such as a longer lag: the comparison
        of hypotheses needs it, an estimate is biased by it as far as the thermometer is noisy.
        """

        def cost(of: Fit) -> float:
            prior = sum(w * left**2 for left, w in self.prior_terms(of) if w)
            return (of.chi2 if least_squares else of.objective) + prior

        searched = self.searched(fit.terms)
        # fewer periods than _PERIODS cannot be told from a slow drift
        longest = max(float(e.times[-1]) for e in self.series) / _PERIODS
        (low, high), names = self.knee_range(), catalogue.names()
        if searched:
            for _ in range(max_iterations):
                A, g, _ = self.normal_equations(fit, only)
                step = scaled_solve(A, g, _RIDGE)[len(fit.coefficients) :]
                improved = False
                for damping in (1.0, 0.3, 0.1):
                    terms = list(fit.terms)
                    for (i, name), d in zip(searched, damping * step, strict=True):
                        old = dict(terms[i].nonlinear)[name]
                        parameter = terms[i].kind.nonlinear[name]
                        value = parameter.bounded(old, old + float(d))
                        if parameter.role == "period":
                            value = min(value, max(old, longest))
                        elif parameter.role == "threshold" and terms[i].effect in names:
                            value = float(np.clip(value, min(old, low), max(old, high)))
                        terms[i] = terms[i].with_value(name, value)
                    trial = self.fit(terms, fit.coefficients, 2, only)
                    gain = cost(fit) - cost(trial)
                    if gain > 0:
                        fit, improved = trial, True
                        break
                if not improved or gain < 0.05:
                    break
        A, _, searched = self.normal_equations(fit, only)
        return replace(fit, covariance=scaled_inverse(A, _RIDGE), searched=tuple(searched))

    def replaced(self, better: Sequence[ReducedSeries | None]) -> list[ReducedSeries] | None:
        """Return the series, those that are better in their place; None if none is."""
        if all(e is None for e in better):
            return None
        return [e or old for e, old in zip(better, self.series, strict=True)]

    def refine_in(self, better: Sequence[ReducedSeries] | None, fit: Fit) -> Fit:
        """Refine a fit in better series, if there are any; they replace the fitter's."""
        if better is None:
            return fit
        self.series, self.thermometer_factor = tuple(better), 1.0
        self.stacks, self._caches = {}, {}
        return self.refine(self.fit(fit.terms, fit.coefficients), 20, least_squares=True)


def _drives(terms: Sequence[Term], series: int) -> list[tuple[str, dict[str, Any]]]:
    """Return the drives among some terms, as `catalogue.drive` takes them."""
    return [(t.effect, t.values(series) or {}) for t in terms if t.kind.is_drive]


_ORDERS = 8  # of the cosines, over a series, of the camera's movement
_MOVING = (np.arange(3), np.r_[0:3, EOP.start : EOP.stop])  # c, x0, y0; also the mount


def choose_distortion(series: Sequence[ReducedSeries]) -> tuple[Distortion, float]:
    """Choose the distortion's basis for all series of a camera; return it and its sigmas."""
    sums = {basis: np.sum([_squares(s.in_basis(basis)) for s in series], axis=0) for basis in BASES}
    unknowns = sum(min(_ORDERS, len(s.times) // 4) + 1 for s in series)
    cost = np.minimum(*(sums[b] for b in BASES)) + 2.0 * unknowns * np.array(
        list(map(len, _MOVING))
    )
    moving = int(np.argmin(cost))
    rows = sum(int((s.n > 0).sum()) for s in series)
    free = max(rows * len(series[0].scale) - unknowns * len(_MOVING[moving]), 1)
    noise = max(float(min(sums[b][moving] for b in BASES)) / free, 1.0)
    return choose_basis({b: float(sums[b][moving]) / noise for b in BASES})


def _squares(series: ReducedSeries) -> Array:
    """Return a series' sum of squares after a smooth movement, for each of `_MOVING`."""
    T = series.averaged(series.history.temperature())
    waves = cosines(series.times, min(_ORDERS, len(T) // 4))
    smooth = np.column_stack([np.ones(len(T)), T - T.mean(), *waves])
    products = smooth[:, :, None] * smooth[:, None, :]
    normal = np.einsum("ekl,epq->kplq", products, series.N, optimize=True)
    right = smooth.T @ series.b
    K, P = right.shape
    gains = []
    for moving in _MOVING:
        chosen = np.concatenate([np.arange(P), *(k * P + moving for k in range(1, K))])
        own = np.ix_(chosen, chosen)
        whole = normal.reshape(K * P, K * P)[own]
        gains.append(float(explained(whole, right.ravel()[chosen], 1e-10)))
    return float(series.yy.sum()) - np.array(gains)
