"""Simulated surveys for the tests of the network: stations around a field, and photographs."""

from __future__ import annotations

import numpy as np

from tests.photogrammetry.exact_rendering import look_at
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.field.testfield import Distance, Observations

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(
    c=3.05, x0=0.021, y0=-0.013, A1=-2.1e-3, A2=4.0e-4, A3=-2.0e-5, B1=4e-5, B2=-3e-5,
    C1=3e-4, C2=-2e-4,
)  # fmt: skip
CAMERA = CameraModel(SENSOR, INTERIOR)


def bent_sheet(nx=12, ny=9, size=(800.0, 560.0), sag=6.0):
    """Return a grid (n, 3) mm on a cylindrically bent and slightly twisted sheet of paper."""
    x, y = np.meshgrid(np.linspace(0, size[0], nx), np.linspace(0, size[1], ny))
    u, v = x / size[0] - 0.5, y / size[1] - 0.5
    z = sag * (1 - 4 * u * u) + 0.4 * sag * u * v
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def looking_at(centre, target, roll):
    """Return the orientation of a camera at `centre` that looks at `target`, with roll in rad."""
    return look_at(centre, target, roll, up=(0.0, 1.0, 0.0), else_up=(1.0, 0.0, 0.0), nearly=0.95)


def convergent_stations(field, n=12, distance=950.0, tilt=0.66, rolled=True):
    """Return n stations on a ring, rolled by 0, 90, 180 and 270° in turn."""
    centre = field.mean(axis=0)
    stations = []
    for i in range(n):
        azimuth = 2 * np.pi * i / n + 0.1
        a = tilt * (1.0 if i % 3 else 0.4)
        d = distance * (1 + 0.08 * ((i * 7) % 5 - 2) / 2)
        where = centre + d * np.array(
            [np.sin(a) * np.cos(azimuth), np.sin(a) * np.sin(azimuth), np.cos(a)]
        )
        stations.append(looking_at(where, centre, (i % 4) * np.pi / 2 if rolled else 0.0))
    return stations


def photographs(field, stations, sigma, rng, camera=CAMERA, loss=0.03, gross=0.0):
    """Draw noisy photographs in which some targets are missing and some have gross errors."""
    photos, wrong = {}, []
    for i, station in enumerate(stations):
        image = camera.project(station, field)
        seen = camera.sensor.contains(image, 20.0) & (rng.random(len(field)) > loss)
        rows = np.flatnonzero(seen)
        points = image[rows] + rng.normal(0, sigma, (len(rows), 2))
        bad = rng.random(len(rows)) < gross
        points[bad] += rng.choice([-1, 1], (bad.sum(), 2)) * rng.uniform(0.5, 60, (bad.sum(), 2))
        wrong += [(f"photo{i}", int(t)) for t in rows[bad]]
        photos[f"photo{i}"] = Observations(rows, points, np.full((len(rows), 2), sigma))
    return photos, wrong


def distance(field, a, b, sd, error=0.0):
    """Return a measured distance between two targets of a field, mm."""
    return Distance(f"t{a}", f"t{b}", float(np.linalg.norm(field[b] - field[a])) + error, sd)


def onto(points, truth):
    """Move points (without scaling) onto the truth by least squares; return also the rotation."""
    p, q = points.mean(axis=0), truth.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - p).T @ (truth - q))
    R = Vt.T @ np.diag([1, 1, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
    return (points - p) @ R.T + q, R


def normalised_errors(network, truth):
    """Return errors in the truth's axes (n, 3) mm, and errors over stated standard deviations."""
    moved, R = onto(network.points, truth)
    blocks = network.covariance.reshape(len(truth), 3, len(truth), 3)
    own = np.array([R @ blocks[i, :, i, :] @ R.T for i in range(len(truth))])
    sd = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    return moved - truth, (moved - truth) / sd
