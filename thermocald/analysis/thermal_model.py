"""Fitting a thermal model: one adjustment over all image points of all series of a camera.

Unknown are the interior orientation at T₀, its rates, the parameters of the effects, and one
exterior orientation per series. The thermometers' errors are unknown too, one per reading, with
their standard deviation as prior: carried through each effect's own operator and eliminated, they
take from the epochs what the thermometer does not know. Their size is estimated with the rest
(variance components), as is that of the image noise.

The covariance holds image noise, thermometer noise, and the coordinates of the test field. It does
not hold what the model lacks: the test for that is the chi-square of a series that was left out.

Source: DESIGN ideas 2, 3 and 5; variance components: Koch, K.-R. (1999): Parameter Estimation and
Hypothesis Testing in Linear Models, 2nd ed., section 3.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.model_series import N_PARAMETERS, ModelSeries
from thermocald.errors import DataError
from thermocald.photogrammetry.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.simulation import effects
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    Array = NDArray[np.float64]

__all__ = ["FittedModel", "SeriesFit", "fit_thermal_model", "predicted_error", "start_model"]

_FREE_INTERIOR = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
_ITERATIONS = 30
_CONVERGED = 1e-3  # of a standard deviation
_GRID = 33  # trial values of a non-linear parameter


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """How well one series is explained: rms px, chi2 reduced, and its thermometers' noise K."""

    name: str
    epochs: int
    rms_px: float
    chi2_reduced: float
    thermometer_sd: float


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model with what the fit says about itself.

    names (p,): of the unknowns, as `ThermalModel.covariance_names` writes them, the exterior
    orientation of series k as `exterior.X0@k`; values, covariance; chi2_reduced: of everything
    together; sigma0: of image points against their stated sigmas.
    """

    model: ThermalModel
    names: tuple[str, ...]
    values: Array
    covariance: Array
    sigma0: float
    chi2_reduced: float
    series: tuple[SeriesFit, ...]

    def sd(self, name: str) -> float:
        """The standard deviation of one unknown."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))


@dataclass
class _State:
    """The unknowns of a fit and where they go in a model."""

    model: ThermalModel
    exteriors: list[Array]
    free: tuple[str, ...]
    fixed: frozenset[str]
    names: list[str] = field(init=False)

    def __post_init__(self) -> None:
        names = [f"interior.{n}" for n in self.free] + [f"rates.{n}" for n in RATED]
        for effect in self.model.effects:
            kind = effects.get(effect.name)
            for key, value in effect.values.items():
                name = f"{effect.name}.{key}"
                if isinstance(value, int | float) and name not in self.fixed:
                    if effect.name == "defocus":
                        continue  # in the noise, not in the positions
                    if key in kind.linear or key not in kind.fresh or key == "phase":
                        names.append(name)
        self.names = names + [f"exterior.{n}@{k}" for k in range(len(self.exteriors)) for n in EOP_NAMES]

    def of_series(self, k: int) -> ThermalModel:
        return replace(self.model, exterior=ExteriorOrientation.from_array(self.exteriors[k]))

    def moved(self, step: Array) -> _State:
        """The state after a step (p,)."""
        change = dict(zip(self.names, step, strict=True))
        interior = self.model.interior.with_values(
            **{n: getattr(self.model.interior, n) + change[f"interior.{n}"] for n in self.free}
        )
        rates = {n: self.model.rates.get(n, 0.0) + change[f"rates.{n}"] for n in RATED}
        listed = tuple(_changed(e, change) for e in self.model.effects)
        exteriors = [
            x + np.array([change[f"exterior.{n}@{k}"] for n in EOP_NAMES])
            for k, x in enumerate(self.exteriors)
        ]
        model = replace(self.model, interior=interior, rates=rates, effects=listed)
        return _State(model, exteriors, self.free, self.fixed)


def _changed(effect: ModelEffect, change: dict[str, float]) -> ModelEffect:
    values = dict(effect.values)
    kind = effects.get(effect.name)
    for key, value in effect.values.items():
        step = change.get(f"{effect.name}.{key}")
        if step is None:
            continue
        values[key] = value + step
        if key in kind.nonlinear:
            p = kind.nonlinear[key]
            # a step across the range is a step too far
            values[key] = float(np.clip(values[key], max(p.low, value / 3 if p.log else p.low),
                                        min(p.high, value * 3 if p.log else p.high)))  # fmt: skip
    return replace(effect, values=values)


def start_model(series: Sequence[ModelSeries], T0: float | None = None) -> ThermalModel:
    """The base model to start from: mean orientation, no rates, T₀ the mean temperature."""
    temperatures = np.concatenate([s.history.temperature() for s in series])
    first = series[0]
    return ThermalModel(
        first.camera,
        first.sensor,
        round(float(temperatures.mean()), 1) if T0 is None else T0,
        InteriorOrientation.from_array(first.start[:10]),
        dict.fromkeys(RATED, 0.0),
        name=first.camera,
        version=0,
    )


def fit_thermal_model(
    series: Sequence[ModelSeries],
    listed: Sequence[ModelEffect] = (),
    T0: float | None = None,
    search: bool = True,
    fixed: Sequence[str] = (),
) -> FittedModel:
    """Fit the base model and some effects to all series together.

    listed: effects with start values; with `search` their non-linear parameters are looked for over
    their whole range first; fixed: names such as `thermal_lag.tau` that keep their start values.
    Raises DataError for series of different cameras, or of one temperature.
    """
    checked = _checked(series, listed)
    base = start_model(checked, T0)
    state = _State(base, [s.start[10:].copy() for s in checked], _FREE_INTERIOR, frozenset(fixed))
    state, _ = _solve(checked, state)
    for effect in listed:
        effect = _started(effect)
        state.model = replace(state.model, effects=(*state.model.effects, effect))
        state = _State(state.model, state.exteriors, state.free, state.fixed)
        if search:
            state = _searched(checked, state, effect)
    if listed:
        state, _ = _solve(checked, state)
    state = _defocused(checked, state)
    return _result(checked, *_solve(checked, state))


def _checked(series: Sequence[ModelSeries], listed: Sequence[ModelEffect]) -> list[ModelSeries]:
    if not series:
        raise DataError("no series to fit a model to")
    first = series[0]
    for s in series:
        if s.camera != first.camera or s.sensor != first.sensor:
            raise DataError(
                f"series {s.name} is of camera {s.camera}, series {first.name} of {first.camera}: "
                "a thermal model belongs to one camera"
            )
    span = max(float(np.ptp(s.history.temperature())) for s in series)
    if span < 1.0:
        raise DataError(
            f"the temperature changes by {span:.2f} K only: heat the camera by several kelvin"
        )
    moved: tuple[str, ...] = ()
    for effect in listed:
        if effect.name == "target_displacement":
            targets = effect.values["targets"]
            moved = (targets,) if isinstance(targets, str) else tuple(targets)
    return [s.displacing(moved) if moved else s for s in series]


def _started(effect: ModelEffect) -> ModelEffect:
    """An effect with all its usual coefficients, 0 where nothing was given."""
    kind = effects.get(effect.name)
    given = [n for n in kind.linear if n in effect.values]
    values = dict(effect.values)
    if not any(values[n] for n in given):
        values |= {n: values.get(n, 0.0) for n in kind.usual}
    return replace(effect, values=values)


@dataclass(frozen=True, eq=False)
class _Part:
    """What one series adds: normal matrix M (q, q) of its unknowns (columns), gradient g, cost."""

    columns: NDArray[np.int64]
    M: Array
    g: Array
    cost: float
    image_cost: float
    errors: Array
    error_redundancy: float
    J: Array


def _solve(series: list[ModelSeries], state: _State) -> tuple[_State, list[Any]]:
    """Gauss-Newton with variance components; returns the state and [parts, sigma0, thermometers]."""
    variance = 1.0
    thermometers = [_first_guess(s) for s in series]
    n = sum(int(s.count.sum()) for s in series) * 2
    best = np.inf
    for _ in range(_ITERATIONS):
        parts = [_part(s, state, k, variance, t) for k, (s, t) in enumerate(zip(series, thermometers, strict=True))]
        p = len(state.names)
        M, g = np.zeros((p, p)), np.zeros(p)
        for part in parts:
            M[np.ix_(part.columns, part.columns)] += part.M
            g[part.columns] += part.g
        Q = _inverse(M)
        step = Q @ g
        size = float(np.max(np.abs(step) / np.sqrt(np.maximum(np.diag(Q), 1e-300))))
        cost = sum(part.cost for part in parts)
        for k, part in enumerate(parts):
            if part.error_redundancy > 1:
                floor = [r / np.sqrt(12.0) * 0.5 for r in series[k].resolution.values()]
                found = np.sqrt(float(part.errors @ part.errors) / part.error_redundancy)
                thermometers[k] = max(found, max(floor, default=0.0), 1e-3)
        redundancy = n - p - sum(part.error_redundancy for part in parts)
        image = sum(part.image_cost for part in parts)
        previous, variance = variance, image / max(n - p - sum(len(q.errors) - q.error_redundancy for q in parts), 1.0)
        del redundancy, cost, best
        best = image
        state = state.moved(step)
        if size < _CONVERGED and abs(variance / previous - 1) < 1e-3:
            break
    return state, [parts, variance, thermometers, Q]
