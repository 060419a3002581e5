"""The unknowns of a thermal model's fit: their names, and the model after a step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.model_system import unknowns_of
from thermocald.photogrammetry.camera_model import EOP_NAMES, ExteriorOrientation
from thermocald.simulation import effects
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["FREE_INTERIOR", "FitState"]

FREE_INTERIOR = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
"""The interior orientation at T₀ that is estimated; the affinity is held."""


@dataclass(frozen=True, eq=False)
class FitState:
    """A model and the exterior orientation (6,) of each series; fixed: unknowns that are held."""

    model: ThermalModel
    exteriors: tuple[Array, ...]
    fixed: frozenset[str] = frozenset()

    def of_series(self, k: int) -> ThermalModel:
        """The model with the exterior orientation of series k."""
        return replace(self.model, exterior=ExteriorOrientation.from_array(self.exteriors[k]))

    @property
    def names(self) -> list[str]:
        """The unknowns: common ones first, then six of each series."""
        names = [f"interior.{n}" for n in FREE_INTERIOR] + [f"rates.{n}" for n in RATED]
        for effect in self.model.effects:
            names += [f"{effect.name}.{key}" for key in unknowns_of(effect)]
        names = [n for n in names if n not in self.fixed]
        return names + [f"exterior.{n}@{k}" for k in range(len(self.exteriors)) for n in EOP_NAMES]

    def columns(self, k: int) -> NDArray[np.int64]:
        """Where the unknowns of series k stand among all."""
        common = len(self.names) - 6 * len(self.exteriors)
        return np.concatenate([np.arange(common), common + 6 * k + np.arange(6)])

    def moved(self, step: Array) -> FitState:
        """The state after a step (p,)."""
        change = dict(zip(self.names, step, strict=True))
        interior = self.model.interior
        interior = interior.with_values(
            **{n: getattr(interior, n) + change[f"interior.{n}"] for n in FREE_INTERIOR}
        )
        rates = {n: self.model.rates.get(n, 0.0) + change[f"rates.{n}"] for n in RATED}
        listed = tuple(_moved_effect(e, change) for e in self.model.effects)
        exteriors = tuple(
            x + np.array([change[f"exterior.{n}@{k}"] for n in EOP_NAMES])
            for k, x in enumerate(self.exteriors)
        )
        model = replace(self.model, interior=interior, rates=rates, effects=listed)
        return FitState(model, exteriors, self.fixed)


def _moved_effect(effect: ModelEffect, change: dict[str, float]) -> ModelEffect:
    values = dict(effect.values)
    kind = effects.get(effect.name)
    for key in unknowns_of(effect):
        name = f"{effect.name}.{key}"
        if name not in change:
            continue
        value = float(values[key]) + change[name]
        if key in kind.nonlinear and key != "phase":
            p, old = kind.nonlinear[key], float(values[key])
            # a step across the range is a step too far
            low, high = (max(p.low, old / 2), min(p.high, old * 2)) if p.log else (p.low, p.high)
            value = float(np.clip(value, low, high))
        values[key] = value
    return replace(effect, values=values)
