"""Heat: bodies with capacities, conductances between them, and sources.

    C_i dT_i/dt = Σ_j G_ij (T_j - T_i) + P_i(t)

Each body has one temperature (lumped capacity). Boundaries, such as the air or a thermal chamber,
have a temperature that is given. Sources and boundaries are straight in pieces; for such a drive
the solution is known in closed form in the modes of the network, and no step width is involved:
temperatures are exact to rounding on any time axis.

Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., chapter 5;
modes of a symmetric system as in any text on linear vibrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.simulation.course import Course
    from thermocald.simulation.quantities import QuantityReader

__all__ = ["HeatNetwork", "Link", "read_network"]


@dataclass(frozen=True, slots=True)
class Link:
    """A conductance W/K between two bodies, or a body and a boundary."""

    first: str
    second: str
    conductance: float


@dataclass(frozen=True)
class HeatNetwork:
    """Bodies {name: capacity J/K} and the links between them; other names in links are boundaries.

    Raises ConfigurationError for a capacity or conductance that is not above 0.
    """

    capacities: Mapping[str, float]
    links: tuple[Link, ...]

    def __post_init__(self) -> None:
        if not self.capacities:
            raise ConfigurationError("a heat network needs at least one body")
        for name, capacity in self.capacities.items():
            if not (np.isfinite(capacity) and capacity > 0):
                raise ConfigurationError(
                    f"body {name!r} has a capacity of {capacity:g} J/K; it must be above 0"
                )
        for link in self.links:
            if not (np.isfinite(link.conductance) and link.conductance > 0):
                raise ConfigurationError(
                    f"the link {link.first}–{link.second} conducts {link.conductance:g} W/K; it "
                    "must be above 0"
                )
            if link.first not in self.capacities and link.second not in self.capacities:
                raise ConfigurationError(f"neither {link.first!r} nor {link.second!r} is a body")

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return tuple(self.capacities)

    @property
    def boundaries(self) -> tuple[str, ...]:
        """Names of what has a given temperature."""
        names = dict.fromkeys(n for link in self.links for n in (link.first, link.second))
        return tuple(n for n in names if n not in self.capacities)

    def _matrices(self) -> tuple[Array, Array, Array]:
        """Capacities (n,), conductance matrix (n, n), conductances to the boundaries (n, m)."""
        row = {name: i for i, name in enumerate(self.bodies)}
        column = {name: i for i, name in enumerate(self.boundaries)}
        K, B = np.zeros((len(row), len(row))), np.zeros((len(row), len(column)))
        for link in self.links:
            for here, there in ((link.first, link.second), (link.second, link.first)):
                if here in row:
                    K[row[here], row[here]] += link.conductance
                    if there in row:
                        K[row[here], row[there]] -= link.conductance
                    else:
                        B[row[here], column[there]] += link.conductance
        return np.array([self.capacities[n] for n in self.bodies]), K, B

    def solve(
        self,
        times: ArrayLike,
        initial: Mapping[str, float] | float,
        powers: Mapping[str, Course],
        temperatures: Mapping[str, Course],
    ) -> dict[str, Array]:
        """Temperatures °C of all bodies and boundaries at times (E,) s, ascending, from 0 on.

        initial: °C at time 0, per body or for all; powers: W into bodies; temperatures: °C of the
        boundaries.
        """
        t = np.asarray(times, dtype=float)
        capacity, K, B = self._matrices()
        for name in self.boundaries:
            if name not in temperatures:
                raise ConfigurationError(f"the temperature of {name!r} is not given")
        for name in powers:
            if name not in self.capacities:
                raise ConfigurationError(
                    f"a source heats {name!r}, which is not a body; bodies are "
                    f"{', '.join(self.bodies)}"
                )
        start = np.array(
            [initial if isinstance(initial, int | float) else initial[n] for n in self.bodies],
            dtype=float,
        )
        inner = [c.times for c in (*powers.values(), *temperatures.values())]
        last = float(t.max(initial=0.0))
        grid = np.unique(np.concatenate([[0.0], t, *inner]))
        grid = grid[(grid >= 0.0) & (grid <= last)]
        begin, end = (self._drive(grid, B, powers, temperatures, side) for side in (True, False))
        root = np.sqrt(capacity)
        rate, modes = np.linalg.eigh(K / np.outer(root, root))
        into = (modes / root[:, None]).T
        z = np.stack(
            [
                _mode(grid, max(float(rate[k]), 0.0), into[k] @ begin, into[k] @ end,
                      float(modes[:, k] @ (root * start)))
                for k in range(len(rate))
            ]
        )  # fmt: skip
        solved = (modes / root[:, None]) @ z
        place = np.searchsorted(grid, t)
        result = {name: solved[i, place] for i, name in enumerate(self.bodies)}
        for name in self.boundaries:
            result[name] = temperatures[name].after(t)
        return result

    def _drive(
        self,
        grid: Array,
        B: Array,
        powers: Mapping[str, Course],
        temperatures: Mapping[str, Course],
        after: bool,
    ) -> Array:
        """Heat flow (n, g) W into each body, right after or right before the instants."""
        q = np.zeros((len(self.bodies), len(grid)))
        for j, name in enumerate(self.boundaries):
            course = temperatures[name]
            q += B[:, j : j + 1] * (course.after(grid) if after else course.before(grid))
        for name, course in powers.items():
            q[self.bodies.index(name)] += course.after(grid) if after else course.before(grid)
        return q


def _mode(grid: Array, rate: float, begin: Array, end: Array, start: float) -> Array:
    """Z' = -rate z + f with f straight from begin[k] to end[k+1] over each step; (g,)."""
    from scipy.linalg.lapack import dtbtrs

    h = np.diff(grid)
    x = rate * h
    small = x < 1e-4
    safe = np.where(small, 1.0, x)
    # φ1 = (1 - e^-x)/x and φ2 = (x - 1 + e^-x)/x², by their series where they would cancel
    phi1 = np.where(small, 1.0 - x / 2 + x * x / 6, -np.expm1(-safe) / safe)
    phi2 = np.where(small, 0.5 - x / 6 + x * x / 24, (safe + np.expm1(-safe)) / safe**2)
    z = np.empty((len(grid), 1))
    z[0] = start
    z[1:, 0] = h * (phi1 * begin[:-1] + phi2 * (end[1:] - begin[:-1]))
    band = np.ones((2, len(grid)), order="F")
    band[1, :-1] = -np.exp(-x)
    solution, _ = dtbtrs(band, z, uplo="L", diag="U")
    result: Array = solution[:, 0]
    return result


def read_network(reader: QuantityReader) -> HeatNetwork:
    """From a camera file: `bodies: {lens: {capacity: 0.6}}`, `links: [{between: [lens, housing],
    conductance: 0.02}]`; J/K and W/K.
    """
    reader.only(("bodies", "links"))
    bodies = reader.inner("bodies")
    capacities = {}
    for name in bodies.mapping:
        body = bodies.inner(name)
        body.only(("capacity",))
        capacities[str(name)] = body.number("capacity", "J/K", above=0.0)
    links = []
    for link in reader.items("links"):
        link.only(("between", "conductance"))
        ends = link.mapping.get("between")
        if not isinstance(ends, list) or len(ends) != 2:
            raise link.fail("between", "must be [one, other]")
        links.append(Link(str(ends[0]), str(ends[1]), link.number("conductance", "W/K", above=0.0)))
    return HeatNetwork(capacities, tuple(links))
