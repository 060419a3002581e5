"""Recordings of fields unlike the simulation's: crooked, badly surveyed, moving.

The image points share no code with the program: the projection is that of the blind recordings,
with errors as in real set-ups. Frames are rendered by the simulation, with a bent
field. The truth of each epoch is returned.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.blind.world import image
from tests.recordings import write_recording
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import corner_field, corner_view
from thermocald.store.recording.testfield_file import write_testfield

PITCH = 0.00112
SIZE = (3280, 2464)
CAMERA = {
    "c": 3.04, "x0": 0.012, "y0": -0.021, "A1": -6.0e-3, "A2": 4.0e-4, "B1": 2e-5, "B2": -3e-5,
}  # fmt: skip
NOISE_PX = 0.05


def project(points: np.ndarray, pose: np.ndarray, c: float, x0: float, y0: float) -> np.ndarray:
    """Project object points (n, 3) mm, px (n, 2); pose: three angles and a centre."""
    one = {**CAMERA, "c": c, "x0": x0, "y0": y0}
    interior = [one.get(name, 0.0) for name in IOP_NAMES]
    return image(points[None], np.array([[*interior, *pose]]), (*SIZE, PITCH))[0]


def corner(rows: int, rng: np.random.Generator, crooked_mm: float) -> np.ndarray:
    """Draw targets (3·rows², 3) mm on three walls of a corner, each turned and bent."""
    grid = np.linspace(60.0, 660.0, rows)
    a, b = (g.ravel() for g in np.meshgrid(grid, grid))
    walls = []
    for axis in range(3):
        bent = crooked_mm * (np.sin(a / 240.0 + rng.uniform(0, 6)) + np.cos(b / 310.0))
        turned = np.deg2rad(rng.normal(0, 1.0, 2))
        wall = np.zeros((a.size, 3))
        wall[:, (axis + 1) % 3], wall[:, (axis + 2) % 3] = a, b
        wall[:, axis] = bent + turned[0] * (a - 360) + turned[1] * (b - 360)
        walls.append(wall)
    return np.concatenate(walls)


def pose_before(distance_mm: float) -> np.ndarray:
    """Return the pose of a camera that looks into the corner along its diagonal."""
    centre = np.full(3, 250.0) + distance_mm / np.sqrt(3)
    back = (centre - 250.0) / np.linalg.norm(centre - 250.0)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    r = np.column_stack([right, np.cross(back, right), back])
    phi = np.arcsin(r[0, 2])
    omega, kappa = np.arctan2(-r[1, 2], r[2, 2]), np.arctan2(-r[0, 1], r[0, 0])
    return np.array([omega, phi, kappa, *centre])


def smooth(rng: np.random.Generator, epochs: int, memory: float) -> np.ndarray:
    """Draw a first-order autoregressive series (epochs,) of variance 1."""
    k = np.exp(-1.0 / memory) if memory > 0 else 0.0
    out = np.empty(epochs)
    out[0] = rng.normal()
    for i in range(1, epochs):
        out[i] = k * out[i - 1] + np.sqrt(1 - k**2) * rng.normal()
    return out


def head_of(name: str, camera: str, size: tuple[int, int], pitch: float) -> dict[str, object]:
    """Return the head of a recording with one thermometer."""
    return {
        "name": name, "series": "M1", "interval": 10.0,
        "camera": {"name": camera, "width": size[0], "height": size[1], "pixel_pitch": pitch,
                   "principal_distance": 3.04},
        "temperatures": {"temperature": {"unit": "degC", "resolution": 0.0625}},
    }  # fmt: skip


# rows of targets; errors of the survey, mm, as they are and as stated; constant error of images, px
KINDS = {
    "surveyed": (11, 0.002, 0.002, 0.04),
    "badly_surveyed": (7, 0.4, 0.15, 0.01),
    "knocked": (7, 0.02, 0.02, 0.01),
    "trembling": (7, 0.02, 0.02, 0.01),
}


def write(folder: Path, kind: str, seed: int, epochs: int = 70) -> dict[str, np.ndarray]:
    """Write a recording of one kind; return the true c, x0, y0 (epochs,) mm.

    surveyed: each target's image has a constant error, like edges of prints; badly_surveyed: boards
    are hidden at times; knocked: the camera is turned by 0.03° at two thirds, two targets wander;
    trembling: the mount moves by 0.06 px, mostly slowly.
    """
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    rows, wrong_mm, stated_mm, bias_px = KINDS[kind]
    field = corner(rows, rng, crooked_mm=3.0)
    targets = len(field)
    known = field + rng.normal(0, wrong_mm, field.shape)
    bias = rng.normal(0, bias_px, (targets, 2))
    time = 1.7e9 + 10.0 * np.arange(epochs)
    temperature = 33.0 - 9.0 * np.exp(-np.arange(epochs) / (epochs / 4))
    truth = interior_at(temperature, CAMERA["x0"], CAMERA["y0"])
    pose = np.tile(pose_before(1500.0), (epochs, 1))
    if kind == "trembling":
        angle = 0.06 * PITCH / CAMERA["c"]
        pose[:, :2] += angle * np.column_stack(
            [0.9 * smooth(rng, epochs, 15.0) + 0.4 * rng.normal(size=epochs) for _ in range(2)]
        )
    wander = np.zeros((epochs, targets, 2))
    if kind == "knocked":
        pose[2 * epochs // 3 :, 0] += np.deg2rad(0.03)
        for t in rng.choice(targets, 2, replace=False):
            wander[:, t, :] = 0.3 * np.column_stack([smooth(rng, epochs, 25.0) for _ in range(2)])
    board = np.arange(targets) // 7
    hidden = np.zeros((epochs, targets), bool)
    if kind == "badly_surveyed":
        for b in range(board.max() + 1):
            for first in rng.choice(epochs, 2):
                hidden[first : first + rng.integers(3, 12), board == b] = True
    heads, observations = [], []
    for e in range(epochs):
        read = np.round((temperature[e] + rng.normal(0, 0.03)) / 0.0625) * 0.0625
        heads.append([e + 1, f"{time[e]:.3f}", f"{time[e]:.3f}", read, ""])
        image = project(field, pose[e], *(values[e] for values in truth.values()))
        image += bias + wander[e] + rng.normal(0, NOISE_PX, (targets, 2))
        inside = ((image > 5) & (image < np.array(SIZE) - 6)).all(axis=1)
        for t in np.flatnonzero(inside & ~hidden[e]):
            u, v = image[t]
            observations.append([e + 1, f"t{t}", f"{u:.4f}", f"{v:.4f}", NOISE_PX, NOISE_PX])
    sds = [stated_mm] * 3
    field_rows = [[f"t{t}", *(f"{v:.5f}" for v in known[t]), 20.0, *sds] for t in range(targets)]
    head = head_of(f"{kind}-{seed}", f"crooked-{kind}", SIZE, PITCH)
    write_recording(folder, head, heads, observations, field_rows)
    return truth


def interior_at(temperature: np.ndarray, x0: float, y0: float) -> dict[str, np.ndarray]:
    """Return the true c, x0, y0, mm, of a camera with these x0 and y0 at 24 °C."""
    warm = temperature - 24.0
    return {"c": 3.04 + 0.4e-3 * warm, "x0": x0 + 0.35e-3 * warm, "y0": y0 - 0.2e-3 * warm}


def write_frames(folder: Path, epochs: int, seed: int) -> dict[str, np.ndarray]:
    """Write a recording of JPEG frames (1640 × 1232) of bent planes of markers; sds are 2 µm."""
    rng = np.random.default_rng([seed, 99])
    plane = corner_field("markers", per_side=4)
    u, v, w = plane.points.T
    bend = np.column_stack([np.sin(v / 90) + w / 90, np.cos(w / 70), np.sin(u / 110) - v / 120])
    sigmas = np.full(plane.points.shape, 0.002)
    field = replace(plane, points=plane.points + 1.5 * bend, sigmas=sigmas)
    sensor = Sensor(1640, 1232, 2 * PITCH)
    view = corner_view(field, 900.0).as_array()
    scene = Scene(sensor, field)
    known = replace(field, points=field.points + rng.normal(0, 0.002, field.points.shape))
    temperature = 24.0 + 0.5 * np.arange(epochs)
    truth = interior_at(temperature, 0.012, -0.021)
    (folder / "frames").mkdir(parents=True)
    heads = []
    for e in range(epochs):
        iop = np.zeros(10)
        iop[:4] = *(values[e] for values in truth.values()), CAMERA["A1"]
        name, time = f"frames/{e + 1:04}.jpg", 1.7e9 + 10.0 * e
        picture = scene.render(iop, view, None, [seed, e])
        cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
        heads.append([e + 1, time, time, f"{temperature[e]:.3f}", name])
    head = head_of(f"frames-{seed}", "bent", (sensor.width, sensor.height), sensor.pixel_pitch)
    head["temperatures"] = {"temperature": {"unit": "degC"}}  # without a stated resolution
    write_recording(folder, head, heads)
    write_testfield(folder / "testfield.csv", known)
    return truth
