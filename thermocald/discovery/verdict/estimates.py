"""Estimates of one effect in its own units, with standard deviations, from a fitted hypothesis."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.series import COLUMNS, FIELD_SCALES
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from thermocald.discovery.evidence.image_space import Displaced
    from thermocald.reduction.hypothesis import Block, Fit
    from thermocald.reduction.noise_growth import NoiseGrowth
    from thermocald.reduction.series import ReducedSeries

__all__ = ["displacement_estimates", "growth_estimates", "model_values", "term_estimates"]

Estimate = dict[str, Any]


def _number(value: float, sd: float, unit: str) -> Estimate:
    return {"value": float(value), "sd": float(sd), "unit": unit}


def term_estimates(fit: Fit, number: int, evidence: ReducedSeries) -> dict[str, Estimate]:
    """All parameters of one term: searched ones by name, coefficients as `a_<parameter>`."""
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
            first = int(np.searchsorted(evidence.times, value - 1e-6))
            before = float(evidence.times[max(first - 1, 0)])
            out[name] = _number(
                0.5 * (before + value), max(value - before, 1e-3) / np.sqrt(12.0), units[name]
            )
            continue
        sd = float("nan")
        if (number, name) in fit.searched:
            place = K + fit.searched.index((number, name))
            sd = float(np.sqrt(fit.covariance[place, place]))
        out[name] = _number(value, sd, units[name])
    for block in fit.blocks:
        if block.term == number and block.series in (None, 0):
            out.update(_coefficients(fit, block, evidence, units))
    return out


def _coefficients(
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
        out["phase"] = _number(phase, float(np.sqrt(across @ C @ across.T)[0, 0]) / s[0], "rad")
    else:
        a, sds = x[0], np.sqrt(np.diag(C))
    for name, value, sd, factor in zip(block.parameters, a, sds, scale, strict=True):
        short = name.removeprefix("scale_")
        out[f"a_{short}"] = _number(value / factor, sd / factor, units.get(short, ""))
    return out


def model_values(
    estimates: dict[str, Estimate], parameters: tuple[str, ...]
) -> tuple[dict[str, Any], dict[str, float]]:
    """Values and standard deviations by the names that the simulation's effect uses."""
    values: dict[str, Any] = {}
    sds: dict[str, float] = {}
    known = {p.removeprefix("scale_") for p in parameters}
    for key, e in estimates.items():
        name = key[2:] if key.startswith("a_") and key[2:] in known else key
        values[name] = e["value"]
        if e["sd"] is not None and np.isfinite(e["sd"]):
            sds[name] = e["sd"]
    return values, sds


def displacement_estimates(group: Displaced, names: tuple[str, ...]) -> dict[str, Estimate]:
    """Targets, time, and displacement across the rays: the mean of the targets' lengths."""
    lengths = np.linalg.norm(group.vectors, axis=1)
    sd = np.sqrt(np.mean(group.sd_vectors**2)) / np.sqrt(len(lengths))
    mean = group.vectors.mean(axis=0)
    out: dict[str, Estimate] = {
        "targets": {"value": [names[r] for r in group.rows], "sd": None, "unit": "names"},
        "time": _number(group.time, group.sd_time, "s"),
        "displacement": _number(float(lengths.mean()), float(sd), "mm"),
    }
    for axis, value in zip(("dX", "dY", "dZ"), mean, strict=True):
        out[axis] = _number(float(value), float(sd), "mm")
    return out


def growth_estimates(growth: NoiseGrowth) -> dict[str, Estimate]:
    """The factor of the noise per K."""
    return {"factor": _number(growth.factor, growth.sd, "1/K")}


def acts_on(parameters: tuple[str, ...]) -> list[str]:
    """Parameters in the words of the document."""
    return [p if p not in FIELD_SCALES else f"object {p[-1]}" for p in parameters]
