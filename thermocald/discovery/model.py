"""What was found, as the next version of a thermal model that `simulate` runs.

The level of a discovered model: camera and orientation at T₀, with all effects at zero.

The readings' errors move the level as they move the drifts, and so do the drifts' own: level and
drifts are one system of normal equations, from which the thermometers' errors are eliminated. What
the test field's coordinates do to the level is added.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.entries import effects_of
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.linalg import inverse_of_determined, scaled_inverse
from thermocald.physics.model import ThermalModel
from thermocald.thermal.hypothesis import BASE
from thermocald.thermal.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.result import Discovery
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries

_P = len(PARAMETER_NAMES)


def estimate_level(fitter: HypothesisFitter, fit: Fit) -> tuple[Array, Array]:
    """Estimate the level (16,) of the first series about its linearisation, px-scaled, and its sds
    (16,).

    The scales of the test field are held. The sds hold the noise of image and thermometers, the
    drifts' own errors, and the stated errors of the test field's coordinates.
    """
    C, V = fitter.design(fit.terms, fit.blocks, 0, centred=False)[:2]
    index, weighting = fit.designs[0][2], fit.weightings[0]
    searched = list(fit.searched)
    dC, dV, mapping = fitter.derivatives(fit, searched, 0, centred=False)
    A, _, coupling = weighting.joint(np.hstack([C, dC]), np.hstack([V, dV]))
    drifts = coupling[:, : C.shape[1]] @ fit.coefficients[index]
    own = weighting.level_normal[:_P, :_P]
    level = inverse_of_determined(own) @ (weighting.level_b - drifts)[:_P]

    K = len(fit.coefficients)
    T = np.zeros((len(A) + _P, _P + K + len(searched)))
    T[np.arange(C.shape[1]), _P + index] = 1.0
    T[C.shape[1] : len(A), _P + K :] = mapping
    T[len(A) :, :_P] = np.eye(_P)
    normal = T.T @ np.block([[A, coupling[:_P].T], [coupling[:_P], own]]) @ T
    empty = np.diag(normal) <= 0
    normal[empty, empty] = 1e12  # a coefficient of another series
    along = fitter.series[0].along[:_P, :_P]
    Q = scaled_inverse(normal)[:_P, :_P] + _field_errors(fitter.series[0])
    return along @ level, np.sqrt(np.einsum("ij,jk,ik->i", along, Q, along))


def _field_errors(series: ReducedSeries) -> Array:
    """Return the covariance (16, 16) that the errors of the targets' coordinates give the level."""
    weights = series.weights[..., :2].sum(axis=0)
    A = series.columns[..., :_P]
    WA = A * weights[..., None]
    lever = np.einsum("tci,tcx->itx", WA, series.at.B).reshape(_P, -1)
    moved = inverse_of_determined(np.einsum("tci,tcj->ij", WA, A)) @ (
        lever * series.source.field.sigmas.ravel()
    )
    return np.asarray(moved @ moved.T)


def build_model(discovery: Discovery, old: ThermalModel | None = None) -> ThermalModel:
    """Build the model with what was found; constants as M1 alone gave them.

    An effect keeps what it is fresh in (an time, a phase) as M1 had it.
    """
    x, fit = discovery.examination, discovery.final_fit
    e = x.fitter.series[0]
    level, sd = estimate_level(x.fitter, fit)
    scale = e.scale[: len(PARAMETER_NAMES)]
    start = np.concatenate([e.at.iop, e.at.eop])
    values, sds = start + level / scale, sd / scale
    block = fit.blocks[0]
    rates, rate_sds = {}, {}
    for j, name in enumerate(BASE):
        unit = e.scale[COLUMNS.index(name)]
        rates[name] = float(fit.coefficients[block.start + j] / unit)
        rate_sds[f"rates.{name}"] = float(np.sqrt(fit.covariance[j, j]) / unit)
    T = e.history.temperature()
    effects = [one for found in discovery.effects for one in effects_of(found)]
    weights = e.weights[..., :2] / e.source.per_row[:, None, None]
    model = ThermalModel(
        camera=e.source.camera,
        sensor=e.source.sensor,
        T0=e.T0,
        interior=InteriorOrientation.from_array(values[:10]),
        rates=rates,
        effects=tuple(effects),
        distortion=e.distortion,
        exterior=ExteriorOrientation.from_array(values[10:]),
        image_sigma=float(1.0 / np.sqrt(np.mean(weights[weights > 0]))),
        sds={
            **{f"interior.{n}": float(s) for n, s in zip(IOP_NAMES, sds[:10], strict=True)},
            **{f"exterior.{n}": float(s) for n, s in zip(EOP_NAMES, sds[10:], strict=True)},
            **rate_sds,
        },
        validity={e.history.reference: (float(T.min()), float(T.max()))},
        fitted_on=[{"recording": s.source.name, "epochs": int((s.n > 0).sum())}
                   for s in x.fitter.series[:1]],
        evidence=_evidence(discovery),
        name=old.name if old else e.source.camera,
        version=old.version + 1 if old else 1,
    )  # fmt: skip
    return replace(model)


def _evidence(discovery: Discovery) -> dict[str, Any]:
    document = discovery.as_dict()
    out: dict[str, Any] = {"verdict": discovery.verdict, "gap": document["gap"]}
    for entry in document["effects"]:
        out[entry["effect"]] = {
            "statement": entry["statement"],
            "evidence": entry["evidence"],
            "alternatives": entry["alternatives"],
        }
        if "bridge" in entry["evidence"]:
            out["unnamed"]["note"] = "bridged by a smooth term in M1 alone; not transferable"
    plain: dict[str, Any] = _make_plain(out)
    return plain


def _make_plain(value: Any) -> Any:
    """Turn numbers into those that YAML writes."""
    if isinstance(value, dict):
        return {str(k): _make_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_make_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
