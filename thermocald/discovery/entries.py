"""The entries of a discovery: effects with estimates, statements, evidence and alternatives.

Shift or tilt. From a single station, a shift of the principal point and a rotation of the camera
move the image alike; only the perspective differs. The reduced normal equations show whether a
recording separates them: with both in the model along the effect's trajectory, by their correlation
and by how much better one of them explains the image.

Source: canonical correlations, Hotelling (1936), Biometrika 28, 321-377.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.discovery import criteria
from thermocald.numbers import parameter_label
from thermocald.photogrammetry.linalg import explained, inverse_of_determined, unit_diagonal
from thermocald.physics import catalogue
from thermocald.physics.formula import known_together
from thermocald.physics.model import ModelEffect
from thermocald.thermal import criteria as noise_criteria
from thermocald.thermal.hypothesis import coefficients_of
from thermocald.thermal.scan import normals_of_term

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.examination import Examination
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.noise import NoiseGrowth
    from thermocald.thermal.series import ReducedSeries

Estimate = dict[str, Any]

_EXCHANGED = 1e-9  # eigenvalue of the scaled normal matrix below which a direction is undetermined
_TAKES_PART = 0.1  # least component of a constant in such a direction's unit vector


def _make_estimate(value: float, sd: float, unit: str) -> Estimate:
    return {"value": float(value), "sd": float(sd), "unit": unit}


def estimate_term(fit: Fit, number: int, evidence: ReducedSeries) -> dict[str, Estimate]:
    """Return a term's estimates: searched parameters by name, coefficients as `a_<parameter>`."""
    term = fit.terms[number]
    effect = term.kind
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
    own = [b for b in fit.blocks if b.term == number and b.series in (None, 0)]
    found = coefficients_of(fit, own, evidence.scale)
    for name, (value, row) in sorted(found.items(), key=lambda one: one[0] != "phase"):
        short = name.removeprefix("scale_")
        sd = float(np.sqrt(row @ fit.covariance @ row))
        key, unit = ("phase", "rad") if name == "phase" else (f"a_{short}", units.get(short, ""))
        out[key] = _make_estimate(value, sd, unit)
    return out


@dataclass(frozen=True, eq=False)
class EffectFound:
    """An effect found: an entry of `effects` in CONVENTIONS §4."""

    JSON: ClassVar = {"term": ""}

    effect: str
    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    alternatives: list[dict[str, Any]]
    term: Term | None = None

    @property
    def alternative_names(self) -> list[str]:
        """The effects of the catalogue that the data cannot exclude."""
        others = ("resembles", "formula")
        return [a["effect"] for a in self.alternatives if not any(a.get(k) for k in others)]


def effects_of(found: EffectFound) -> list[ModelEffect]:
    """Return an effect found as a model's effects; none if it has neither a name nor a formula."""
    if found.term is None and found.effect not in catalogue.names():
        return []
    term = found.term
    name = term.effect if term and found.effect not in catalogue.names() else found.effect
    # an estimate of a coefficient is called a_c or a_X, the coefficient itself c or X
    short = [p.removeprefix("scale_") for p in (term.parameters if term else ())]
    own = {f"a_{p}": p for p in short}
    known = catalogue.get(name).units()
    numbers = {own.get(key, key): e for key, e in found.estimates.items()}
    numbers = {key: e for key, e in numbers.items() if key in known}
    sds = {k: e["sd"] for k, e in numbers.items() if e["sd"] is not None and np.isfinite(e["sd"])}
    return [ModelEffect(name, {k: e["value"] for k, e in numbers.items()}, sds)]


_SHIFT = ("x0", "y0")
_TILT = ("omega", "phi")
_BOTH = ("c", "kappa")  # a scale and a rotation about the axis are always determined


def compare_shift_and_tilt(
    fitter: HypothesisFitter, fit: Fit, number: int
) -> tuple[dict[str, Any], str] | None:
    """Compare a shift of the principal point with a tilt of the camera as the cause of a term.

    Returns the evidence, which holds the largest correlation of a combination of x0, y0 with one of
    omega, phi and the χ² that the shift explains beyond the tilt, and a clause for the statement,
    empty if the recording separates them. Returns None if the term moves neither.
    """
    term = fit.terms[number]
    if not {*_SHIFT, *_TILT} & set(term.parameters):
        return None
    rest = tuple(p for p in term.parameters if p not in (*_SHIFT, *_TILT, *_BOTH))
    names = (*_SHIFT, *_TILT, *_BOTH, *rest)
    shift, tilt, both = np.arange(2), np.arange(2, 4), np.arange(4, len(names))
    own = -1 if term.kind.is_drive else number
    # correlation of the estimates, with c and kappa estimated too; the shift of an effect that is
    # T itself is in the base's rates
    A, _ = normals_of_term(fitter, fit, term, names, leave=frozenset({own, -1}))
    Q = np.linalg.inv(unit_diagonal(A, 1e-12)[0])
    low_s, low_t = (np.linalg.cholesky(Q[np.ix_(i, i)]) for i in (shift, tilt))
    whitened = np.linalg.solve(low_s, np.linalg.solve(low_t, Q[np.ix_(tilt, shift)]).T)
    correlation = float(min(np.linalg.svd(whitened, compute_uv=False)[0], 1.0))
    A, c = normals_of_term(fitter, fit, term, names, leave=frozenset({own}))
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


def find_tied_constants(fitter: HypothesisFitter, fit: Fit, number: int) -> dict[str, Any] | None:
    """Find the constants of a formula that trade off against its size or each other in M1.

    M1 determines only their joint effect at its temperatures (`known_together`). Far below its
    middle, tanh is an exponential: middle and size are one number, and the slopes are rounding
    errors that look like information. A temperature outside the recorded range by more than its
    width therefore counts as traded off, whatever the normal equations show. Returns None if there
    are no such constants.
    """
    e, term = fitter.series[0], fit.terms[number]
    recorded = np.concatenate([e.history.temperature(name) for name in e.history.readings])
    low, high = float(np.nanmin(recorded)), float(np.nanmax(recorded))
    A, _, searched = fitter.normal_equations(fit, only=[0])
    shares, axes = np.linalg.eigh(unit_diagonal(A)[0])
    loose = axes[:, shares < _EXCHANGED]
    own, base = (next(b for b in fit.blocks if b.term == i) for i in (number, -1))
    values: dict[str, float] = {}
    rows: list[Array] = []  # partial derivatives of the values with respect to the unknowns
    exchanged = []
    for place, (owner, name) in enumerate(searched, len(fit.coefficients)):
        if owner == number:
            value = float(dict(term.nonlinear)[name])
            rows.append(np.eye(1, len(A), place)[0])
            values[name] = value
            is_temperature = term.kind.nonlinear[name].unit == "degC"
            if float(np.abs(loose[place]).max(initial=0.0)) > _TAKES_PART or (
                is_temperature and not 2 * low - high <= value <= 2 * high - low
            ):
                exchanged.append(name)
    for block in (own, base):
        known = coefficients_of(fit, [block], e.scale)
        for p in own.parameters:
            values[f"{p} {block.term}"], row = known.get(p, (0.0, np.zeros(len(A))))
            rows.append(row)
    R, mean = np.array(rows), float(e.history.temperature().mean())
    covariance = R @ inverse_of_determined(A) @ R.T
    return known_together(
        term.effect, values, own.parameters, covariance, (low, mean, high), exchanged
    )


def list_image_effects(x: Examination) -> list[EffectFound]:
    """List the entries of the effects found in image space."""
    out = []
    if "targets" in x.image_places:
        out.append(_describe_moved_targets(x))
    if x.noise_growth and "noise" in x.image_places:
        out.append(_describe_noise_growth(x.fitter.series[0], x.noise_growth))
    return out


def _describe_moved_targets(x: Examination) -> EffectFound:
    e = x.fitter.series[0]
    names = e.source.field.names
    group = max(x.displaced[0], key=lambda g: g.gain)
    effect = catalogue.find(lambda e: e.seen_in == "targets")
    lengths = np.linalg.norm(group.vectors, axis=1)
    sd = np.sqrt(np.mean(group.sd_vectors**2)) / np.sqrt(len(lengths))
    estimates: dict[str, Estimate] = {
        "targets": {"value": [names[r] for r in group.rows], "sd": None, "unit": "names"},
        "time": _make_estimate(group.time, group.sd_time, "s"),
        # mean length, across the rays
        "displacement": _make_estimate(lengths.mean(), sd, "mm"),
    }
    for axis, value in zip(("dX", "dY", "dZ"), group.vectors.mean(axis=0), strict=True):
        estimates[axis] = _make_estimate(value, sd, "mm")
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
        "note": "displacements are across the rays; a single camera sees none along them",
    }
    statement = effect.sentence(estimates)
    return EffectFound(effect.name, statement, where, estimates, evidence, [])


def _describe_noise_growth(e: ReducedSeries, growth: NoiseGrowth) -> EffectFound:
    effect = catalogue.find(lambda e: e.seen_in == "noise")
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
    if growth.gain <= growth.other_gain + noise_criteria.CLEAR:
        statement += f"; it follows {parameter_label(growth.other)} equally well"
    return EffectFound(effect.name, statement, where, estimates, evidence, [])
