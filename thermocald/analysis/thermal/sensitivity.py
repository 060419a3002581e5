"""How a model's prediction depends on its parameters and on the readings, epoch by epoch.

Parameters (22,): the camera's 16, three scales of the field's coordinates, a displacement in mm.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, PARAMETER_NAMES
from thermocald.physics import catalogue
from thermocald.physics.catalogue import drive_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.history import History
    from thermocald.physics.model import Prediction, ThermalModel

__all__ = ["derivatives", "reading_operators", "unresolved"]

_COLUMNS = (*PARAMETER_NAMES, "scale_X", "scale_Y", "scale_Z", "dX", "dY", "dZ")


def derivatives(
    history: History, field: TestField, model: ThermalModel, names: Sequence[str]
) -> Array:
    """∂ parameters / ∂ numbers of the model (E, 22, q), by central differences."""
    found = []
    for name in names:
        group, key = name.split(".", 1)
        if group == "rates":
            value = model.rates.get(key, 0.0)
            step = 1e-3 * max(abs(value), 1e-6)
            sides = [replace(model, rates={**model.rates, key: value + d}) for d in (step, -step)]
        else:
            place = next(i for i, e in enumerate(model.effects) if e.name == group)
            effect = model.effects[place]
            value = float(effect.values[key])
            kind = catalogue.get(group)
            searched = kind.nonlinear.get(key)
            step = searched.difference_step(value) if searched else 1e-3 * max(abs(value), 1e-6)
            sides = []
            for moved in (value + step, value - step):
                changed = replace(effect, values={**effect.values, key: moved})
                listed = (*model.effects[:place], changed, *model.effects[place + 1 :])
                sides.append(replace(model, effects=listed))
        one, other = (_packed(m.predict(history, field)) for m in sides)
        found.append((one - other) / (2.0 * step))
    return np.stack(found, axis=2) if found else np.zeros((len(history.times), 22, 0))


def _packed(prediction: Prediction) -> Array:
    """What a model says, as parameters (E, 22)."""
    d = np.zeros((len(prediction.iop), len(_COLUMNS)))
    d[:, :10], d[:, 10:16], d[:, 16:19] = prediction.iop, prediction.eop, prediction.scale
    for displacement in prediction.displacements:
        d[:, 19:22] += displacement.active[:, None] * displacement.vector
    return d


def reading_operators(history: History, model: ThermalModel) -> list[tuple[Array, str, csr_array]]:
    """How the readings' errors reach the parameters: weights (22,), channel, operator (E, R)."""
    found: list[tuple[Array, str, csr_array]] = []
    rates = _rates(model)
    if np.any(rates):
        operator = drive_matrix(history, model.drives)
        assert operator is not None
        found.append((rates, history.reference, operator))
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        nonlinear, coefficients = kind.split(effect.values)
        if kind.is_drive or kind.seen_in == "noise" or not any(coefficients.values()):
            continue
        S = kind.sensitivity(history, **nonlinear)
        if S.nnz:
            channel = kind.channel(history, **nonlinear)
            found.append((_weights(model, effect.name, coefficients), channel, S))
    return found


def unresolved(
    history: History, model: ThermalModel, rate_jump: Array
) -> list[tuple[Array, Array]]:
    """What the readings' times leave open: weights (22,) and standard deviations (E,)."""
    found = []
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        nonlinear, coefficients = kind.split(effect.values)
        if kind.kind == "image":
            continue
        left = kind.unresolved(history, rate_jump, **nonlinear)
        weights = _rates(model) if kind.is_drive else _weights(model, effect.name, coefficients)
        if np.any(left) and np.any(weights):
            found.append((weights, left))
    return found


def _rates(model: ThermalModel) -> Array:
    weights = np.zeros(len(_COLUMNS))
    weights[: len(IOP_NAMES)] = model.rate_vector
    return _carried(model, weights)


def _weights(model: ThermalModel, name: str, coefficients: Mapping[str, float]) -> Array:
    weights = np.zeros(len(_COLUMNS))
    for key, value in coefficients.items():
        weights[_COLUMNS.index(catalogue.get(name).column(key))] = value
    return _carried(model, weights)


def _carried(model: ThermalModel, weights: Array) -> Array:
    """Let the distortion follow what moves c, about T₀."""
    moved = model.carried_derivatives(model.interior.as_array(), weights[:10, None])[:, 0]
    return np.concatenate([moved, weights[10:]])
