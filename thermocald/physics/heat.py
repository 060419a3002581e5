"""Heat: bodies with capacities, conductances between them, and sources; and thermometers on them.

    C_i dT_i/dt = Σ_j G_ij (T_j - T_i) + P_i(t)

Each body has one temperature (lumped capacity). The temperature of boundaries, such as the air or a
thermal chamber, is given. Sources and boundaries are piecewise linear in time; for these the modes
of the network have a closed solution. No step width is involved: temperatures are exact to rounding
on any time axis.

Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., chapter 5;
modes of a symmetric system as in any text on linear vibrations.

A course is the power of a lamp or a processor, or the temperature of the air, as straight pieces
that may jump. In a file it is a number (a constant), a list of pieces without gaps,

    - {from: 0, to: 60, value: 0.0}
    - {from: 60, to: 900, begin: 0.0, end: 5.0}        # a ramp

or a log that is replayed:

    {log: weather.csv, time: seconds, value: temperature, largest_gap: 900}
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.physics.operators import decayed_sums, lag
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.files import QuantityReader


@dataclass(frozen=True, eq=False)
class Course:
    """A piecewise linear function of time, without gaps; it may jump between pieces.

    times (p+1,): s ascending, where pieces meet; begin, end (p,): values at both ends of each
    piece. Before the first and after the last piece the value is constant.
    """

    times: Array
    begin: Array
    end: Array

    @classmethod
    def constant(cls, value: float) -> Self:
        """Make a constant course."""
        return cls(np.array([0.0, 0.0]), np.array([value]), np.array([value]))

    @classmethod
    def polygon(cls, times: ArrayLike, values: ArrayLike) -> Self:
        """Join points by straight lines; two points at one time are a jump."""
        t, v = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
        if len(t) == 1:
            return cls.constant(float(v[0]))
        keep = np.diff(t) > 0
        return cls(np.append(t[:-1][keep], t[-1]), v[:-1][keep], v[1:][keep])

    @classmethod
    def steps(cls, times: ArrayLike, values: ArrayLike) -> Self:
        """Make a course with value i from times[i] to times[i+1]; it needs one more time."""
        v = np.asarray(values, dtype=float)
        return cls(np.asarray(times, dtype=float), v, v.copy())

    def at(self, times: ArrayLike, side: Literal["left", "right"] = "right") -> Array:
        """Return the values at some times; at a jump, that after it, or before it (side: left)."""
        t = np.asarray(times, dtype=float)
        piece = np.clip(np.searchsorted(self.times, t, side=side) - 1, 0, len(self.begin) - 1)
        length = self.times[piece + 1] - self.times[piece]
        share = np.clip((t - self.times[piece]) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        return np.asarray(self.begin[piece] + share * (self.end[piece] - self.begin[piece]))


def read_course(
    reader: QuantityReader, key: str, unit: str, duration: float, folder: Path
) -> Course:
    """Read the course at a key; it must cover 0 to `duration` s without gaps."""
    raw = reader.mapping.get(key)
    if isinstance(raw, list):
        course = _read_pieces(reader, key, unit)
    elif isinstance(raw, dict) and "log" in raw:
        course = _read_log(reader.inner(key), folder)
    else:
        return Course.constant(reader.number(key, unit))
    begin, end = course.times[[0, -1]]
    if begin > 0 or end < duration:
        raise reader.fail(
            key, f"covers {begin:g} to {end:g} s; the programme lasts from 0 to {duration:g} s"
        )
    return course


def _read_pieces(reader: QuantityReader, key: str, unit: str) -> Course:
    pieces: list[tuple[float, ...]] = []
    for piece in reader.items(key):
        piece.only(("from", "to", "value", "begin", "end"))
        start, stop = piece.number("from", "s"), piece.number("to", "s")
        if stop <= start:
            raise piece.fail("to", f"is {stop:g} s, not after {start:g} s")
        before = pieces[-1][1] if pieces else start
        if start != before:
            what = "a gap" if start > before else "an overlap"
            raise piece.fail(
                "from", f"is {start:g} s, but the piece before ends at {before:g} s: {what}"
            )
        ends = ("value", "value") if "value" in piece.mapping else ("begin", "end")
        pieces.append((start, stop, *(piece.number(name, unit) for name in ends)))
    if not pieces:
        raise reader.fail(key, "is an empty list")
    starts, stops, begin, end = np.array(pieces).T
    return Course(np.append(starts[:1], stops), begin, end)


def _read_log(reader: QuantityReader, folder: Path) -> Course:
    """Read a CSV file with a header and one row per time; time 0 is the first row."""
    reader.only(("log", "time", "value", "largest_gap"))
    time, value = columns = reader.text("time", "time"), reader.text("value", "temperature")
    largest = reader.number("largest_gap", "s", 900.0, above=0.0)
    table = Table(folder / reader.text("log"), columns, ConfigurationError)
    found = table.read(numbers=columns)
    times = found[time]
    if len(times) < 2:
        raise ConfigurationError(f"{table.path}: a log needs at least two rows")
    steps = np.diff(times)
    table.check(time, steps <= 0, "time runs backwards", first=1)
    why = "a gap of {:g} s; the largest that is bridged is {:g} s (largest_gap)".format
    table.check(time, steps > largest, lambda row: why(steps[row], largest), first=1)
    return Course.polygon(times - times[0], found[value])


@dataclass(frozen=True, slots=True)
class SimulatedThermometer:
    """A thermometer on a body or boundary, with its errors.

    body: where it is; lag s: its own time constant; offset K; noise K (sigma); resolution K:
    readings are multiples of it, 0 for none; missing: share of readings that fail; stuck: (from,
    to) s, when it repeats its last value.
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
        """Draw readings (R,) °C at instants (R,) s, NaN where missing.

        times (g,) s, temperatures (g,) °C: of the body, joined by straight lines.
        """
        # drawn in full whatever the settings, so that no setting changes the noise of another
        noise = rng.standard_normal(len(instants))
        missed = rng.random(len(instants))
        if self.lag > 0:
            true = lag(times, temperatures, self.lag, instants)
        else:
            true = np.interp(instants, times, temperatures)
        readings = true + self.offset + self.noise * noise
        if self.resolution > 0:
            readings = np.rint(readings / self.resolution) * self.resolution
        if self.stuck is not None:
            held = np.flatnonzero((instants >= self.stuck[0]) & (instants < self.stuck[1]))
            if len(held):
                readings[held] = readings[max(held[0] - 1, 0)]
        readings[missed < self.missing] = np.nan
        return readings


def read_thermometer(reader: QuantityReader) -> SimulatedThermometer:
    """Read a thermometer of a camera file, in s and K."""
    reader.only(("body", "lag", "offset", "noise", "resolution", "missing", "stuck"))
    stuck = None
    if reader.mapping.get("stuck") is not None:
        inner = reader.inner("stuck")
        inner.only(("from", "to"))
        begin = inner.number("from", "s")
        stuck = begin, inner.number("to", "s", above=begin)
    return SimulatedThermometer(
        reader.text("body"),
        reader.number("lag", "s", 0.0, low=0.0),
        reader.number("offset", "K", 0.0),
        reader.number("noise", "K", 0.04, low=0.0),
        reader.number("resolution", "K", 0.0625, low=0.0),
        reader.share("missing", 0.0),
        stuck,
    )


@dataclass(frozen=True)
class HeatNetwork:
    """A network of bodies and boundaries, linked by conductances.

    capacities: {body: J/K}; links: (name, name, conductance W/K), where a name that is not a body
    is a boundary. Capacities and conductances are above 0. Raises ConfigurationError if a link has
    no body.
    """

    capacities: Mapping[str, float]
    links: tuple[tuple[str, str, float], ...]

    def __post_init__(self) -> None:
        if not self.capacities:
            raise ConfigurationError("a heat network needs at least one body")
        for first, second, _ in self.links:
            if first not in self.capacities and second not in self.capacities:
                raise ConfigurationError(f"neither {first!r} nor {second!r} is a body")
            if first == second:
                raise ConfigurationError(f"a link is between {first!r} and itself")

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The names of the boundaries, whose temperatures are given."""
        names = dict.fromkeys(n for link in self.links for n in link[:2])
        return tuple(n for n in names if n not in self.capacities)

    def _matrices(self) -> tuple[Array, Array, Array]:
        """Return capacities (n,), conductance matrix (n, n), conductances to boundaries (n, m)."""
        names, n = [*self.capacities, *self.boundaries], len(self.capacities)
        G = np.zeros((len(names), len(names)))
        for first, second, conductance in self.links:
            i, j = names.index(first), names.index(second)
            for here, there in ((i, j), (j, i)):
                G[here, here] += conductance
                G[here, there] -= conductance
        return np.array([*self.capacities.values()]), G[:n, :n], -G[:n, n:]

    def solve(
        self,
        times: ArrayLike,
        initial: ArrayLike,
        powers: Mapping[str, Course],
        temperatures: Mapping[str, Course],
    ) -> dict[str, Array]:
        """Return the temperatures °C of bodies and boundaries at times (E,) s, ascending from 0.

        initial: °C at time 0, of each body or of all; powers: W into bodies; temperatures: °C of
        the boundaries.
        """
        t = np.asarray(times, dtype=float)
        capacity, K, B = self._matrices()
        for name in self.boundaries:
            if name not in temperatures:
                raise ConfigurationError(f"the temperature of {name!r} is not given")
        for name in powers:
            if name not in self.capacities:
                raise ConfigurationError(
                    f"a source heats {name!r}, which is not a body; the bodies are "
                    f"{', '.join(self.capacities)}"
                )
        inner = [c.times for c in (*powers.values(), *temperatures.values())]
        last = float(t.max(initial=0.0))
        grid = np.unique(np.concatenate([[0.0], t, *inner]))
        grid = grid[(grid >= 0.0) & (grid <= last)]
        begin, end = np.zeros((2, len(capacity), len(grid)))  # heat flow W into each body
        sides: tuple[tuple[Array, Literal["right", "left"]], ...] = (begin, "right"), (end, "left")
        for q, side in sides:
            for j, name in enumerate(self.boundaries):
                q += B[:, j : j + 1] * temperatures[name].at(grid, side)
            for name, course in powers.items():
                q[list(self.capacities).index(name)] += course.at(grid, side)
        root = np.sqrt(capacity)
        rate, modes = np.linalg.eigh(K / np.outer(root, root))
        into = (modes / root[:, None]).T
        z = np.stack(
            [
                _solve_mode(grid, max(float(rate[k]), 0.0), into[k] @ begin, into[k] @ end,
                      float(modes[:, k] @ (root * initial)))
                for k in range(len(rate))
            ]
        )  # fmt: skip
        solved = (modes / root[:, None]) @ z
        place = np.searchsorted(grid, t)
        result = {name: solved[i, place] for i, name in enumerate(self.capacities)}
        for name in self.boundaries:
            result[name] = temperatures[name].at(t)
        return result


def _solve_mode(grid: Array, rate: float, begin: Array, end: Array, start: float) -> Array:
    """Solve z' = -rate z + f on the grid, (g,); f is linear from begin[k] to end[k+1]."""
    h = np.diff(grid)
    x = rate * h
    small = x < 1e-4
    safe = np.where(small, 1.0, x)
    # φ1 = (1 - e^-x)/x and φ2 = (x - 1 + e^-x)/x², as series where their terms would cancel
    phi1 = np.where(small, 1.0 - x / 2 + x * x / 6, -np.expm1(-safe) / safe)
    phi2 = np.where(small, 0.5 - x / 6 + x * x / 24, (safe + np.expm1(-safe)) / safe**2)
    driven = np.append(start, h * (phi1 * begin[:-1] + phi2 * (end[1:] - begin[:-1])))
    return decayed_sums(np.exp(-x), driven)


def read_network(reader: QuantityReader) -> HeatNetwork:
    """Read the network of a camera file, in J/K and W/K.

    Its keys: `bodies: {lens: {capacity: 0.6}}`, `links: [{between: [lens, housing], conductance:
    0.02}]`.
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
            raise link.fail("between", "must be a list of two names")
        links.append((str(ends[0]), str(ends[1]), link.number("conductance", "W/K", above=0.0)))
    try:
        return HeatNetwork(capacities, tuple(links))
    except ConfigurationError as error:
        raise reader.fail("links", str(error)) from error
