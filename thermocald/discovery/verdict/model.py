"""What was found, as the next version of a thermal model that `simulate` runs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.verdict.found import effects_of
from thermocald.discovery.verdict.level import level_of
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.reduction.hypothesis import BASE
from thermocald.reduction.series import COLUMNS
from thermocald.simulation.model import ThermalModel

if TYPE_CHECKING:
    from thermocald.discovery.verdict.result import Discovery

__all__ = ["model_of"]


def model_of(discovery: Discovery, old: ThermalModel | None = None) -> ThermalModel:
    """The model with what was found; constants as M1 alone gave them.

    An effect keeps what it is fresh in (an time, a phase) as M1 had it.
    """
    x, fit = discovery.examination, discovery.final_fit
    e = x.fitter.series[0]
    level, sd = level_of(x.fitter, fit)
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
    document = discovery.as_json(None)
    out: dict[str, Any] = {"verdict": discovery.verdict, "gap": document["gap"]}
    for entry in document["effects"]:
        out[entry["effect"]] = {
            "statement": entry["statement"],
            "evidence": entry["evidence"],
            "alternatives": entry["alternatives"],
        }
        if "bridge" in entry["evidence"]:
            out["unnamed"]["note"] = "bridged by a smooth term in M1 alone; not transferable"
    plain: dict[str, Any] = _plain(out)
    return plain


def _plain(value: Any) -> Any:
    """Numbers as YAML writes them."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
