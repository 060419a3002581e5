"""What none of the catalogue explains: the misfit, described, or a formula in place of a name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.entries import (
    EffectFound,
    Ridge,
    TradeOff,
    estimate_term,
    find_ridge,
    find_trade_off,
)
from thermocald.discovery.gap import Gap, fit_first
from thermocald.discovery.proposal import propose
from thermocald.photogrammetry.linalg import explained, inverse_of_determined
from thermocald.physics import catalogue
from thermocald.result import jsonable
from thermocald.thermal.scan import examine_all
from thermocald.thermal.series import COLUMNS, unit_directions

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array
    from thermocald.discovery.examination import Examination
    from thermocald.discovery.proposal import Proposal
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.scan import Adequacy
    from thermocald.thermal.series import ReducedSeries

# a shift of the image is attributed to the principal point before a tilt
_IN_ORDER = (range(3), range(3, 10), range(10, 16), range(16, len(COLUMNS)))


@dataclass(frozen=True, eq=False)
class Description:
    """Statement, where, estimates and evidence of an unnamed influence; trajectory (E,) px RMS, its
    direction (P,) in px-scaled columns.
    """

    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    trajectory: Array
    direction: Array


def describe_unnamed(x: Examination) -> Description:
    """Describe in time, space and correlations what the base model leaves in M1.

    Its size is what it moves the image points by, in px, and its parameters are the fewest whose
    movement of the image is nearly all of it.
    """
    a, e = x.base_adequacy[0], x.fitter.series[0]
    rest = a.trajectories.T @ a.amplitudes  # (E, P), px-scaled
    rest = rest - rest.mean(axis=0)
    seen = e.columns[e.weights[..., 0].any(axis=0)].reshape(-1, rest.shape[1])
    metric = seen.T @ seen / len(seen)
    moved = rest.T @ rest / len(rest)
    size = float(np.sqrt(np.sum(metric * moved)))
    values, vectors = np.linalg.eigh(metric)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    u, s, _ = np.linalg.svd(rest @ root, full_matrices=False)
    course_px = u[:, 0] * s[0]
    direction = rest.T @ u[:, 0] / s[0]
    T = e.history.temperature()  # on all epochs; the rows may be blocks of them
    recorded: dict[str, Array] = {
        "temperature": e.averaged(T),
        "rate of temperature": e.averaged(np.gradient(T, e.history.times)),
        "time": e.times,
        "sigma0": e.sigma0,
    }
    for name in e.history.readings:
        if name != e.history.reference:
            recorded[name] = e.averaged(e.history.temperature(name))
    correlation = {
        name: float(np.corrcoef(course_px, values)[0, 1])
        for name, values in recorded.items()
        if np.std(values) > 0
    }
    power = np.sum(a.scores**2, axis=1)
    order = int(np.argmax(power)) + 1
    duration = float(e.times[-1] - e.times[0])
    most = np.abs(course_px - course_px.mean())
    large = np.flatnonzero(most > 0.5 * most.max())
    parameters = _choose_movers(metric, moved)
    strongest = max(correlation, key=lambda k: abs(correlation[k]))
    statement = (
        f"something that no effect of the catalogue explains moves the image by {size:.3f} px RMS, "
        f"in {', '.join(parameters)}; strongest correlation {correlation[strongest]:+.2f} with "
        f"{strongest}. A smooth term bridges it in this series alone"
    )
    return Description(
        statement,
        {
            "parameters": parameters,
            "epochs": [int(e.numbers[large[0]]), int(e.numbers[large[-1]])],
            "image_region": None,
        },
        {
            "size": {"value": size, "sd": size / float(np.sqrt(max(a.excess, 1.0))), "unit": "px"},
            "time_scale": {"value": duration / order, "sd": duration / order / 4, "unit": "s"},
        },
        {
            "correlation": correlation,
            "share_of_first_pattern": float(s[0] ** 2 / np.sum(s**2)),
            "significance_sigmas": float(a.significance),
            "bridge": _describe_bridge(a, e),
        },
        course_px,
        direction,
    )


def _choose_movers(metric: Array, moved: Array) -> list[str]:
    """Choose the fewest parameters that move the image by nearly all that is left, interior first.

    metric (P, P): mean products of the image's partial derivatives; moved (P, P): mean products of
    the rest.
    """
    total = float(np.sum(metric * moved))
    chosen: list[int] = []
    explained = 0.0
    for group in _IN_ORDER:
        left = [i for i in group if metric[i, i] > 0]
        while left and explained < criteria.NAMED_SHARE * total:
            gains = []
            for i in left:
                some = [*chosen, i]
                inner = inverse_of_determined(metric[np.ix_(some, some)])
                gains.append(float(np.sum((metric[:, some] @ inner @ metric[some]) * moved)))
            best = int(np.argmax(gains))
            if gains[best] < explained + criteria.NAMED_WORTH * total:
                break
            explained = gains[best]
            chosen.append(left.pop(best))
    return [COLUMNS[i] for i in chosen]


def _describe_bridge(a: Adequacy, e: ReducedSeries) -> dict[str, Any]:
    """Return what takes the rest up in this series alone: amplitudes of cos(k π t / duration), k =
    1, 2, … with t from the first frame, in each parameter's own unit.
    """
    amplitudes = a.amplitudes / e.scale
    moving = [(i, name) for i, name in enumerate(COLUMNS) if amplitudes[:, i].any()]
    return {
        "transferable": False,
        "recording": e.source.name,
        "duration_s": float(e.times[-1] - e.times[0]),
        "cosines": {name: [float(v) for v in amplitudes[:, i]] for i, name in moving},
    }


NO_PROPOSAL = {
    True: "no formula over what was recorded explains it on both recordings: its cause was not "
    "recorded, or it is none that the operators describe",
    False: "a formula is proposed only where a second recording can test it: give --verify",
}
"""Why there is no proposal, by whether there is a second recording."""
_EXPERIMENT = "record over a wider range of temperatures, and at other rates"
_RIVALS = 4


@dataclass(frozen=True, eq=False)
class Proposed:
    """A formula as an entry of a discovery.

    examination: with the series it was found on; fits: base and whole, constants of M1 alone.
    """

    examination: Examination
    base_fit: Fit
    final_fit: Fit
    entry: EffectFound


def propose_entry(
    x: Examination,
    description: Description,
    gap: Gap,
    progress: Callable[[str], None] | None = None,
) -> Proposed | None:
    """Propose a formula for what an examination leaves unexplained; None where the data allow none.

    gap: for now, before and after; the caller knows better.
    """
    found = propose(x, description.where["parameters"], progress)
    if found is None:
        return None
    base_fit = fit_first(found.fitter, found.base.terms)
    final_fit = fit_first(found.fitter, found.best.terms)
    adequacy = examine_all(found.fitter, found.best.fit)
    examination = replace(
        x, fitter=found.fitter, base=found.base, best=found.best, adequacy=adequacy
    )
    term = found.terms[-1]
    e = found.fitter.series[0]
    estimates = estimate_term(final_fit, len(found.best.terms) - 1, e)
    together: Ridge | TradeOff | None = find_ridge(
        found.fitter, final_fit, len(found.best.terms) - 1
    )
    if together is not None:  # what the inverse says of them is of the others held
        estimates = {
            k: {**v, "sd": None} if k in together.names or k.startswith("a_") else v
            for k, v in estimates.items()
        }
    else:
        together = find_trade_off(found.fitter, final_fit, len(found.best.terms) - 1)
    sentence = catalogue.get(term.effect).sentence(estimates)
    if together is not None:
        sentence += together.sentence
    alternatives = [
        {
            "effect": t.effect,
            "score_difference": d,
            "values": dict(t.nonlinear),
            "experiment": _EXPERIMENT,
            "formula": True,
        }
        for t, d in found.rivals[:_RIVALS]
        if d < criteria.FORMULA_BAND
    ]
    entry = EffectFound(
        "unnamed",
        f"{sentence}; no effect of the catalogue, proposed from what was recorded",
        {**description.where, "parameters": list(term.parameters)},
        {**description.estimates, **estimates},
        {
            **{k: v for k, v in description.evidence.items() if k != "bridge"},
            "proposal": _describe_proposal(found, term, examination),
            **({"not_separable": jsonable(together)} if together is not None else {}),
        },
        alternatives,
        gap,
        gap,
        term,
    )
    return Proposed(examination, base_fit, final_fit, entry)


def _describe_proposal(found: Proposal, term: Term, x: Examination) -> dict[str, Any]:
    by_m1, by_m2 = found.closed
    return {
        "formula": term.effect,
        "transferable": True,
        "closed_on_verify_by_fit": by_m1,
        "closed_on_fit_by_verify": by_m2 if by_m2 == by_m2 else None,
        "score_gain": float(found.base.score - found.best.score),
        "penalty": float(found.best.penalties[-1]),
        "false_alarm_probability": found.surrogates.p,
        "surrogates": {
            "count": len(found.surrogates.surrogates),
            "explained": float(found.surrogates.gain),
            "largest_of_surrogates": float(found.surrogates.surrogates.max()),
        },
        "absolute_test": jsonable(x.adequacy),
    }


@dataclass(frozen=True)
class Misfit:
    """A misfit resolved.

    rows: (against what, size in px RMS, significance in sigma); targets: those that jumped;
    regions {(row, column) of a 3 × 3 grid over the image: what a free camera leaves, in units of
    the noise}.
    """

    rows: tuple[tuple[str, float, float], ...]
    targets: tuple[str, ...]
    regions: dict[tuple[int, int], float]

    def as_dict(self) -> dict[str, Any]:
        """Return the misfit as an effect's evidence has it."""
        return {
            "against": [
                {"what": what, "rms_px": size, "significance_sigmas": sigmas}
                for what, size, sigmas in self.rows
            ],
            "targets": list(self.targets),
            "image_regions": [
                {"row": i, "column": j, "noise_ratio": ratio}
                for (i, j), ratio in self.regions.items()
            ],
        }


def resolve(x: Examination, series: int = 0) -> Misfit:
    """Resolve the base model's misfit in one series."""
    e = x.fitter.series[series]
    fit = x.base.fit
    weighting = fit.weightings[series]
    C, V, index = fit.designs[series]
    coefficients = fit.coefficients[index]
    sigma = e.sigma_px
    coordinates = 2.0 * float(e.n.sum())

    def against(trajectories: Array, directions: Array) -> tuple[float, float]:
        A, c, B = weighting.scan(trajectories[None], directions, (C, V))
        rest = c[0] - B[0] @ coefficients
        gain, free = float(explained(A[0], rest, 1e-9)), len(rest)
        excess = max(gain - free, 0.0)
        return sigma * float(np.sqrt(excess / coordinates)), (gain - free) / np.sqrt(2.0 * free)

    every = x.base_adequacy[series].directions
    T = e.history.temperature()  # on all epochs; the rows may be blocks of them
    trajectories: dict[str, Array] = {
        "time": e.times - e.times.mean(),
        "temperature, bent": e.averaged((T - T.mean()) ** 2),
        "rate of temperature": e.averaged(np.gradient(T, e.history.times)),
    }
    for name in e.history.readings:
        if name != e.history.reference:
            trajectories[f"channel {name}"] = e.averaged(e.history.temperature(name))
    rows: list[tuple[str, float, float]] = []
    for name, trajectory in trajectories.items():
        rows.append((name, *against((trajectory - trajectory.mean())[:, None], every)))
    smooth = x.base_adequacy[series].trajectories.T
    for column in COLUMNS:
        one = unit_directions((column,))
        rows.append((f"{column}, slow trajectories", *against(smooth, one)))
    total = x.base_adequacy[series]
    rows.insert(0, ("all slow trajectories in all parameters", total.misfit_px, total.significance))
    rows.append(("noise level (sigma0)", *_test_noise(e.sigma0, e.n.astype(float), e.N.shape[1])))
    rows = [(what, float(size), float(sigmas)) for what, size, sigmas in rows]
    return Misfit(tuple(rows), tuple(_targets(x, series)), _measure_regions(e, sigma))


def _test_noise(sigma0: Array, n: Array, columns: int) -> tuple[float, float]:
    """Return the spread of sigma0 over the series, and how unlikely it is for a constant noise."""
    ok = n > 0
    free = 2.0 * n[ok] - columns
    z = float(np.sum(free * (sigma0[ok] - np.average(sigma0[ok], weights=free)) ** 2)) * 2
    count = float(ok.sum() - 1)
    return float(np.std(sigma0[ok])), (z - count) / np.sqrt(2 * count)


def _targets(x: Examination, series: int) -> list[str]:
    names = x.fitter.series[series].source.field.names
    return [names[r] for g in x.displaced[series] for r in g.rows]


def _measure_regions(e: ReducedSeries, sigma: float) -> dict[tuple[int, int], float]:
    """Return the RMS of what a free camera leaves, on a grid of 3 × 3, in units of the noise."""
    place = e.at.predicted
    row = np.clip((3 * place[:, 1] / e.source.sensor.height).astype(float), 0, 2.99)
    column = np.clip((3 * place[:, 0] / e.source.sensor.width).astype(float), 0, 2.99)
    out = {}
    for i in range(3):
        for j in range(3):
            inside = (np.floor(row) == i) & (np.floor(column) == j)
            v = e.residuals[:, inside]
            v = v[np.isfinite(v)]
            if len(v):
                out[(i, j)] = float(np.sqrt(np.mean(v**2)) / sigma)
    return out
