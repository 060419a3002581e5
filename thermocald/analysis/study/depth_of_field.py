"""Depth of field, and what a change of the principal distance does to it.

Exact formulas of the thin lens (Luhmann et al. 2014, section 3.1.2): with the hyperfocal distance
H = f²/(N u) + f, focused at s, sharp from s (H - f)/(H + s - 2f) to s (H - f)/(H - s). The
reference quotes changes of 2 to 5 mm at 1 m but neither f-number nor circle of confusion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["DepthOfField", "circle_of_confusion", "depth_of_field"]


@dataclass(frozen=True, slots=True)
class DepthOfField:
    """Sharp from `near` to `far` (mm; infinite beyond the hyperfocal distance)."""

    near: float
    far: float

    @property
    def depth(self) -> float:
        """From near to far, mm."""
        return self.far - self.near


def circle_of_confusion(sensor: Sensor) -> float:
    """The blur still taken as sharp, mm: 1/2000 of the image diagonal, two to three pixels here."""
    return float(np.hypot(sensor.width, sensor.height)) * sensor.pixel_pitch / 2000


def depth_of_field(
    principal_distance: float, focus_distance: float, f_number: float, confusion: float
) -> DepthOfField:
    """Depth of field of a lens focused at `focus_distance`, all mm.

    The principal distance stands for the focal length, which it exceeds by f²/s: 0.4 % at 1 m for
    these lenses. Raises ValueError for lengths that are not positive.
    """
    f, s = principal_distance, focus_distance
    if min(f, f_number, confusion) <= 0 or s <= f:
        raise ValueError(
            f"no depth of field for c {f} mm focused at {s} mm, f/{f_number}, circle {confusion} mm"
        )
    hyperfocal = f * f / (f_number * confusion) + f
    near = s * (hyperfocal - f) / (hyperfocal + s - 2 * f)
    far = s * (hyperfocal - f) / (hyperfocal - s) if hyperfocal > s else float("inf")
    return DepthOfField(near, far)
