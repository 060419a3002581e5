"""Thermometers as instruments: what one says is not the temperature of what it is fixed to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.simulation.operators import lag

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.simulation.quantities import QuantityReader

__all__ = ["SimulatedThermometer", "read_thermometer"]


@dataclass(frozen=True, slots=True)
class SimulatedThermometer:
    """A thermometer on a body.

    body: whose temperature it follows; lag s: its own time constant; offset K; noise K (sigma);
    resolution K: readings are multiples of it, 0 for none; missing: share of readings that fail;
    stuck: (from, to) s while it repeats its last value.
    """

    body: str
    lag: float = 0.0
    offset: float = 0.0
    noise: float = 0.04
    resolution: float = 0.0625
    missing: float = 0.0
    stuck: tuple[float, float] | None = None

    def read(
        self, times: Array, temperatures: Array, instants: Array, rng: np.random.Generator
    ) -> Array:
        """Readings (R,) °C at instants (R,) s, NaN where missing.

        times (g,) s, temperatures (g,) °C: of the body, joined by straight lines.
        """
        # drawn in full whatever the settings, so that one setting does not change another's noise
        noise = rng.standard_normal(len(instants))
        missed = rng.random(len(instants))
        if self.lag > 0:
            true = lag(times, temperatures, self.lag, instants)
        else:
            true = np.interp(instants, times, temperatures)
        said = true + self.offset + self.noise * noise
        if self.resolution > 0:
            said = np.rint(said / self.resolution) * self.resolution
        if self.stuck is not None:
            held = np.flatnonzero((instants >= self.stuck[0]) & (instants < self.stuck[1]))
            if len(held):
                said[held] = said[max(held[0] - 1, 0)]
        said[missed < self.missing] = np.nan
        return said


def read_thermometer(reader: QuantityReader) -> SimulatedThermometer:
    """From a camera file; units s and K."""
    reader.only(("body", "lag", "offset", "noise", "resolution", "missing", "stuck"))
    stuck = None
    if reader.mapping.get("stuck") is not None:
        inner = reader.inner("stuck")
        inner.only(("from", "to"))
        stuck = (inner.number("from", "s"), inner.number("to", "s"))
    missing = reader.number("missing", "1", 0.0, low=0.0)
    if missing >= 1:
        raise reader.fail("missing", f"is {missing:g}; it is a share below 1")
    return SimulatedThermometer(
        reader.text("body"),
        reader.number("lag", "s", 0.0, low=0.0),
        reader.number("offset", "K", 0.0),
        reader.number("noise", "K", 0.04, low=0.0),
        reader.number("resolution", "K", 0.0625, low=0.0),
        missing,
        stuck,
    )
