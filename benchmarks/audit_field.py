"""Audit of `testfield survey`: coordinates and camera from a free network."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.audit_camera import NOISE_PX
from benchmarks.audit_rows import Row, ratio
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.field.testfield import Distance, Observations, TestField
from thermocald.photogrammetry.network.adjustment import adjust_network
from thermocald.photogrammetry.survey import surveyed_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(
    c=3.05, x0=0.021, y0=-0.013, A1=-2.1e-3, A2=4.0e-4, A3=-2.0e-5, B1=4e-5, B2=-3e-5
)
STATIONS = 8
TAPE_MM = 0.05


def _sheet() -> Array:
    """Return a bent sheet of 30 targets, (30, 3) mm."""
    x, y = np.meshgrid(np.linspace(0, 800, 6), np.linspace(0, 560, 5))
    u = x / 800 - 0.5
    return np.column_stack([x.ravel(), y.ravel(), 6 * (1 - 4 * u.ravel() ** 2)])


def _stations(field: Array) -> list[ExteriorOrientation]:
    """Return convergent stations on a ring; the camera is rolled by 90° at every other one."""
    centre = field.mean(axis=0)
    found = []
    for k in range(STATIONS):
        azimuth, tilt = 2 * np.pi * k / STATIONS + 0.1, 0.66 if k % 3 else 0.26
        z = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        y = np.cross(z, x)
        turned = (x, y) if k % 2 else (y, -x)
        rotation = np.column_stack([*turned, z])
        found.append(ExteriorOrientation.from_rotation(rotation, centre + 950.0 * z))
    return found


def survey(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the coordinates, scaled by one measured distance, and the camera."""
    field, stations = _sheet(), _stations(_sheet())
    nominal = TestField.build([f"t{k}" for k in range(len(field))], field)
    length = float(np.linalg.norm(field[-1] - field[0]))
    points, camera = [], []
    for _ in range(draws):
        photos = {}
        for k, station in enumerate(stations):
            image = project(SENSOR, INTERIOR.as_array(), station.as_array(), field)
            rows = np.flatnonzero(SENSOR.contains(image, 20.0))
            seen = image[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))
            photos[f"p{k}"] = Observations(rows, seen, np.full(seen.shape, NOISE_PX))
        taped = length + float(rng.normal(0, TAPE_MM))
        network = adjust_network(
            SENSOR, photos, nominal.names, [Distance("t0", f"t{len(field) - 1}", taped, TAPE_MM)],
            interior=INTERIOR, nominal=field, free=("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2"),
        )  # fmt: skip
        found = surveyed_field(network, nominal)
        points.append(((found.points - field) / found.sigmas).ravel())
        at = network.camera.interior.as_array() - INTERIOR.as_array()
        camera.append(at[:3] / np.sqrt(np.diag(network.interior_covariance)[:3]))
    return [
        ratio("`testfield survey`", "sd of X, Y, Z of 30 targets, 8 photographs",
              "noise, the measured distance; datum: the nominal field", np.array(points)),
        ratio("`testfield survey`", "sd of c, x0, y0", "noise", np.array(camera)),
    ]  # fmt: skip
