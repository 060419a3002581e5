"""The candidates: every effect of the catalogue with the ways it can act and a grid to search.

The grid replaces a lucky start: each non-linear parameter is scanned over everything that the
recording could show, and how many independent trials that makes is part of the penalty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.evidence import FIELD_SCALES
from thermocald.discovery.hypothesis import BASE, EVENTS, Term
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.discovery.evidence import Evidence
    from thermocald.simulation.effects.parameter import Parameter

    Array = NDArray[np.float64]

__all__ = ["Candidate", "candidates", "richer_way"]

MOUNT = ("omega", "phi", "kappa")
# what else than the interior orientation an effect may move, by what EFFECTS says of its cause:
# a mount bends or creeps, a part jumps, a fan shakes
_ALSO_MOUNT = ("creep", "cyclic_interference", "slip", "thermal_gradient")
_WAYS: dict[str, tuple[tuple[str, ...], ...]] = {
    "radial_distortion_drift": (("A1",), ("A1", "A2"), ("A1", "A2", "A3")),
    "test_field_expansion": (FIELD_SCALES,),
}
# found in image space (`image_space`), not in the courses of parameters
_IMAGE_SPACE = ("defocus", "target_displacement")


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect acting in one way.

    name: of the searched non-linear parameter, "" where there is none; grid: its values.
    """

    effect: str
    parameters: tuple[str, ...]
    name: str
    grid: Array
    fixed: tuple[tuple[str, Any], ...] = ()

    @property
    def is_drive(self) -> bool:
        return catalogue.get(self.effect).kind == "drive"

    @property
    def is_event(self) -> bool:
        return self.effect in EVENTS

    def term(self, value: float | None, series: int) -> Term:
        """The term at one value of the grid; `series`: how many series there are."""
        if self.is_event:
            return Term(self.effect, self.parameters, self.fixed, ((),) * series)
        own = () if value is None else ((self.name, float(value)),)
        return Term(self.effect, self.parameters, self.fixed + own)


def candidates(series: Sequence[Evidence]) -> list[Candidate]:
    """All candidates that the recordings could show."""
    first = series[0]
    out = []
    for name in catalogue.names():
        effect = catalogue.get(name)
        if name in _IMAGE_SPACE or (effect.kind == "image" and name not in _WAYS):
            continue
        ways = _WAYS.get(name, (effect.usual or BASE,))
        if effect.kind == "drive":
            ways = (BASE,)
        if name in _ALSO_MOUNT:
            ways = (*ways, MOUNT)
        numeric = {
            k: p
            for k, p in effect.nonlinear.items()
            if not p.text and (k not in effect.fresh or name in EVENTS)
        }
        channels: Sequence[tuple[tuple[str, Any], ...]] = [()]
        if any(p.text for p in effect.nonlinear.values()):
            channels = [
                (("channel", c),)
                for c in first.history.readings
                if c != first.history.reference and all(_varies(e, c) for e in series)
            ]
        for fixed in channels:
            for way in ways:
                if numeric:
                    key, parameter = next(iter(numeric.items()))
                    out.append(Candidate(name, way, key, _grid(key, parameter, series), fixed))
                else:
                    out.append(Candidate(name, way, "", np.zeros(0), fixed))
    return out


def richer_way(term: Term) -> Term | None:
    """The term in the way of acting that has one coefficient more; None where there is none."""
    for way in _WAYS.get(term.effect, ()):
        if len(way) == len(term.parameters) + 1 and set(term.parameters) < set(way):
            return replace(term, parameters=way)
    return None


def _varies(evidence: Evidence, channel: str) -> bool:
    instrument = evidence.channels.get(channel)
    return instrument is not None and float(np.nanstd(instrument.course)) > 3 * instrument.noise


def _grid(key: str, parameter: Parameter, series: Sequence[Evidence]) -> Array:
    """Values to scan: as fine as the recording can tell apart, as wide as it can show."""
    first = series[0]
    duration = float(first.times[-1])
    step = float(np.median(np.diff(first.times)))
    T = first.history.temperature()
    low, high = float(T.min()), float(T.max())
    if key == "P":
        # two periods at least, and two frames in each; frequencies four to one resolution
        frequencies = np.arange(1.8 / duration, 1.0 / (2.1 * step), 1.0 / (3.0 * duration))
        return np.asarray(1.0 / frequencies[:4000])
    if parameter.unit == "degC":
        return np.linspace(low + 0.03 * (high - low), high - 0.03 * (high - low), 32)
    if parameter.unit == "K":
        return np.geomspace(max(0.2 * parameter.low, 0.01), max(0.45 * (high - low), 0.2), 36)
    if parameter.unit == "s" and parameter.log:
        return np.geomspace(max(0.2 * parameter.low, 0.05 * step), 2.0 * duration, 44)
    if parameter.unit == "s" and key == "time":
        return first.times[1:]
    if parameter.unit == "s":
        reach = min(parameter.high, 0.25 * duration)
        coarse = np.arange(max(parameter.low, -reach), reach, min(0.5 * step, reach / 20)) + 0.1
        fine = np.linspace(-step, step, 21) + 0.001 * step  # small delays are the usual ones
        return np.unique(np.concatenate([coarse, fine]))
    if parameter.log:
        return np.geomspace(parameter.low, parameter.high, 40)
    return np.linspace(parameter.low, parameter.high, 40)
