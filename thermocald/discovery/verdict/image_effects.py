"""Effects found beyond the camera's trajectories: single targets that moved, noise that grew."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.verdict.estimates import displacement_estimates, growth_estimates
from thermocald.discovery.verdict.found import EffectFound
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from thermocald.discovery.search.examination import Examination
    from thermocald.discovery.verdict.gap import Gap
    from thermocald.reduction.noise_growth import NoiseGrowth
    from thermocald.reduction.series import ReducedSeries

__all__ = ["image_effects", "image_places"]


def image_places(x: Examination) -> list[str]:
    """Where such effects were seen ("targets", "noise"), in the order of the document."""
    places = ["targets"] if x.displaced[0] else []
    return [*places, "noise"] if x.noise_growth else places


def image_effects(x: Examination, gap: Gap) -> list[EffectFound]:
    """The entries of the document; gap: of the base model, which the caller replaces."""
    out = []
    if x.displaced[0]:
        out.append(_moved_targets(x, gap))
    if x.noise_growth:
        out.append(_noise_growth(x.fitter.series[0], x.noise_growth, gap))
    return out


def _moved_targets(x: Examination, gap: Gap) -> EffectFound:
    e = x.fitter.series[0]
    names = e.source.field.names
    group = max(x.displaced[0], key=lambda g: g.gain)
    effect = catalogue.seen_in("targets")
    estimates = displacement_estimates(group, names)
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


def _noise_growth(e: ReducedSeries, growth: NoiseGrowth, gap: Gap) -> EffectFound:
    effect = catalogue.seen_in("noise")
    estimates = growth_estimates(growth)
    where = {
        "parameters": ["sigma0"],
        "epochs": [int(e.source.numbers[0]), int(e.source.numbers[-1])],
        "image_region": None,
    }
    evidence = {
        "log_likelihood_gain": growth.gain,
        "next_best": growth.other,
        "next_best_course": growth.other,  # its name until the next version
        "next_best_gain": growth.other_gain,
    }
    statement = effect.sentence(estimates)
    if not growth.excludes_other:
        statement += f"; it follows {growth.other} as well"
    return EffectFound(effect.name, statement, where, estimates, evidence, [], gap, gap)
