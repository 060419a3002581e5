"""The epoch: one tick with its image measurements and the temperatures around it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from thermocald.photogrammetry.field.testfield import Observations


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One tick.

    number: as the recording counts; frame_time, temperature_time: s UTC, the temperature's is NaN
    where none was read; temperatures: {channel: °C}, NaN where a channel could not be read, read at
    `temperature_time`; frame: path of the image, None where there is none; observations: None
    where the frame has still to be measured; note: why there are none.
    """

    number: int
    frame_time: float
    temperature_time: float
    temperatures: Mapping[str, float] = field(default_factory=dict)
    frame: Path | None = None
    observations: Observations | None = None
    note: str = ""
