"""Test fields for the tests of target measurement: a corner of coded and plain circles."""

from __future__ import annotations

from functools import cache

import numpy as np

from tests.photogrammetry.exact_rendering import Scene, look_at
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.markers import marker_cells

PI_SENSOR = Sensor(3280, 2464, 0.00112)
PI_CAMERA = CameraModel(
    PI_SENSOR,
    InteriorOrientation(3.04, 0.02, -0.015, A1=-4e-3, A2=1e-4, B1=1e-4, B2=-1e-4, C1=1e-4),
)


def corner_field(
    per_side: int = 7,
    spacing: float = 60.0,
    diameter: float = 10.0,
    bits: int = 14,
    coded_every: int = 3,
    inset: float = 45.0,
) -> tuple[TestField, np.ndarray]:
    """Return a field of three sheets in a room's corner, and its targets' normals (n, 3)."""
    codes = ring_code.codes(bits)
    names, points, normals, kinds = [], [], [], []
    number = 0
    for plane in range(3):
        normal = np.eye(3)[plane]
        u, v = np.eye(3)[(plane + 1) % 3], np.eye(3)[(plane + 2) % 3]
        for i in range(per_side):
            for j in range(per_side):
                points.append((inset + spacing * i) * u + (inset + spacing * j) * v)
                normals.append(normal)
                coded = (i + 2 * j) % coded_every == 0
                kinds.append(f"RING{bits}:{codes[number]}" if coded else "")
                number += coded
                names.append(f"{'XYZ'[plane]}{i}.{j}")
    field = TestField.build(names, points, 0.01, diameter, "circle", kinds)
    return field, np.array(normals)


def draw(field: TestField, normals: np.ndarray, **scene) -> Scene:
    """Return the scene of a field; each coded target is turned differently."""
    drawn = Scene(**scene)
    for i, code in enumerate(field.codes):
        if ring_code.is_ring(code):
            drawn.ring(
                field.points[i], normals[i], field.diameters[i], *ring_code.parse(code),
                turn=0.37 * i % 1,
            )  # fmt: skip
        elif field.kinds[i] == "circle":
            drawn.disc(field.points[i], normals[i], field.diameters[i])
    return drawn


def station(distance: float = 750.0, target=(200.0, 200.0, 200.0), roll: float = 0.0):
    """Return the orientation of a camera that looks into the corner along its diagonal."""
    direction = np.ones(3) / np.sqrt(3)
    return look_at(np.array(target) + distance * direction, np.array(target), roll)


SMALL_SENSOR = Sensor(1640, 1232, 0.00224)
SMALL_CAMERA = CameraModel(SMALL_SENSOR, PI_CAMERA.interior)


def small_field(bits: int = 14) -> tuple[TestField, np.ndarray]:
    """Return a field of 108 targets of 15 mm, for the binned camera."""
    return corner_field(per_side=6, spacing=75.0, diameter=15.0, bits=bits)


@cache
def small_frame() -> np.ndarray:
    """Return the noise-free frame of `small_field` from `station(800.0)`, drawn once."""
    frame = draw(*small_field()).render(SMALL_CAMERA, station(800.0))
    frame.setflags(write=False)
    return frame


def draw_marker(
    scene: Scene, dictionary: str, number: int, corners: np.ndarray, border: int = 1
) -> None:
    """Draw a marker with outer corners (4, 3) mm in the order of its codes, border in cells."""
    black = marker_cells(dictionary, number, border)
    cells = len(black)
    a, b, _, e = corners
    for row in range(cells):
        # Each black run is one piece, without seams between its cells
        dark = np.flatnonzero(np.diff(np.r_[0, black[row], 0]))
        for begin, end in zip(dark[::2], dark[1::2], strict=True):
            u = np.array([begin, end, end, begin])[:, None] / cells
            v = np.array([row, row, row + 1, row + 1])[:, None] / cells
            scene.patch(a + u * (b - a) + v * (e - a))
