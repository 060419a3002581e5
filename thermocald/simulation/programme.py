"""Programmes: what is done to a camera, and when it looks.

    format: thermocald-programme/1
    name: lamp cycles
    series: M1
    epochs: 150
    interval: 10.0                               # s
    jitter: 0.0                                  # s, of the frames' cadence (sigma)
    reading: {offset: 0.0, spread: 1.0}          # s: thermometers are read ± spread about the frame
    begin: 1600000000.0                          # s UTC
    initial: 22.0                                # °C, all bodies; default: ambient at the start
    ambient: 22.0                                # °C: a number, pieces, or a log (see `course`)
    sources:                                     # W into bodies of the camera file
      housing: [{from: 0, to: 60, value: 0}, {from: 60, to: 900, value: 6.0},
                {from: 900, to: 1500, value: 0}]

Other boundaries than `ambient` stand under `boundaries: {chamber: …}`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.simulation.course import Course, read_course
from thermocald.simulation.quantities import QuantityReader
from thermocald.yaml_file import read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from thermocald.arrays import Array

__all__ = ["PROGRAMME_FORMAT", "Programme", "read_programme"]

PROGRAMME_FORMAT = "thermocald-programme/1"


@dataclass(frozen=True)
class Programme:
    """Epochs and what happens during them.

    epochs, interval s, jitter s, reading_offset, reading_spread s, begin s UTC; initial °C or None
    (as the ambient at the start); boundaries {name: Course °C}, sources {body: Course W}.
    """

    name: str
    epochs: int
    interval: float
    boundaries: Mapping[str, Course]
    sources: Mapping[str, Course] = field(default_factory=dict)
    series: str = "M1"
    jitter: float = 0.0
    reading_offset: float = 0.0
    reading_spread: float = 1.0
    begin: float = 1_600_000_000.0
    initial: float | Mapping[str, float] | None = None

    @property
    def duration(self) -> float:
        """From the first frame to the last, nominally, s."""
        return (self.epochs - 1) * self.interval

    def frame_times(self, rng: np.random.Generator) -> Array:
        """When frames are taken, (E,) s from the start, the first at 0, ascending."""
        nominal = np.arange(self.epochs) * self.interval
        limit = 0.4 * self.interval
        shift = np.clip(self.jitter * rng.standard_normal(self.epochs), -limit, limit)
        shift[0] = 0.0
        return nominal + shift

    def reading_times(self, frames: Array, rng: np.random.Generator) -> Array:
        """When thermometers are read, (E,) s from the start, ascending."""
        spread = self.reading_spread * rng.uniform(-1.0, 1.0, len(frames))
        result: Array = np.maximum.accumulate(frames + self.reading_offset + spread)
        return result


def read_programme(path: Path) -> Programme:
    """Read a programme file; ConfigurationError names file and key, and where there is a gap."""
    document = read_yaml(path)
    top = QuantityReader(path, document)
    found = top.text("format")
    if found != PROGRAMME_FORMAT:
        raise top.fail("format", f"is {found[:60]!r}; this program reads {PROGRAMME_FORMAT!r}")
    top.only(
        ("format", "name", "series", "epochs", "interval", "jitter", "reading", "begin", "initial",
         "ambient", "boundaries", "sources")
    )  # fmt: skip
    epochs = top.whole("epochs", "1")
    interval = top.number("interval", "s", above=0.0)
    duration = (epochs - 1) * interval
    boundaries = {"ambient": read_course(top, "ambient", "degC", duration, path.parent)}
    boundaries |= _courses(top, "boundaries", "degC", duration, path.parent)
    offset, spread = 0.0, 1.0
    if document.get("reading") is not None:
        reading = top.inner("reading")
        reading.only(("offset", "spread"))
        offset = reading.number("offset", "s", 0.0)
        spread = reading.number("spread", "s", 1.0, low=0.0)
    return Programme(
        top.text("name", path.stem),
        epochs,
        interval,
        boundaries,
        _courses(top, "sources", "W", duration, path.parent),
        top.text("series", "M1"),
        top.number("jitter", "s", 0.0, low=0.0),
        offset,
        spread,
        top.number("begin", "s", 1_600_000_000.0),
        top.number("initial", "degC") if document.get("initial") is not None else None,
    )


def _courses(
    top: QuantityReader, key: str, unit: str, duration: float, folder: Path
) -> dict[str, Course]:
    if top.mapping.get(key) is None:
        return {}
    group = top.inner(key)
    return {str(name): read_course(group, name, unit, duration, folder) for name in group.mapping}
