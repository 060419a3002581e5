"""Test fields to simulate with: three mutually perpendicular planes that meet in a corner.

The corner is the origin, the planes are X = 0, Y = 0 and Z = 0, the targets lie where all
coordinates are positive. Depth in all directions is what separates principal distance and
principal point from the orientation (Luhmann et al. 2014, section 7.3).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code

__all__ = ["corner_field", "corner_view"]

# In-plane directions (right, down) of a viewer in front of each plane.
_PLANES = {
    "x": (np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])),
    "y": (np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])),
    "z": (np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])),
}


def corner_field(
    kind: Literal["markers", "circles", "plain"] = "circles",
    per_side: int = 7,
    pitch_mm: float = 90.0,
    size_mm: float | None = None,
    coded_every: int = 4,
    dictionary: str = "DICT_APRILTAG_36h11",
    sigma_mm: float = 0.02,
) -> TestField:
    """A corner field of per_side² targets on each of three planes.

    markers: per_side² square markers per plane, four targets each (default side 0.7 pitch);
    circles: circular targets (default diameter 0.22 pitch), every `coded_every`-th with a 12-bit
    ring code; plain: all without. Pitch, size and sigma (all coordinates) in mm. 7 a side are 147
    circles; 4 a side are 192 marker corners.
    """
    if per_side < 1 or pitch_mm <= 0:
        raise ConfigurationError("a corner field needs at least one target a side, and a pitch > 0")
    size = size_mm or (0.7 if kind == "markers" else 0.22) * pitch_mm
    names, points, codes = [], [], []
    number = 0
    ring = ring_code.codes(12)
    for plane, (right, down) in _PLANES.items():
        # the middle of the plane, half a pitch away from the edges it shares with the others
        middle = 0.5 * per_side * pitch_mm * (np.abs(right) + np.abs(down))
        for j in range(per_side):
            for i in range(per_side):
                u, v = (i - (per_side - 1) / 2) * pitch_mm, (j - (per_side - 1) / 2) * pitch_mm
                centre = middle + u * right + v * down
                if kind == "markers":
                    for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
                        names.append(f"{number}.{corner}")
                        points.append(centre + 0.5 * size * (a * right + b * down))
                        codes.append(f"{dictionary}:{number}:{corner}")
                else:
                    coded = kind == "circles" and number % coded_every == 0
                    place = number // coded_every
                    if coded and place >= len(ring):
                        raise ConfigurationError(
                            f"there are {len(ring)} ring codes of 12 bit: code every "
                            f"{-(-3 * per_side**2 // len(ring))}th target or fewer"
                        )
                    names.append(f"{plane}{j + 1}{i + 1}" if per_side < 10 else str(number))
                    points.append(centre)
                    codes.append(ring_code.write(12, ring[place]) if coded else "")
                number += 1
    return TestField.build(
        names,
        np.array(points),
        sigma_mm,
        np.nan if kind == "markers" else size,
        "marker_corner" if kind == "markers" else "circle",
        codes,
    )


def corner_view(field: TestField, distance_mm: float, roll_deg: float = 0.0) -> ExteriorOrientation:
    """The orientation of a camera that looks into the corner along its diagonal.

    From `distance_mm` it looks at the middle of the targets; Z is up in the image at roll 0.
    """
    middle = field.points.mean(axis=0)
    backward = np.ones(3) / np.sqrt(3.0)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    up = np.cross(backward, right)
    a = np.deg2rad(roll_deg)
    columns = [np.cos(a) * right + np.sin(a) * up, -np.sin(a) * right + np.cos(a) * up, backward]
    return ExteriorOrientation.from_rotation(
        np.stack(columns, axis=1), middle + distance_mm * backward
    )
