"""Time offset: temperatures are stamped late or early."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Effect
from thermocald.simulation.effects.parameter import Parameter, spoken
from thermocald.simulation.operators import interpolation_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["TimeOffset"]


class TimeOffset(Effect):
    """The linear terms follow T(t - d): a pure delay d; d < 0 where T is stamped late.

    Before the first frame the temperature has always been the one of the first frame.
    """

    name = "time_offset"
    noun = "a time offset"
    kind = "drive"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "d": Parameter("s", -300.0, 300.0, 10.0, role="delay")
    }
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "stops at once after the delay",
        "rate": "shifts the whole curve by the same time, its tips stay sharp",
        "cycle": "returns to the same line each time",
        "idle": "does nothing",
    }

    def drive(self, history: History, d: float = 0.0, **_: Any) -> Array:
        return history.polygon().at(history.times - d)

    def unresolved(
        self,
        history: History,
        rate_jump: Array | None = None,  # noqa: ARG002
        d: float = 0.0,
        **_: Any,
    ) -> Array:
        """A thermometer that is ahead is needed after the last reading: nobody knows it there.

        As much as the temperature usually changes over the time that is missing.
        """
        p = history.polygon()
        missing = np.maximum(history.times - d - p.times[-1], 0.0)
        open_ = np.zeros(len(missing))
        for e in np.flatnonzero(missing):
            begun = p.times[p.times + missing[e] <= p.times[-1]]
            if len(begun):
                open_[e] = np.sqrt(np.mean((p.at(begun + missing[e]) - p.at(begun)) ** 2))
        return open_

    def sensitivity(self, history: History, d: float = 0.0, **_: Any) -> csr_array:
        p = history.polygon()
        return interpolation_matrix(p.times, history.times - d) @ p.matrix

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"the camera follows the thermometer after a pure delay of {spoken(estimates['d'])}"
