"""The unknowns of a thermal model's fit: their names, and the model after a step.

Most belong to the camera and are common to all series. To a series belong its exterior orientation
and what its effects call fresh: a phase, or an event with its instant and its height. Of these the
unknown of series k is called `slip.c@k`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, ExteriorOrientation
from thermocald.simulation import effects
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["FREE_INTERIOR", "FitState", "is_event", "own_of", "unknowns_of"]

FREE_INTERIOR = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
"""The interior orientation at T₀ that is estimated; the affinity is held."""


def is_event(effect: ModelEffect) -> bool:
    """Whether it happens at one instant of a series, or not at all."""
    return effects.get(effect.name).is_event


def unknowns_of(effect: ModelEffect) -> tuple[str, ...]:
    """The parameters of an effect that Gauss-Newton estimates and that all series share."""
    if effects.get(effect.name).seen_in == "noise" or is_event(effect):
        return ()  # the noise has no normal equations
    return tuple(
        key
        for key, value in effect.values.items()
        if isinstance(value, int | float) and key not in effects.get(effect.name).fresh
    )


def own_of(effect: ModelEffect) -> tuple[str, ...]:
    """The parameters that Gauss-Newton estimates for each series; an instant is searched."""
    kind = effects.get(effect.name)
    fresh = tuple(kind.linear) if is_event(effect) else kind.fresh
    return tuple(key for key in effect.values if key in fresh)


@dataclass(frozen=True, eq=False)
class FitState:
    """A model, and what belongs to each of its series.

    exteriors: (6,) of each series; own: {`slip.time`: value} of each, by default the model's;
    fixed: unknowns that are held.
    """

    model: ThermalModel
    exteriors: tuple[Array, ...]
    fixed: frozenset[str] = frozenset()
    own: tuple[Mapping[str, float], ...] = ()

    def of_series(self, k: int) -> ThermalModel:
        """The model with what belongs to series k."""
        own = self.own[k] if self.own else {}
        listed = tuple(
            replace(e, values={n: own.get(f"{e.name}.{n}", v) for n, v in e.values.items()})
            for e in self.model.effects
        )
        exterior = ExteriorOrientation.from_array(self.exteriors[k])
        return replace(self.model, effects=listed, exterior=exterior)

    def with_own(self, k: int, values: Mapping[str, float]) -> FitState:
        """The state with other values of what belongs to series k."""
        own = [dict(o) for o in self.own] or [{} for _ in self.exteriors]
        own[k] |= values
        return replace(self, own=tuple(own))

    def of_some(self, some: list[int]) -> FitState:
        """The state of some of the series; what is held in a series is forgotten."""
        return FitState(
            self.model,
            tuple(self.exteriors[k] for k in some),
            frozenset(n for n in self.fixed if "@" not in n),
            tuple(self.own[k] for k in some) if self.own else (),
        )

    def fixed_in(self, k: int) -> frozenset[str]:
        """What is held in series k, by the model's own names."""
        return frozenset(n.split("@")[0] for n in self.fixed if "@" not in n or n.endswith(f"@{k}"))

    @property
    def common(self) -> list[str]:
        """The unknowns that all series share."""
        names = [f"interior.{n}" for n in FREE_INTERIOR] + [f"rates.{n}" for n in RATED]
        for effect in self.model.effects:
            names += [f"{effect.name}.{key}" for key in unknowns_of(effect)]
        return [n for n in names if n not in self.fixed]

    @property
    def drifts(self) -> frozenset[str]:
        """The common unknowns but the level at T₀."""
        return frozenset(n for n in self.common if not n.startswith("interior."))

    def names_of(self, k: int) -> list[str]:
        """The unknowns that belong to series k."""
        names = [f"{e.name}.{key}@{k}" for e in self.model.effects for key in own_of(e)]
        held = self.fixed_in(k)
        names = [n for n in names if n.split("@")[0] not in held]
        return names + [f"exterior.{n}@{k}" for n in EOP_NAMES]

    @property
    def names(self) -> list[str]:
        """The unknowns: common ones first, then those of each series."""
        own = [n for k in range(len(self.exteriors)) for n in self.names_of(k)]
        return self.common + own

    def columns(self, k: int) -> NDArray[np.int64]:
        """Where the unknowns of series k stand among all."""
        common = len(self.common)
        before = sum(len(self.names_of(j)) for j in range(k))
        own = common + before + np.arange(len(self.names_of(k)))
        return np.concatenate([np.arange(common), own])

    def moved(self, step: Array) -> FitState:
        """The state after a step (p,)."""
        change = dict(zip(self.names, step, strict=True))
        interior = self.model.interior
        interior = interior.with_values(
            **{n: getattr(interior, n) + change.get(f"interior.{n}", 0.0) for n in FREE_INTERIOR}
        )
        rates = {n: self.model.rates.get(n, 0.0) + change.get(f"rates.{n}", 0.0) for n in RATED}
        listed = tuple(
            replace(
                e,
                values={
                    n: _moved(e, n, float(v), change[f"{e.name}.{n}"])
                    if f"{e.name}.{n}" in change
                    else v
                    for n, v in e.values.items()
                },
            )
            for e in self.model.effects
        )
        moved = replace(
            self,
            model=replace(self.model, interior=interior, rates=rates, effects=listed),
            exteriors=tuple(
                x + np.array([change[f"exterior.{n}@{k}"] for n in EOP_NAMES])
                for k, x in enumerate(self.exteriors)
            ),
        )
        for k in range(len(self.exteriors)):
            here = {e.name: e for e in self.of_series(k).effects}
            own = {}
            for name in self.names_of(k)[:-6]:
                effect, key = name.split("@")[0].split(".")
                value = float(here[effect].values[key])
                own[f"{effect}.{key}"] = _moved(here[effect], key, value, change[name])
            if own:
                moved = moved.with_own(k, own)
        return moved


def _moved(effect: ModelEffect, key: str, old: float, change: float) -> float:
    kind = effects.get(effect.name)
    if key not in kind.nonlinear or kind.nonlinear[key].role == "phase":
        return old + change
    return kind.nonlinear[key].bounded(old, old + change)
