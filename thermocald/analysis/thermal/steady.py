"""A camera that has long been at one temperature, and the temperatures that a model was fitted on.

Lags and self-heating have settled, a play lies in its middle, nothing creeps, slips or cycles.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.physics import catalogue

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.physics.effect import Steady
    from thermocald.physics.model import ModelEffect, ThermalModel


_REFUSED_FRACTION = 0.5  # of the fitted range of temperature
_MARGIN_K = 0.25  # what thermometers differ by is not an extrapolation


class ExtrapolationWarning(UserWarning):
    """A model was asked for a temperature that it was not fitted on."""


@dataclass(frozen=True, slots=True)
class Validity:
    """From the lowest to the highest temperature °C of the fit."""

    low: float
    high: float

    def distance(self, T: float) -> tuple[float, bool]:
        """How many kelvin a temperature lies outside, and whether that is too far to be used."""
        beyond = max(self.low - T, T - self.high)
        return (beyond if beyond > _MARGIN_K else 0.0), self._is_far(T)

    def beyond(self, T: float, extrapolate: bool) -> float:
        """How many kelvin a temperature lies outside; warns or refuses."""
        low, high = self.low, self.high
        if low - _MARGIN_K <= T <= high + _MARGIN_K:
            return 0.0
        beyond = low - T if low > T else T - high
        far = beyond > _REFUSED_FRACTION * max(high - low, 1.0)
        if far and not extrapolate and low <= (T - 32.0) / 1.8 <= high:
            raise UsageError(
                f"{T:g} looks like fahrenheit: the model was fitted between {low:g} and {high:g} "
                "°C; convert it"
            )
        if far and not extrapolate:
            raise UsageError(
                f"{T:g} °C is {beyond:.1f} K outside the {low:g} to {high:g} °C that the model was "
                "fitted on; ask for extrapolation by name if you mean it"
            )
        warnings.warn(
            f"{T:g} °C is {beyond:.1f} K outside the {low:g} to {high:g} °C that the model was "
            "fitted on; standard deviations are widened",
            ExtrapolationWarning,
            stacklevel=3,
        )
        return beyond

    def outside(self, temperatures: Array, extrapolate: bool) -> Array:
        """How many kelvin each temperature (E,) lies outside, (E,); warns or refuses."""
        if not len(temperatures):
            return np.zeros(0)
        low, high = self.low, self.high
        outside: Array = np.maximum(np.maximum(low - temperatures, temperatures - high), 0.0)
        outside[outside <= _MARGIN_K] = 0.0
        worst = float(temperatures[int(np.argmax(outside))])
        # half of a log in fahrenheit may lie inside the range by chance: its middle tells
        middle = float(np.median(temperatures))
        if outside.max() > 0:
            self.beyond(middle if self._is_far(middle) else worst, extrapolate)
        return outside

    def _is_far(self, T: float) -> bool:
        low, high = self.low, self.high
        return max(low - T, T - high) > _REFUSED_FRACTION * max(high - low, 1.0)


@dataclass(frozen=True, eq=False)
class SteadyCamera:
    """p(T) and ∂p/∂(parameters) as polynomials in T - T₀, and from each knee on in T - T_k.

    knees: T_k, slope, ∂slope, ∂/∂T_k of each. They are linear: `model` carries the distortion.
    """

    model: ThermalModel
    names: tuple[str, ...]
    p: tuple[Array, Array, Array]
    J: tuple[Array, Array, Array]
    knees: tuple[tuple[float, Array, Array, Array], ...]

    def at(self, T: float) -> tuple[Array, Array, Array]:
        """Values (10,), their slope (10,) per K, and the derivatives (10, p) at T °C."""
        dT = T - self.model.T0
        p0, p1, p2 = self.p
        J0, J1, J2 = self.J
        values = p0 + dT * (p1 + dT * p2)
        slope = p1 + 2.0 * dT * p2
        J = J0 + dT * (J1 + dT * J2)
        for knee, rate, by_rate, by_knee in self.knees:
            if knee < T:
                values = values + (T - knee) * rate
                slope = slope + rate
                J = J + (T - knee) * by_rate + by_knee
        columns = np.column_stack([slope, J])
        carried = self.model.carried_derivatives(values, columns, ("slope", *self.names))
        return self.model.carried(values), carried[:, 0], carried[:, 1:]


def steady_camera(
    model: ThermalModel,
    names: tuple[str, ...],
    channels: Mapping[str, float] | None,
) -> SteadyCamera:
    """The steady camera of a model.

    names: of the parameters whose derivatives are wanted; channels: °C of other thermometers.
    """
    p = [np.zeros(10) for _ in range(3)]
    J = [np.zeros((10, len(names))) for _ in range(3)]
    knees = []

    def add(parameter: str, value: float, row: int, power: int, factor: float = 1.0) -> None:
        p[power][row] += value * factor
        if parameter in names:
            J[power][row, names.index(parameter)] += factor

    for row, n in enumerate(IOP_NAMES):
        add(f"interior.{n}", float(getattr(model.interior, n)), row, 0)
        if n in model.rates:
            add(f"rates.{n}", model.rates[n], row, 1)
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        steady = kind.steady(effect.values, model.T0, channels)
        own = [
            (k, IOP_NAMES.index(k)) for k in kind.linear if k in effect.values and k in IOP_NAMES
        ]
        if steady.knee is not None:
            knees.append(_knee(effect, steady, own, names))
        for power, factor in enumerate(steady.powers):
            if not factor:
                continue
            for key, row in own:
                add(f"{effect.name}.{key}", float(effect.values[key]), row, power, factor)
    return SteadyCamera(model, names, (p[0], p[1], p[2]), (J[0], J[1], J[2]), tuple(knees))


def _knee(
    effect: ModelEffect, steady: Steady, own: list[tuple[str, int]], names: tuple[str, ...]
) -> tuple[float, Array, Array, Array]:
    rate, by_rate, by_knee = np.zeros(10), np.zeros((10, len(names))), np.zeros((10, len(names)))
    for key, row in own:
        rate[row] = float(effect.values[key])
        if f"{effect.name}.{key}" in names:
            by_rate[row, names.index(f"{effect.name}.{key}")] = 1.0
        if f"{effect.name}.{steady.knee_name}" in names:
            by_knee[row, names.index(f"{effect.name}.{steady.knee_name}")] = -rate[row]
    assert steady.knee is not None
    return steady.knee, rate, by_rate, by_knee
