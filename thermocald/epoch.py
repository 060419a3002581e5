"""The epoch: a frame's image measurements and the temperatures read with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from thermocald.photogrammetry.field.testfield import Observations


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One epoch.

    number: as in the recording; frame_time, temperature_time: s UTC, the latter NaN if nothing was
    read; temperatures: {channel: °C} at `temperature_time`, NaN if the channel could not be read;
    frame: path of the image, None if there is none; observations: None if the frame is not measured
    yet; note: why there are no observations.
    """

    number: int
    frame_time: float
    temperature_time: float
    temperatures: Mapping[str, float] = field(default_factory=dict)
    frame: Path | None = None
    observations: Observations | None = None
    note: str = ""
