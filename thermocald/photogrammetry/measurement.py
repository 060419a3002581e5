"""One entry for measuring a frame: everything of a test field that it shows, and what was missed.

image ─► status ─► markers and ring codes ─► orientation ─► plain circles ─► centres, covariances
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.markers import measure_markers
from thermocald.photogrammetry.testfield import Observations

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.testfield import TestField

__all__ = ["Measurement", "Prior", "measure"]

_FEWEST = 4


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of the camera before a frame is measured; None for what is not.

    With both orientations the targets are looked for where they should be; without, they are
    found by their codes.
    """

    sensor: Sensor | None = None
    interior: InteriorOrientation | None = None
    exterior: ExteriorOrientation | None = None
    principal_distance: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What a frame gave: observations (none where the status is not ok), and {row: reason} for the
    targets of the field that were looked for and not measured.
    """

    observations: Observations
    status: FrameStatus = OK
    missed: dict[int, str] = field(default_factory=dict)


def measure(image: NDArray[Any], testfield: TestField, prior: Prior | None = None) -> Measurement:
    """Measure a test field in a frame (H, W), grey, 8 or 16 bit.

    Never raises for what a camera may deliver: the status says what is wrong with the frame.
    Raises TestFieldError where the field's codes are wrong.
    """
    prior = prior or Prior()
    size = (prior.sensor.width, prior.sensor.height) if prior.sensor is not None else None
    status = inspect_frame(image, size)
    if not status.ok:
        return Measurement(_nothing(), status)
    missed: dict[int, str] = {}
    observations = measure_markers(image, testfield, missed)
    if len(observations) == 0:
        status = FrameStatus("nothing_found", "no target of the test field is found in the frame")
    elif len(observations) < _FEWEST:
        status = FrameStatus("too_few", f"only {len(observations)} targets are found in the frame")
    return Measurement(observations, status, missed)


def _nothing() -> Observations:
    return Observations(
        np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    )
