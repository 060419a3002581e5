"""Second heat source: another channel (board, processor) heats the camera too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.errors import DataError
from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import Parameter, coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["SecondHeatSource"]


class SecondHeatSource(Effect):
    """Adds a (T_channel - T₀), linear in another temperature column of the recording."""

    name = "second_heat_source"
    noun = "a second heat source"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "channel": Parameter("name", 0.0, 0.0, 0.0, text=True)
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K")
    usual = ("c", "x0", "y0")
    behaviour: ClassVar[Mapping[str, str]] = {
        "load": "follows the other thermometer",
        "idle": "follows the other thermometer",
        "hold": "follows the other thermometer",
    }

    def channel(self, history: History, channel: str = "", **_: Any) -> str:
        return channel or next(c for c in history.readings if c != history.reference)

    def signal(self, history: History, channel: str = "", **_: Any) -> Array:
        return (history.temperature(self.channel(history, channel)) - history.T0)[:, None]

    def sensitivity(self, history: History, channel: str = "", **_: Any) -> csr_array:
        return history.temperature_matrix(self.channel(history, channel))

    def steady(
        self, values: Mapping[str, Any], T0: float, channels: Mapping[str, float] | None
    ) -> Steady:
        channel = str(values["channel"])
        if channels is None or channel not in channels:
            raise DataError(
                f"the model also depends on {channel!r}: give its temperature, channels="
                f"{{{channel!r}: …}}"
            )
        return Steady((float(channels[channel]) - T0, 0.0, 0.0))

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"{estimates['channel']['value']} heats the camera too"
