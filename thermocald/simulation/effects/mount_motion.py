"""Mount motion: the tripod or bracket that holds the camera bends with the temperature."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.photogrammetry.camera.camera_model import EOP_NAMES
from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken
from thermocald.simulation.operators import lag, lag_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["MountMotion"]


class MountMotion(Effect):
    """Adds a (L - T₀) to the orientation and the projection centre; τ dL/dt = T - L, L = T at the
    start. Without tau, or where it is 0, L is T.

    A bracket of length l and expansion α shifts the camera by l α per K; where one of its sides is
    warmer by ΔT, it turns it by l α ΔT over its thickness.
    Source: Timoshenko (1925), J. Optical Society of America 11, 233-255 (bending by heat).
    """

    name = "mount_motion"
    noun = "a motion of the mount"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "tau": Parameter("s", 2.0, 3000.0, 300.0, log=True, role="time_constant")
    }
    optional = ("tau",)
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K", EOP_NAMES)
    usual = EOP_NAMES
    parameter_sets = (EOP_NAMES, EOP_NAMES[:3])
    steady_signal = Steady((0.0, 1.0, 0.0))
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "keeps its direction in space",
        "hold": "settles",
        "rate": "opens a loop when fast",
        "shade": "moves what is seen of every field by as much",
    }

    def signal(self, history: History, tau: float = 0.0, **_: Any) -> Array:
        if tau <= 0:
            return (history.temperature() - history.T0)[:, None]
        p = history.polygon()
        return (lag(p.times, p.values, tau, history.times) - history.T0)[:, None]

    def sensitivity(self, history: History, tau: float = 0.0, **_: Any) -> csr_array:
        if tau <= 0:
            return history.temperature_matrix()
        p = history.polygon()
        return lag_matrix(p.times, tau, history.times) @ p.matrix

    def propagate(self, history: History, errors: Array, tau: float = 0.0, **_: Any) -> Array:
        if tau <= 0:
            return super().propagate(history, errors)
        p = history.polygon()
        return lag(p.times, p.matrix @ errors, tau, history.times)

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        moved = ", ".join(f"{k} = {spoken(e)}" for k, e in estimates.items() if k != "tau")
        tau = estimates.get("tau")
        late = "at once" if not tau or not tau["value"] else f"with a lag of {spoken(tau)}"
        return f"the mount moves the camera with the temperature, {late}: {moved}"
