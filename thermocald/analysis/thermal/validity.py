"""The temperatures that a model was fitted on, and what is asked for beyond them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.arrays import Array

__all__ = ["ExtrapolationWarning", "Validity"]

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
