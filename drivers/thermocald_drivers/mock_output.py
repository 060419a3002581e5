"""An output that keeps what it was given.

outputs:
  - {name: kept, driver: mock, keep: 1000, timeout_s: 1, faults: []}   # see faults.py
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from thermocald.hal import Output
from thermocald_drivers import support
from thermocald_drivers.faults import Faults, MockDevice

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock

__all__ = ["MockOutput"]


class MockOutput(MockDevice, Output):
    """Keeps the last results in `results`, oldest first."""

    name = "mock output"

    def __init__(
        self,
        *,
        clock: Clock,
        keep: int = 1000,
        faults: Sequence[Mapping[str, object]] = (),
        timeout_s: float = 1.0,
    ) -> None:
        self.clock = clock
        self.timeout_s = timeout_s
        self.faults = Faults(self.name, clock, faults, timeout_s)
        size = int(support.number("keep", keep, 1, 1_000_000, whole=True))
        self.results: deque[dict[str, Any]] = deque(maxlen=size)

    def identity(self) -> Mapping[str, str]:
        return {"name": self.name}

    def emit(self, result: Mapping[str, Any]) -> None:
        self._require_open()
        self.faults.refuse(self.faults.on_call(), "acknowledgement")
        self.results.append(dict(result))
