"""The description of a misfit without a name, and of a formula in place of a name."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.entries import (
    EffectFound,
    estimate_term,
    find_tied_constants,
)
from thermocald.numbers import parameter_label
from thermocald.photogrammetry.linalg import explained, inverse_of_determined
from thermocald.physics import catalogue
from thermocald.physics.formula import say_together
from thermocald.result import jsonable
from thermocald.thermal.scan import examine
from thermocald.thermal.series import COLUMNS, unit_directions

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.examination import Examination
    from thermocald.discovery.proposal import Proposal
    from thermocald.discovery.search import Solution
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.scan import Adequacy
    from thermocald.thermal.series import ReducedSeries

# a shift of the image is attributed to the principal point rather than to a tilt
_IN_ORDER = (range(3), range(3, 10), range(10, 16), range(16, len(COLUMNS)))


def describe_unnamed(x: Examination, alone: Adequacy) -> EffectFound:
    """Describe what the base model leaves in M1 by time, space and correlations.

    alone: of constants from M1; if they leave nothing, constants from all series do. The size is
    the movement of the image points, px; the parameters are the fewest that explain nearly all of
    this movement.
    """
    a, e = x.base_adequacy[0] if alone.adequate else alone, x.fitter.series[0]
    size, course_px, share, parameters = _measure_movement(e, a)
    rate, channels = _recorded(e)
    recorded = {**channels, "rate of temperature": rate, "time": e.times, "sigma0": e.sigma0}
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
    amplitudes = a.amplitudes / e.scale
    strongest = max(correlation, key=lambda k: abs(correlation[k]))
    moving = ", ".join(map(parameter_label, parameters))
    statement = (
        f"something that no effect of the catalogue explains moves the image by {size:.3f} px RMS, "
        f"in {moving}; strongest correlation {correlation[strongest]:+.2f} with "
        f"{parameter_label(strongest)}. A smooth term bridges it in this series only"
    )
    return EffectFound(
        "unnamed",
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
            "share_of_first_pattern": share,
            "significance_sigmas": float(a.significance),
            # explains the rest in this series only: amplitudes of cos(k π t / duration),
            # k = 1, 2, …, t from the first frame, in each parameter's own unit
            "bridge": {
                "transferable": False,
                "recording": e.source.name,
                "duration_s": duration,
                "cosines": {
                    name: amplitudes[:, i].tolist()
                    for i, name in enumerate(COLUMNS)
                    if amplitudes[:, i].any()
                },
            },
        },
        [],
    )


def _measure_movement(e: ReducedSeries, a: Adequacy) -> tuple[float, Array, float, list[str]]:
    """Measure the movement of the image in a misfit.

    Returns its RMS, px, its strongest pattern's course (E,) and share, and the parameters that move
    the image.
    """
    rest = a.movement - a.movement.mean(axis=0)
    seen = e.columns[e.weights[..., 0].any(axis=0)].reshape(-1, rest.shape[1])
    metric = seen.T @ seen / len(seen)
    moved = rest.T @ rest / len(rest)
    values, vectors = np.linalg.eigh(metric)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    u, s, _ = np.linalg.svd(rest @ root, full_matrices=False)
    size, share = float(np.sqrt(np.sum(metric * moved))), float(s[0] ** 2 / np.sum(s**2))
    return size, u[:, 0] * s[0], share, _choose_movers(metric, moved)


def _choose_movers(metric: Array, moved: Array) -> list[str]:
    """Choose the fewest parameters that explain nearly all of the image's movement, interior first.

    metric (P, P): mean products of the image's partial derivatives; moved (P, P): mean products of
    the parameters' movements.
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


def say_contradiction(x: Examination) -> str | None:
    """Say what reproduces a series alone, with constants of its own; None if nothing does."""
    fitter, every = x.fitter, range(len(x.fitter.series))

    def reproduces(s: Solution, series: int) -> bool:
        fit = fitter.refine(fitter.fit(s.terms, only=[series]), only=[series])
        return examine(fitter, fit, series).adequate

    if len(every) < 2:
        return None
    if reproduces(x.base, 0):
        found = "the model reproduces the first recording alone, and lacks no effect there"
    elif names := [s.names[-1] for s in x.ranking[:4] if all(reproduces(s, k) for k in every)]:
        found = (
            f"with {' or '.join(dict.fromkeys(names))} the model reproduces each recording alone"
        )
    else:
        return None
    return (
        f"the recordings contradict each other: {found}, but its constants do not hold in another; "
        "was the camera, its focus, its mount or the thermometer changed between them?"
    )


NO_PROPOSAL = {
    True: "no formula of the recorded quantities explains it in both recordings: its cause was not "
    "recorded, or the operators do not describe it",
    False: "a formula is proposed only if a second recording can test it: give --verify",
}
"""Why there is no proposal, by whether there is a second recording."""
_EXPERIMENT = "record over a wider range of temperatures, and at other rates"
_RIVALS = 4


def describe_proposal(
    described: EffectFound, proposal: Proposal, x: Examination, fit: Fit
) -> EffectFound:
    """Describe a formula proposed in place of a name.

    described: the misfit that it explains; x: the examination with the series in which the formula
    was found; fit: constants from M1 alone.
    """
    number = len(proposal.best.terms) - 1
    term = proposal.best.terms[number]
    estimates = estimate_term(fit, number, x.fitter.series[0])
    tied = find_tied_constants(x.fitter, fit, number)
    if tied and tied["exchanged"]:  # the inverse holds their sds with the others held, so none
        estimates = {
            k: {**v, "sd": None} if k in tied["parameters"] or k.startswith("a_") else v
            for k, v in estimates.items()
        }
    sentence = catalogue.get(term.effect).sentence(estimates)
    evidence = {k: v for k, v in described.evidence.items() if k != "bridge"}
    by_m1, by_m2 = proposal.closed
    evidence["proposal"] = {
        "formula": term.effect,
        "transferable": True,
        "closed_on_verify_by_fit": by_m1,
        "closed_on_fit_by_verify": by_m2 if by_m2 == by_m2 else None,
        "score_gain": float(proposal.base.score - proposal.best.score),
        "penalty": float(proposal.best.penalties[-1]),
        "false_alarm_probability": proposal.surrogates.p,
        "surrogates": {
            "count": len(proposal.surrogates.surrogates),
            "explained": float(proposal.surrogates.gain),
            "largest_of_surrogates": float(proposal.surrogates.surrogates.max()),
        },
        "absolute_test": jsonable(x.adequacy),
    }
    if tied:
        evidence["not_separable"] = tied
        sentence += f"; {say_together(tied)}"
    return replace(
        described,
        statement=f"{sentence}; a formula from the recorded quantities, no effect of the catalogue",
        where={**described.where, "parameters": list(term.parameters)},
        estimates={**described.estimates, **estimates},
        evidence=evidence,
        alternatives=[
            {
                "effect": t.effect,
                "score_difference": d,
                "values": dict(t.nonlinear),
                "experiment": _EXPERIMENT,
                "formula": True,
            }
            for t, d in proposal.rivals[:_RIVALS]
            if d < criteria.FORMULA_BAND
        ],
        term=term,
    )


def describe_misfit(x: Examination) -> dict[str, Any]:
    """Return where the base model fails in M1, for an effect's evidence.

    against: size, px RMS, and significance of the misfit along each recorded quantity and in each
    parameter; targets: those that jumped; image_regions: a free camera's residuals in units of the
    noise, on a grid of 3 × 3 over the image.
    """
    e, fit = x.fitter.series[0], x.base.fit
    C, V, index = fit.designs[0]
    coordinates = 2.0 * float(e.n.sum())
    rows: list[tuple[str, float, float]] = []

    def add(what: str, trajectories: Array, directions: Array) -> None:
        A, c, B = fit.weightings[0].scan(trajectories[None], directions, (C, V))
        rest = c[0] - B[0] @ fit.coefficients[index]
        gain, free = float(explained(A[0], rest, 1e-9)), len(rest)
        size = e.sigma_px * float(np.sqrt(max(gain - free, 0.0) / coordinates))
        rows.append((what, size, (gain - free) / np.sqrt(2.0 * free)))

    total = x.base_adequacy[0]
    rows.append(("all slow trajectories in all parameters", total.misfit_px, total.significance))
    T, (rate, channels) = e.history.temperature(), _recorded(e)
    trajectories = {
        "time": e.times,
        "temperature, bent": e.averaged((T - T.mean()) ** 2),
        "rate of temperature": rate,
        **{f"channel {n}": v for n, v in channels.items() if n != e.history.reference},
    }
    for name, trajectory in trajectories.items():
        add(name, (trajectory - trajectory.mean())[:, None], total.directions)
    for column in COLUMNS:
        add(f"{column}, slow trajectories", total.trajectories.T, unit_directions((column,)))
    # the spread of sigma0 in the series, and its significance against constant noise
    ok = e.n > 0
    degrees = 2.0 * e.n[ok] - e.N.shape[1]
    off = e.sigma0[ok] - np.average(e.sigma0[ok], weights=degrees)
    z, count = float(np.sum(degrees * off**2)) * 2, float(ok.sum() - 1)
    spread = float(np.std(e.sigma0[ok]))
    rows.append(("noise level (sigma0)", spread, (z - count) / np.sqrt(2 * count)))
    names = e.source.field.names
    return {
        "against": [
            {"what": what, "rms_px": float(size), "significance_sigmas": float(sigmas)}
            for what, size, sigmas in rows
        ],
        "targets": [names[r] for g in x.displaced[0] for r in g.rows],
        "image_regions": _measure_regions(e),
    }


def _measure_regions(e: ReducedSeries) -> list[dict[str, Any]]:
    """Return the RMS of a free camera's residuals in units of the noise, on a grid of 3 × 3."""
    size = np.array([e.source.sensor.width, e.source.sensor.height])
    place = np.clip(np.nan_to_num(3 * e.at.predicted / size), 0, 2).astype(int)
    out = []
    for i, j in np.ndindex(3, 3):
        v = e.residuals[:, (place == (j, i)).all(axis=1)]
        if np.isfinite(v).any():
            ratio = float(np.sqrt(np.nanmean(v**2)) / e.sigma_px)
            out.append({"row": i, "column": j, "noise_ratio": ratio})
    return out


def _recorded(e: ReducedSeries) -> tuple[Array, dict[str, Array]]:
    """Return the reference's rate K/s and all temperatures °C, by name, at the rows of a series.

    The rows may be blocks of epochs, and several epochs may have the same time.
    """
    h = e.history
    times, first = np.unique(h.times, return_index=True)
    rate = np.interp(h.times, times, np.gradient(h.temperature()[first], times))
    return e.averaged(rate), {n: e.averaged(h.temperature(n)) for n in h.readings}
