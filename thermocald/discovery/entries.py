"""Entries of a discovery: effects with estimates, sentences, evidence, and what is not separable.

Shift or tilt: whether a recording separates a principal point that moves from a camera that
turns.

Seen from one place both move the image alike; only the perspective differs. How far a recording
shows that is in its reduced normal equations: with both in the model along the trajectory of the
effect, their correlation, and by how much the one explains the image better than the other.

Source: canonical correlations as Hotelling (1936), Biometrika 28, 321-377.

Constants that trade off: two time constants of which the data determine the sum alone.

Two lags of the same size do the same to first order; each by itself is then known to be a time
constant and no more, while their sum is as well determined as one lag alone would be.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.photogrammetry.linalg import explained, inverse_of_determined, unit_diagonal
from thermocald.physics import catalogue
from thermocald.physics.effect import say_estimate
from thermocald.physics.model import ModelEffect, ThermalModel
from thermocald.thermal.scan import normals_beside
from thermocald.thermal.series import COLUMNS, FIELD_SCALES, unit_directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index
    from thermocald.discovery.evidence import Displaced
    from thermocald.discovery.examination import Examination
    from thermocald.discovery.gap import Gap
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Block, Fit, Term
    from thermocald.thermal.noise import NoiseGrowth
    from thermocald.thermal.series import ReducedSeries

Estimate = dict[str, Any]

_SURE = 3.0  # standard deviations of a thermometer's lag
_EXCHANGED = 1e-9  # of the scaled normal matrix: along it nothing is known
_TAKES_PART = 0.1  # of a unit vector along it
_UNLIKE = 0.01  # probability below which the gradients are not one lag times the rates


def _make_estimate(value: float, sd: float, unit: str) -> Estimate:
    return {"value": float(value), "sd": float(sd), "unit": unit}


def estimate_term(fit: Fit, number: int, evidence: ReducedSeries) -> dict[str, Estimate]:
    """Return all parameters of one term: searched ones by name, coefficients as `a_<parameter>`."""
    term = fit.terms[number]
    effect = catalogue.get(term.effect)
    units = effect.units()
    out: dict[str, Estimate] = {}
    K = len(fit.coefficients)
    values = term.values(0) or {}
    for name, value in values.items():
        if not isinstance(value, float):
            out[name] = {"value": value, "sd": None, "unit": units.get(name, "")}
            continue
        if effect.nonlinear[name].role == "event":
            out[name] = _make_estimate(*evidence.locate(value)[1:], units[name])
            continue
        sd = float("nan")
        if (number, name) in fit.searched:
            place = K + fit.searched.index((number, name))
            sd = float(np.sqrt(fit.covariance[place, place]))
        out[name] = _make_estimate(value, sd, units[name])
    for block in fit.blocks:
        if block.term == number and block.series in (None, 0):
            out.update(_estimate_coefficients(fit, block, evidence, units))
    return out


def _estimate_coefficients(
    fit: Fit, block: Block, evidence: ReducedSeries, units: dict[str, str]
) -> dict[str, Estimate]:
    places = np.arange(block.start, block.stop)
    x = fit.coefficients[places].reshape(block.trajectories, -1)
    C = fit.covariance[np.ix_(places, places)]
    scale = np.array([evidence.scale[COLUMNS.index(p)] for p in block.parameters])
    out: dict[str, Estimate] = {}
    if fit.terms[block.term].kind.is_periodic:
        u, s, v = np.linalg.svd(x, full_matrices=False)
        a, side = s[0] * v[0], u[:, 0]
        if side[0] < 0:
            a, side = -a, -side
        phase = float(np.arctan2(side[1], side[0]))
        project = np.kron(side[None], np.eye(x.shape[1]))
        sds = np.sqrt(np.diag(project @ C @ project.T))
        across = np.kron(np.array([[-side[1], side[0]]]), v[0][None])
        out["phase"] = _make_estimate(
            phase, float(np.sqrt(across @ C @ across.T)[0, 0]) / s[0], "rad"
        )
    else:
        a, sds = x[0], np.sqrt(np.diag(C))
    for name, value, sd, factor in zip(block.parameters, a, sds, scale, strict=True):
        short = name.removeprefix("scale_")
        out[f"a_{short}"] = _make_estimate(value / factor, sd / factor, units.get(short, ""))
    return out


def lagging_thermometer(fit: Fit, number: int) -> dict[str, Any] | None:
    """The thermometer's own lag as an alternative to a thermal gradient; None where it is none.

    A thermometer that follows the camera with a lag τ reads T - τ dT/dt: every parameter that
    drifts with T then has a gradient of τ times its rate, which nothing but chance gives a bent
    mount.
    """
    from scipy.stats import chi2

    term = fit.terms[number]
    base = next(b for b in fit.blocks if b.term < 0)
    own = next((b for b in fit.blocks if b.term == number), None)
    if not term.kind.follows_rate or own is None or len(own.parameters) < 2:
        return None
    if not set(own.parameters) <= set(base.parameters):
        return None
    a = np.arange(own.start, own.stop)
    r = base.start + np.array([base.parameters.index(p) for p in own.parameters])
    gradients, rates = fit.coefficients[a], fit.coefficients[r]
    tau = float(gradients @ rates / (rates @ rates))
    for _ in range(5):
        J = np.zeros((len(a), len(fit.covariance)))
        J[np.arange(len(a)), a], J[np.arange(len(a)), r] = 1.0, -tau
        weight = np.linalg.inv(J @ fit.covariance @ J.T)
        information = float(rates @ weight @ rates)
        tau = float(rates @ weight @ gradients) / information
    left = gradients - tau * rates
    off = float(left @ weight @ left)
    sd = information**-0.5
    if tau < _SURE * sd or off > chi2.isf(_UNLIKE, len(a) - 1):
        return None
    return {
        "effect": "lagging_thermometer",
        "score_difference": off,
        "values": {"tau": tau},
        "statement": "the thermometer lags behind the camera by "
        f"{say_estimate(_make_estimate(tau, sd, 's'))}: "
        f"it explains {', '.join(own.parameters)} by one number",
        "experiment": "put a small, fast thermometer beside the one that was read and record "
        "again: a lag of the thermometer goes, a gradient stays",
    }


def model_values(
    estimates: dict[str, Estimate], parameters: tuple[str, ...]
) -> tuple[dict[str, Any], dict[str, float]]:
    """Return values and standard deviations by the names that the simulation's effect uses."""
    values: dict[str, Any] = {}
    sds: dict[str, float] = {}
    known = {p.removeprefix("scale_") for p in parameters}
    for key, e in estimates.items():
        name = key[2:] if key.startswith("a_") and key[2:] in known else key
        values[name] = e["value"]
        if e["sd"] is not None and np.isfinite(e["sd"]):
            sds[name] = e["sd"]
    return values, sds


def estimate_displacement(group: Displaced, names: tuple[str, ...]) -> dict[str, Estimate]:
    """Return targets, time, and displacement across the rays: the mean of the lengths."""
    lengths = np.linalg.norm(group.vectors, axis=1)
    sd = np.sqrt(np.mean(group.sd_vectors**2)) / np.sqrt(len(lengths))
    mean = group.vectors.mean(axis=0)
    out: dict[str, Estimate] = {
        "targets": {"value": [names[r] for r in group.rows], "sd": None, "unit": "names"},
        "time": _make_estimate(group.time, group.sd_time, "s"),
        "displacement": _make_estimate(float(lengths.mean()), float(sd), "mm"),
    }
    for axis, value in zip(("dX", "dY", "dZ"), mean, strict=True):
        out[axis] = _make_estimate(float(value), float(sd), "mm")
    return out


def acts_on(parameters: tuple[str, ...]) -> list[str]:
    """Name parameters in the words of the document."""
    return [p if p not in FIELD_SCALES else f"object {p[-1]}" for p in parameters]


@dataclass(frozen=True, eq=False)
class EffectFound:
    """One entry of `effects` in CONVENTIONS §4."""

    effect: str
    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    alternatives: list[dict[str, Any]]
    gap_before: Gap
    gap_after: Gap
    term: Term | None = field(default=None, metadata={"json": ""})

    @property
    def alternative_names(self) -> list[str]:
        """Effects of the catalogue that the data cannot exclude."""
        others = ("resembles", "formula")
        return [a["effect"] for a in self.alternatives if not any(a.get(k) for k in others)]


def effects_of(found: EffectFound) -> list[ModelEffect]:
    """Return what was found as effects of a model; none where it has no name and no formula."""
    if found.term is None and found.effect not in catalogue.names():
        return []
    name = found.effect if found.effect in catalogue.names() or not found.term else (
        found.term.effect
    )  # fmt: skip
    numbers, sds = model_values(found.estimates, found.term.parameters if found.term else ())
    known = catalogue.get(name).units()
    return [
        ModelEffect(
            name,
            {k: v for k, v in numbers.items() if k in known},
            {k: v for k, v in sds.items() if k in known},
        )
    ]


def terms_of(model: ThermalModel) -> list[tuple[str, dict[str, Any]]]:
    """List the effects of a model that act on trajectories of parameters, with their values."""
    return [
        (e.name, dict(e.values))
        for e in model.effects
        if catalogue.get(e.name).seen_in == "trajectory"
    ]


_SHIFT = ("x0", "y0")
_TILT = ("omega", "phi")
_BOTH = ("c", "kappa")  # a scale and a turn about the axis are seen whatever the rest is


def compare_shift_and_tilt(
    fitter: HypothesisFitter, fit: Fit, number: int
) -> tuple[dict[str, Any], str] | None:
    """Compare a shift of the principal point with a tilt of the camera as the cause of one term.

    Returns the document of the evidence, with the largest correlation of a combination of x0, y0
    with one of omega, phi and the χ² that the shift explains beyond what the tilt does; and what is
    added to the statement where the recording does not separate them. None where the term moves
    neither.
    """
    term = fit.terms[number]
    if not {*_SHIFT, *_TILT} & set(term.parameters):
        return None
    rest = tuple(p for p in term.parameters if p not in (*_SHIFT, *_TILT, *_BOTH))
    names = (*_SHIFT, *_TILT, *_BOTH, *rest)
    shift, tilt, both = np.arange(2), np.arange(2, 4), np.arange(4, len(names))
    own = -1 if term.is_drive else number
    # of the estimates, c and kappa estimated too; an effect that is T itself has its shift in the
    # base's rates
    A, _ = _sum_normal_equations(fitter, fit, number, names, frozenset({own, -1}))
    Q = np.linalg.inv(unit_diagonal(A, 1e-12)[0])
    low_s, low_t = (np.linalg.cholesky(Q[np.ix_(i, i)]) for i in (shift, tilt))
    whitened = np.linalg.solve(low_s, np.linalg.solve(low_t, Q[np.ix_(tilt, shift)]).T)
    correlation = float(min(np.linalg.svd(whitened, compute_uv=False)[0], 1.0))
    A, c = _sum_normal_equations(fitter, fit, number, names, frozenset({own}))
    some = [np.concatenate([i, both]) for i in (shift, tilt)]
    gains = [float(explained(A[np.ix_(i, i)], c[i], 1e-12)) for i in some]
    difference = gains[0] - gains[1]
    separable = abs(difference) > criteria.SHIFT_OR_TILT
    document = {
        "correlation": correlation, "chi2_difference": difference, "separable": separable
    }  # fmt: skip
    sentence = (
        "; its cause in time is named, but in this recording a shift of the principal point and a "
        f"tilt of the camera are not separable (correlation {correlation:.4f}, χ² differs by "
        f"{abs(difference):.1f})"
    )
    return document, "" if separable else sentence


def _sum_normal_equations(
    fitter: HypothesisFitter, fit: Fit, number: int, names: Sequence[str], own: frozenset[int]
) -> tuple[Array, Array]:
    """Return A (k, k), c (k,) of a term's trajectory in some columns.

    The other coefficients are eliminated; own: the terms whose coefficients are left out.
    """
    term, k = fit.terms[number], len(names)
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
    return normals_beside(fit, further, k, leave=own)


@dataclass(frozen=True)
class TradeOff:
    """names: of two time constants; value, sd s: of their sum."""

    names: tuple[str, str] = field(metadata={"json": "parameters"})
    value: float = field(metadata={"json": "sum"})
    sd: float
    unit: str = "s"

    @property
    def sentence(self) -> str:
        """What is added to a statement."""
        total = say_estimate({"value": self.value, "sd": self.sd, "unit": self.unit})
        return f"; the time constants are not separable, their sum is {total}"


def find_trade_off(fitter: HypothesisFitter, fit: Fit, number: int) -> TradeOff | None:
    """Find two time constants of a term that M1 does not separate; None where it does.

    The standard deviation is that of the one where the other is held, which is that of their sum.
    """
    term, K = fit.terms[number], len(fit.coefficients)
    loose = []
    for place, (owner, name) in enumerate(fit.searched, K):
        value = float(dict(fit.terms[owner].nonlinear)[name])
        sd = float(np.sqrt(fit.covariance[place, place]))
        is_time = term.kind.nonlinear[name].unit == "s" if owner == number else False
        if is_time and not sd <= criteria.LOOSE * abs(value):
            loose.append((place, name, value))
    if len(loose) != 2:
        return None
    (one, first, a), (two, second, b) = loose
    A, _, _ = fitter.normal_equations(fit, only=[0])
    kept = np.delete(np.arange(len(A)), two)
    Q = inverse_of_determined(A[np.ix_(kept, kept)])
    sd = float(np.sqrt(Q[kept.tolist().index(one), kept.tolist().index(one)]))
    return TradeOff((first, second), a + b, sd)


@dataclass(frozen=True)
class Ridge:
    """names: of constants of which M1 knows only what they make of its temperatures together."""

    names: tuple[str, ...] = field(metadata={"json": "parameters"})

    @property
    def sentence(self) -> str:
        """What is added to a statement."""
        return (
            f"; of {', '.join(self.names)} and the size only their product over the recorded range "
            "is known: others explain the same"
        )


def find_ridge(fitter: HypothesisFitter, fit: Fit, number: int) -> Ridge | None:
    """Find the constants of a term that M1 exchanges for its size or each other; None without any.

    tanh far below its middle is an exponential: middle and size are one number, and its slopes are
    nothing but rounding, which looks like knowledge. So a temperature outside the recorded ones by
    more than their range counts, whatever the normal equations say.
    """
    history = fitter.series[0].history
    recorded = np.concatenate([history.temperature(name) for name in history.readings])
    low, high = float(np.nanmin(recorded)), float(np.nanmax(recorded))
    kind = fit.terms[number].kind
    A, _, searched = fitter.normal_equations(fit, only=[0])
    shares, axes = np.linalg.eigh(unit_diagonal(A)[0])
    loose = axes[:, shares < _EXCHANGED]
    names = [
        name
        for place, (owner, name) in enumerate(searched, len(fit.coefficients))
        if owner == number
        and (
            float(np.abs(loose[place]).max(initial=0.0)) > _TAKES_PART
            or (
                kind.nonlinear[name].unit == "degC"
                and not 2 * low - high
                <= float(dict(fit.terms[number].nonlinear)[name])
                <= 2 * high - low
            )
        )
    ]
    return Ridge(tuple(names)) if names else None


def list_image_places(x: Examination) -> list[str]:
    """List where such effects were seen ("targets", "noise"), in the document's order."""
    places = ["targets"] if x.displaced[0] else []
    return [*places, "noise"] if x.noise_growth else places


def list_image_effects(x: Examination, gap: Gap) -> list[EffectFound]:
    """Make the entries of the document; gap: of the base model, which the caller replaces."""
    out = []
    if x.displaced[0]:
        out.append(_describe_moved_targets(x, gap))
    if x.noise_growth:
        out.append(_describe_noise_growth(x.fitter.series[0], x.noise_growth, gap))
    return out


def _describe_moved_targets(x: Examination, gap: Gap) -> EffectFound:
    e = x.fitter.series[0]
    names = e.source.field.names
    group = max(x.displaced[0], key=lambda g: g.gain)
    effect = catalogue.seen_in("targets")
    estimates = estimate_displacement(group, names)
    points = e.at.predicted[group.rows]
    first = int(np.searchsorted(e.times, group.time))
    where = {
        "parameters": [],
        "targets": [names[r] for r in group.rows],
        "epochs": [int(e.numbers[first]), int(e.source.numbers[-1])],
        "image_region": [float(v) for v in (*points.min(axis=0), *points.max(axis=0))],
    }
    evidence = {
        "chi2_gain": float(group.gain),
        "steps_px": group.steps.tolist(),
        "others": [
            {"targets": [names[r] for r in g.rows], "time": g.time}
            for g in x.displaced[0]
            if g is not group
        ],
        "note": "displacements are across the rays; along them one camera sees nothing",
    }
    statement = effect.sentence(estimates)
    return EffectFound(effect.name, statement, where, estimates, evidence, [], gap, gap)


def _describe_noise_growth(e: ReducedSeries, growth: NoiseGrowth, gap: Gap) -> EffectFound:
    effect = catalogue.seen_in("noise")
    estimates = {"factor": _make_estimate(growth.factor, growth.sd, "1/K")}
    where = {
        "parameters": ["sigma0"],
        "epochs": [int(e.source.numbers[0]), int(e.source.numbers[-1])],
        "image_region": None,
    }
    evidence = {
        "log_likelihood_gain": growth.gain,
        "next_best": growth.other,
        "next_best_gain": growth.other_gain,
    }
    statement = effect.sentence(estimates)
    if not growth.excludes_other:
        statement += f"; it follows {growth.other} as well"
    return EffectFound(effect.name, statement, where, estimates, evidence, [], gap, gap)
