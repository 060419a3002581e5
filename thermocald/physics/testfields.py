"""The set-up of the demo and of the rendering mock camera: a known camera before a known field.

The camera is a Raspberry Pi camera v2.1 (sensor data: `presets`); its drift is of the size reported
by the reference study (Elias et al. 2020, section 4.2).

The simulated test fields are three mutually perpendicular planes that meet in a corner. The corner
is the origin, the planes are X = 0, Y = 0 and Z = 0, and the targets have positive coordinates.
Depth in all directions separates principal distance and principal point from the exterior
orientation (Luhmann et al. 2014, section 7.3).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, cast

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import (
    RASPBERRY_PI_V2,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.physics.model import ThermalModel
from thermocald.store.recording.testfield_file import read_testfield

RPI_INTERIOR = InteriorOrientation(
    c=3.04, x0=0.012, y0=-0.018, A1=-0.0040, A2=5.0e-4, B1=1.0e-4, B2=-2.0e-4
)
"""The interior orientation of a Raspberry Pi camera v2.1, with a distortion of usual size."""
# In-plane directions (right, down) for a viewer in front of each plane.
_PLANES = {
    "x": (np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])),
    "y": (np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])),
    "z": (np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])),
}


FieldKind = Literal["markers", "circles", "plain"]


def corner_field(
    kind: FieldKind = "circles", per_side: int = 7, pitch_mm: float = 90.0
) -> TestField:
    """Lay out a corner field of per_side² targets on each of three planes, `pitch_mm` apart.

    markers: square markers of 0.7 pitch with four targets each; circles: circular targets of 0.22
    pitch, every fourth with a 12-bit ring code; plain: circles without codes. The standard
    deviation of all coordinates is 0.02 mm. With per_side 7 there are 147 circles; with per_side 4,
    192 marker corners.
    """
    if per_side < 1 or pitch_mm <= 0:
        raise ConfigurationError(
            "a corner field needs at least one target per side, and a pitch above 0 mm"
        )
    size = (0.7 if kind == "markers" else 0.22) * pitch_mm
    names, points, codes = [], [], []
    number = 0
    ring = ring_code.codes(12)
    for plane, (right, down) in _PLANES.items():
        # the centre of the targets, which stay half a pitch away from the corner's edges
        middle = 0.5 * per_side * pitch_mm * (np.abs(right) + np.abs(down))
        for j in range(per_side):
            for i in range(per_side):
                u, v = (i - (per_side - 1) / 2) * pitch_mm, (j - (per_side - 1) / 2) * pitch_mm
                centre = middle + u * right + v * down
                if kind == "markers":
                    for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
                        names.append(f"{number}.{corner}")
                        points.append(centre + 0.5 * size * (a * right + b * down))
                        codes.append(f"DICT_APRILTAG_36h11:{number}:{corner}")
                else:
                    coded = kind == "circles" and number % 4 == 0
                    names.append(f"{plane}{j + 1}{i + 1}" if per_side < 10 else str(number))
                    points.append(centre)
                    codes.append(ring_code.write(12, ring[number // 4]) if coded else "")
                number += 1
    return TestField.build(
        names,
        np.array(points),
        0.02,
        np.nan if kind == "markers" else size,
        "marker_corner" if kind == "markers" else "circle",
        codes,
    )


def corner_view(field: TestField, distance_mm: float) -> ExteriorOrientation:
    """Return the exterior orientation of a camera that looks into the corner along its diagonal.

    The camera is `distance_mm` away from the centre of the targets; Z is up in the image.
    """
    middle = field.points.mean(axis=0)
    backward = np.ones(3) / np.sqrt(3.0)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    columns = [right, np.cross(backward, right), backward]
    return ExteriorOrientation.from_rotation(
        np.stack(columns, axis=1), middle + distance_mm * backward
    )


def demonstration_field(kind: FieldKind = "markers") -> TestField:
    """Lay out a corner field that fills the image: 192 marker corners, or 147 circles."""
    if kind == "markers":
        return corner_field("markers", per_side=4, pitch_mm=150.0)
    return corner_field(kind)


def load_field(kind_or_path: str) -> TestField:
    """Return a demonstration field by its kind, or read a testfield.csv."""
    if kind_or_path in ("markers", "circles", "plain"):
        return demonstration_field(cast("FieldKind", kind_or_path))
    return read_testfield(Path(kind_or_path))


def demonstration_model(field: TestField) -> ThermalModel:
    """Return a camera 1.3 m from a corner field: T₀ = 25 °C, half a pixel of drift per kelvin."""
    return ThermalModel(
        camera="rpi-v2.1",
        sensor=RASPBERRY_PI_V2.sensor,
        T0=25.0,
        interior=RPI_INTERIOR,
        rates={"c": 2.0e-4, "x0": -4.5e-4, "y0": -3.0e-4},
        exterior=corner_view(field, 1300.0),
        name="demonstration",
    )
