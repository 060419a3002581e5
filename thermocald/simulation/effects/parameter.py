"""The parameters of effects: units, ranges, roles, and how estimates are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["EXPERIMENTS", "PARAMETER_UNITS", "Parameter", "Role", "coefficient_units", "spoken"]

Role = Literal["", "period", "phase", "event", "delay", "time_constant", "threshold", "width"]

# Units of IOP and EOP as the files write them (CONVENTIONS §2).
PARAMETER_UNITS: dict[str, str] = {
    "c": "mm", "x0": "mm", "y0": "mm", "A1": "mm-2", "A2": "mm-4", "A3": "mm-6",
    "B1": "mm-1", "B2": "mm-1", "C1": "1", "C2": "1",
    "omega": "rad", "phi": "rad", "kappa": "rad", "X0": "mm", "Y0": "mm", "Z0": "mm",
}  # fmt: skip

# Experiments that separate two effects; each effect states how it responds to some of them.
EXPERIMENTS: dict[str, str] = {
    "hold": "hold the lamp at 45 °C for 20 minutes",
    "cycle": "heat and cool twice between the same two temperatures",
    "rate": "heat over the same range once slowly and once fast",
    "hotter": "heat 10 K further than before",
    "idle": "leave the lamp off and let the device run for an hour",
    "restart": "switch the device off for an hour and record again",
    "shade": "shade the test field and heat the camera alone",
    "turn": "turn the camera by 180° about its optical axis and heat it again",
    "disconnect": "disconnect fan, heater and charger",
    "load": "load the processor without heating from outside",
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A non-linear parameter of an effect.

    unit; low, high: range to search; default: start value; log: searched by its logarithm; text: a
    name (a channel, targets) rather than a number; role: what it means to a search, which chooses
    the grid of trial values by it.
    """

    unit: str
    low: float
    high: float
    default: float
    log: bool = False
    text: bool = False
    role: Role = ""

    def difference_step(self, value: float) -> float:
        """Step for difference quotients: small against its effect, large against rounding."""
        if self.log:
            return 1e-3 * max(abs(value), 1e-6)
        return {"threshold": 0.02, "delay": 0.05}.get(self.role, 1e-3)

    def bounded(self, old: float, new: float, slack: float = 1.0) -> float:
        """A step of an iteration, inside the range and by no more than a factor of 2 if `log`.

        slack: factor on the lower bound: data may ask for less than a simulation makes sense of.
        """
        if self.log:
            near = np.clip(new, old / 2.0, old * 2.0)
            return float(np.clip(near, slack * self.low, self.high))
        return float(np.clip(new, self.low, self.high))


def spoken(estimate: Mapping[str, Any]) -> str:
    """An estimate as people write it: 84.1 ± 1.9 s, two digits of the standard deviation."""
    value, sd, unit = estimate.get("value"), estimate.get("sd"), estimate.get("unit", "")
    unit = "" if unit == "1" else f" {unit}"
    if isinstance(value, str) or value is None:
        return f"{value}{unit}"
    if not sd or not np.isfinite(sd):
        return f"{value:.4g}{unit}"
    digits = 1 - int(np.floor(np.log10(sd)))
    if -2 <= digits <= 5:
        d = max(digits, 0)
        return f"{round(value, digits):.{d}f} ± {round(sd, digits):.{d}f}{unit}"
    exponent = int(np.floor(np.log10(max(abs(value), sd))))
    d = max(digits + exponent, 0)
    return f"({value / 10.0**exponent:.{d}f} ± {sd / 10.0**exponent:.{d}f})e{exponent}{unit}"


def coefficient_units(per: str, parameters: tuple[str, ...] = PARAMETER_NAMES) -> dict[str, str]:
    """Units of coefficients that act on parameters: mm/K, rad/K, …; `per`: "K", "K2", "s", "1"."""
    if per == "1":
        return {name: PARAMETER_UNITS[name] for name in parameters}
    return {name: f"{PARAMETER_UNITS[name]}/{per}" for name in parameters}
