"""A model of a camera type: the mean of several specimens, and how much they differ.

The standard deviation of a type model is that of one more specimen: scatter between the cameras,
and how well their mean is known. It is what a user has who did not calibrate, and the prior of one
who measured at a few temperatures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.random_effects import population
from thermocald.analysis.thermal.state import is_event
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, InteriorOrientation
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["type_model"]


def type_model(models: Sequence[ThermalModel], name: str) -> ThermalModel:
    """The type model of several cameras' models, which must have one structure and one T₀.

    DataError for fewer than two, or for models that are not alike.
    """
    if len(models) < 2:
        raise DataError("a type model needs at least two cameras")
    # what happened to one camera at one time is nothing of the type
    models = [replace(m, effects=tuple(e for e in m.effects if not is_event(e))) for m in models]
    first = models[0]
    for m in models[1:]:
        same = [e.name for e in m.effects] == [e.name for e in first.effects]
        if m.sensor != first.sensor or m.T0 != first.T0 or not same:
            raise DataError(
                f"the models of {first.camera} and {m.camera} are not alike: sensor, reference "
                "temperature and effects must be the same; fit them with the same options"
            )
    names = _names(first)
    values = np.array([[_value(m, n) for n in names] for m in models])
    n = len(models)
    people = population(values, np.array([_covariance(m, names) for m in models]))
    covariance = people.prior
    found = dict(zip(names, people.mean.tolist(), strict=True))
    sd = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    listed = []
    for effect in first.effects:
        own = {k: f"{effect.name}.{k}" for k in effect.values if f"{effect.name}.{k}" in found}
        listed.append(
            ModelEffect(
                effect.name,
                {**effect.values, **{k: found[f] for k, f in own.items()}},
                {k: sd[f] for k, f in own.items()},
            )
        )
    low = max(m.validity[c][0] for m in models for c in list(m.validity)[:1])
    high = min(m.validity[c][1] for m in models for c in list(m.validity)[:1])
    channel = next(iter(first.validity), "temperature")
    return replace(
        first,
        camera=name,
        name=f"type {name}, {n} cameras",
        interior=InteriorOrientation(**{p: found[f"interior.{p}"] for p in IOP_NAMES}),
        rates={p: found[f"rates.{p}"] for p in RATED},
        effects=tuple(listed),
        exterior=None,
        sds={k: v for k, v in sd.items() if k.split(".")[0] in ("interior", "rates")},
        covariance_names=names,
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        validity={channel: (low, high)} if low < high else first.validity,
        fitted_on=tuple({"camera": m.camera, "version": m.version} for m in models),
    )


def _names(model: ThermalModel) -> tuple[str, ...]:
    return tuple(n for n in model.parameter_names() if not n.startswith("exterior."))


def _value(model: ThermalModel, name: str) -> float:
    group, key = name.split(".", 1)
    if group == "interior":
        return float(getattr(model.interior, key))
    if group == "rates":
        return float(model.rates.get(key, 0.0))
    return float(next(e for e in model.effects if e.name == group).values[key])


def _covariance(model: ThermalModel, names: tuple[str, ...]) -> Array:
    """The covariance (k, k) of a model's numbers; else of its standard deviations."""
    if model.covariance is None or not set(names) & set(model.covariance_names):
        return np.diag([_sd(model, n) ** 2 for n in names])
    place = {n: i for i, n in enumerate(model.covariance_names)}
    full = np.array(model.covariance)
    rows = [place.get(n, -1) for n in names]
    known = np.array([r >= 0 for r in rows])
    return np.where(np.outer(known, known), full[np.ix_(rows, rows)], 0.0)


def _sd(model: ThermalModel, name: str) -> float:
    group, key = name.split(".", 1)
    if group in ("interior", "rates"):
        return float(model.sds.get(name, 0.0))
    return float(next(e for e in model.effects if e.name == group).sds.get(key, 0.0))
