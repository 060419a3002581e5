"""Hypotheses, that is, the base model with some effects, and candidates for a further effect.

Physical constants are shared by the series. Levels belong to one series, and so do the times and
phases that are `fresh` parameters of an effect.

Fit, discovery and the plan of an experiment have the same grid of trial values for a non-linear
parameter. It covers whatever the recordings can show, as finely as they can resolve it, so that no
result depends on a lucky start value.

For a fit, a user gives an effect as `--effect NAME[:PARAMETER=VALUE,…]`:

    thermal_lag                                          default start values and coefficients
    thermal_lag:tau=80                                   another start value
    radial_distortion_drift:A1,A2                        these coefficients
    second_heat_source:channel=board_temperature         a temperature column
    target_displacement:targets=x33+y52                  targets of the test field
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, UsageError
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.thermal.series import COLUMNS, ReducedSeries, unit_directions

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.effect import Effect, Parameter
    from thermocald.thermal.likelihood import Weighting


BASE = ("c", "x0", "y0")

Unknowns = dict[str, tuple[float, "Array"]]
"""{name of a number in the model: its value, and its row (K + L,) over the fit's unknowns}.

A name ends with `@k` if the number belongs to series k > 0.
"""


@dataclass(frozen=True)
class Term:
    """An effect in a hypothesis.

    parameters: the columns on which it acts; nonlinear: values shared by the series; fresh: values
    of each series, None where the effect does not occur; through_drive: whether its trajectory
    follows the drive instead of T.
    """

    effect: str
    parameters: tuple[str, ...] = BASE
    nonlinear: tuple[tuple[str, Any], ...] = ()
    fresh: tuple[tuple[tuple[str, Any], ...] | None, ...] = ()
    through_drive: bool = False

    @property
    def kind(self) -> Effect:
        """The effect itself."""
        return catalogue.get(self.effect)

    @property
    def is_separate(self) -> bool:
        """Whether each series has coefficients of its own: a height, or amplitude and phase."""
        return self.kind.is_event or self.kind.is_periodic

    def values(self, series: int) -> dict[str, Any] | None:
        """Return the non-linear values in a series, None if the effect does not occur there."""
        if not self.fresh:
            return dict(self.nonlinear)
        own = self.fresh[series]
        return None if own is None else {**dict(self.nonlinear), **dict(own)}

    def with_value(self, name: str, value: float) -> Term:
        """Return the term with another value for a shared non-linear parameter."""
        return replace(
            self, nonlinear=tuple((k, value if k == name else v) for k, v in self.nonlinear)
        )


@dataclass(frozen=True, eq=False)
class Block:
    """A term's coefficients among the unknowns: (trajectories, parameters), from `start` on."""

    term: int  # -1: the base's rates
    series: int | None  # None: shared
    start: int
    trajectories: int
    parameters: tuple[str, ...]

    @property
    def stop(self) -> int:
        return self.start + self.trajectories * len(self.parameters)

    def directions(self, coefficients: Array) -> Array:
        """Return its coefficients, of all (K,), as (trajectories, P) in px-scaled columns."""
        own = coefficients[self.start : self.stop].reshape(self.trajectories, -1)
        return own @ unit_directions(self.parameters).T


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted hypothesis.

    coefficients (K,), px-scaled; covariance (K + L, K + L): of the coefficients and the L shared
    non-linear parameters `searched` [(term, name)]; chi2, logdet: sums over the series; weightings,
    designs: of each series; reduced: its A, c, yy after elimination of its levels; objective: -2
    log L up to a constant.
    """

    terms: tuple[Term, ...]
    blocks: tuple[Block, ...]
    coefficients: Array
    covariance: Array
    chi2: float
    logdet: float
    weightings: tuple[Weighting, ...]
    designs: tuple[tuple[Array, Array, NDArray[np.int64]], ...]
    reduced: tuple[tuple[Array, Array, float], ...]
    searched: tuple[tuple[int, str], ...] = ()

    @property
    def objective(self) -> float:
        return self.chi2 + self.logdet

    def direction(self, block: Block) -> Array:
        """Return the coefficients of a block (trajectories, P) in px-scaled columns."""
        return block.directions(self.coefficients)

    def parameters(self, series: int) -> Array:
        """Return the movement (E, P) of the parameters according to the hypothesis, px-scaled."""
        C, V, index = self.designs[series]
        return np.asarray((C * self.coefficients[index]) @ V.T)

    def normals(self, series: Iterable[int] | None = None) -> tuple[Array, Array]:
        """Sum the normal equations A (K, K), c (K,) of all coefficients over some series."""
        size = len(self.coefficients)
        A, c = np.zeros((size, size)), np.zeros(size)
        for s in range(len(self.designs)) if series is None else series:
            index, (own, right, _) = self.designs[s][2], self.reduced[s]
            A[np.ix_(index, index)] += own
            c[index] += right
        return A, c

    def forget(self) -> None:
        """Free the memory of what was whitened for scans, which is large for a long series."""
        for weighting in self.weightings:
            weighting.kept.clear()

    def chi2_of(self, series: int, coefficients: Array | None = None) -> float:
        """Return χ² of a series at some coefficients (default: the fitted ones)."""
        x = self.coefficients if coefficients is None else coefficients
        part, (A, c, yy) = x[self.designs[series][2]], self.reduced[series]
        return float(yy - 2 * part @ c + part @ A @ part)


def coefficients_of(fit: Fit, blocks: Sequence[Block], scale: Array) -> Unknowns:
    """Return the coefficients of a term's blocks by column; of an oscillation also each `phase`.

    scale (19,): px per unit of the columns. All series share the amplitudes of an oscillation; each
    has its own phase, from its pair of sine and cosine.
    """
    size = len(fit.covariance)
    found, phases = Unknowns(), Unknowns()
    amplitudes: list[Array] = []
    rows, weights = [], []
    for block in blocks:
        unit = scale[[COLUMNS.index(p) for p in block.parameters]]
        x = fit.coefficients[block.start : block.stop].reshape(block.trajectories, -1)
        place = np.arange(block.start, block.stop).reshape(x.shape)
        suffix = f"@{block.series}" if block.series else ""
        own = np.zeros((x.shape[1], size))
        if block.term < 0 or not fit.terms[block.term].kind.is_periodic:
            own[np.arange(len(own)), place[0]] = 1.0 / unit
            for parameter, value, row in zip(block.parameters, x[0] / unit, own, strict=True):
                found[parameter + suffix] = float(value), row
            continue
        u, s, v = np.linalg.svd(x, full_matrices=False)
        side, shape = u[:, 0], v[0]
        # the first series sets the amplitude's sign, with a phase within half a turn
        if shape @ amplitudes[0] < 0 if amplitudes else side[0] < 0:
            side, shape = -side, -shape
        own[np.arange(len(own)), place[0]], own[np.arange(len(own)), place[1]] = side
        across = np.zeros(size)
        across[place.ravel()] = np.kron([-side[1], side[0]], shape) / s[0]
        phases["phase" + suffix] = float(np.arctan2(side[1], side[0])), across
        amplitudes.append(s[0] * shape)
        rows.append(own / unit[:, None])
        weights.append(1.0 / np.trace(own @ fit.covariance @ own.T))
    if amplitudes:
        w = np.array(weights) / np.sum(weights)
        mean, row = np.tensordot(w, amplitudes, 1) / unit, np.tensordot(w, rows, 1)
        found = dict(zip(blocks[0].parameters, zip(mean.tolist(), row, strict=True), strict=True))
    return found | phases


def make_known_term(name: str, values: Mapping[str, Any], series: int) -> Term:
    """Make a term of an effect with known values; series: the number of series.

    An event belongs to the first series; a cycle's phases are not searched.
    """
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


def trial_values(parameter: Parameter, times: Array, T: Array) -> Array:
    """Choose the values to scan by the parameter's role, for times (E,) s and temperatures °C."""
    duration = float(times[-1])
    step = float(np.median(np.diff(times)))
    low, high = float(T.min()), float(T.max())
    match parameter.role:
        case "period":
            # at least 1.8 periods, with two frames in each; three frequencies per resolution step
            frequencies = np.arange(1.8 / duration, 1.0 / (2.1 * step), 1.0 / (3.0 * duration))
            return np.asarray(1.0 / frequencies[:4000])
        case "threshold":
            return np.linspace(low + 0.03 * (high - low), high - 0.03 * (high - low), 32)
        case "width":
            return np.geomspace(max(0.2 * parameter.low, 0.01), max(0.45 * (high - low), 0.2), 36)
        case "time_constant":
            return np.geomspace(max(0.2 * parameter.low, 0.05 * step), 2.0 * duration, 44)
        case "event":
            return times[1:]
        case "delay":
            reach = min(parameter.high, 0.25 * duration)
            coarse = np.arange(max(parameter.low, -reach), reach, min(0.5 * step, reach / 20)) + 0.1
            fine = np.linspace(-step, step, 21) + 0.001 * step  # as most delays are small
            return np.unique(np.concatenate([coarse, fine]))
    if parameter.log:
        return np.geomspace(parameter.low, parameter.high, 40)
    return np.linspace(parameter.low, parameter.high, 40)


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect on a set of parameters, proposed for a hypothesis.

    parameters: columns of the reduced series; name: of the non-linear parameter to search, or "";
    grid: its trial values; fixed: given non-linear values.
    """

    effect: str
    parameters: tuple[str, ...]
    name: str
    grid: Array
    fixed: tuple[tuple[str, Any], ...] = ()

    @property
    def kind(self) -> Effect:
        """The effect itself."""
        return catalogue.get(self.effect)

    @property
    def directions(self) -> Array:
        """Unit vectors (P, k) along its parameters."""
        return unit_directions(self.parameters)

    def term(self, value: float | None, series: int) -> Term:
        """Return the term for a value of the grid; series: the number of series."""
        if self.kind.is_event:
            return Term(self.effect, self.parameters, self.fixed, ((),) * series)
        own = () if value is None else ((self.name, float(value)),)
        return Term(self.effect, self.parameters, self.fixed + own)


def make_candidate(
    effect: Effect,
    parameters: tuple[str, ...],
    series: Sequence[ReducedSeries],
    fixed: tuple[tuple[str, Any], ...] = (),
    *,
    plain: bool = False,
) -> Candidate:
    """Make a candidate of an effect on some of its coefficients.

    Of the parameters that belong to one series, only an event's time is searched. fixed: given
    non-linear values; plain: whether to omit the parameters that a model may leave out.
    """
    given = dict(fixed)
    columns = tuple(effect.column(p) for p in parameters)
    for key, parameter in effect.nonlinear.items():
        own = key in effect.fresh and parameter.role != "event"
        left_out = plain and key in effect.optional
        if not (parameter.text or own or left_out or key in given):
            grid = trial_values(parameter, series[0].times, series[0].history.temperature())
            return Candidate(effect.name, columns, key, grid, fixed)
    return Candidate(effect.name, columns, "", np.zeros(0), fixed)


def parse_effect(text: str) -> ModelEffect:
    """Parse an effect with its start values; UsageError names the fault and a correction."""
    name, colon, rest = text.partition(":")
    try:
        kind = catalogue.get(name)
    except ConfigurationError as error:
        raise UsageError(f"--effect {text}: {error}") from error
    if colon and not rest.strip(" ,"):
        raise UsageError(
            f"--effect {text}: no parameter after the colon; {_suggest('', kind.units())}"
        )
    values: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, equals, value = (w.strip() for w in part.partition("="))
        if key not in kind.units():
            raise UsageError(
                f"--effect {text}: {name} has no parameter {key!r}; {_suggest(key, kind.units())}"
            )
        if key in values:
            raise UsageError(f"--effect {text}: {key} is given twice; give it once")
        if not equals and key not in kind.linear:
            raise UsageError(f"--effect {text}: {key} has no value; give {key}=VALUE")
        if not equals:
            values[key] = 0.0
        elif key in kind.nonlinear and kind.nonlinear[key].text:
            names = kind.nonlinear[key].unit == "names"
            values[key] = tuple(value.split("+")) if names else value
        else:
            try:
                values[key] = float(value)
            except ValueError:
                raise UsageError(f"--effect {text}: {key}={value} is not a number") from None
    for key, parameter in kind.nonlinear.items():
        if parameter.text and not values.get(key):
            example = "x33+y52" if parameter.unit == "names" else "board_temperature"
            raise UsageError(
                f"--effect {text}: {key} is missing; give it, as in --effect {name}:{key}={example}"
            )
    try:
        return effect_with(name, values)
    except ConfigurationError as error:
        raise UsageError(f"--effect {text}: {error}") from error


def effect_with(name: str, values: Mapping[str, Any]) -> ModelEffect:
    """Return an effect with some values given and defaults for the others.

    Its coefficients are the given ones, or the usual ones if none is given. Raises
    ConfigurationError for an unknown effect or a wrong value.
    """
    kind = catalogue.get(name)
    usual: dict[str, Any] = {k: p.default for k, p in kind.nonlinear.items() if not p.text}
    if not set(values) & set(kind.linear):
        usual |= dict.fromkeys(kind.usual, 0.0)
    return ModelEffect(name, {**usual, **values})


def targets_of(listed: Iterable[ModelEffect]) -> tuple[str, ...]:
    """Return the targets that effects name as moving."""
    names: list[str] = []
    for effect in listed:
        targets = effect.values.get("targets", ())
        names += [targets] if isinstance(targets, str) else list(targets)
    return tuple(names)


def check_names(listed: Iterable[ModelEffect], series: Iterable[ReducedSeries]) -> None:
    """Raise UsageError if an effect names a channel or a target that a series does not have."""
    effects = list(listed)
    for s in series:
        for effect in effects:
            channel = effect.values.get("channel")
            if channel is not None and channel not in s.source.readings:
                raise UsageError(
                    f"effect {effect.name}: {s.source.name} has no temperature column {channel!r}; "
                    f"{_suggest(channel, s.source.readings)}"
                )
            for target in targets_of([effect]):
                if target not in s.source.field.index:
                    raise UsageError(
                        f"effect {effect.name}: the test field of {s.source.name} has no target "
                        f"{target!r}; {_suggest(target, s.source.field.index)}"
                    )


def _suggest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = get_close_matches(name, names, 1)
    if near:
        return f"did you mean {near[0]!r}?"
    shown = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
    return f"there are: {shown}"
