"""An epoch's adjustment against OpenCV's, and a batch of epochs against one by one (one thread).

Run: python benchmarks/adjustment.py
Bounds: warm epoch with full covariance ≤ 0.4 × cv2.calibrateCameraExtended on the same points;
a batch of 1,000 epochs ≤ 0.06 × per epoch.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from thermocald.photogrammetry.adjustment import adjust
from thermocald.photogrammetry.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.normals import ObservationGrid
from thermocald.photogrammetry.series import SeriesSettings, adjust_series
from thermocald.photogrammetry.testfield import Observations, TestField

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(3.04, 0.02, -0.03, -5e-3, 4e-4, -1e-5, 3e-4, -2e-4)
SIGMA_PX = 0.04


def corner_field() -> TestField:
    """150 targets on three mutually perpendicular planes."""
    a, b = (g.ravel() for g in np.meshgrid(np.linspace(60, 600, 7), np.linspace(60, 600, 7)))
    z = np.zeros_like(a)
    planes = [np.c_[a, b, z], np.c_[a, z, b], np.c_[z, a, b], [[0, 0, 0], [330, 0, 0], [0, 330, 0]]]
    points = np.vstack(planes)
    return TestField.build([str(i) for i in range(len(points))], points)


def looking_at(centre: list[float], target: list[float]) -> ExteriorOrientation:
    """A camera at one place that looks at another, upright."""
    backward = np.array(centre, dtype=float) - np.array(target, dtype=float)
    backward /= np.linalg.norm(backward)
    right = np.cross([0, 0, 1], backward)
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(backward, right), backward])
    return ExteriorOrientation.from_rotation(R, centre)


EXTERIOR = looking_at([950, 900, 800], [150, 180, 160])


def observe(field: TestField, rng: np.random.Generator) -> Observations:
    """All targets with their noise."""
    points = project(SENSOR, INTERIOR.as_array(), EXTERIOR.as_array(), field.points)
    points += rng.normal(0, SIGMA_PX, points.shape)
    return Observations(np.arange(len(field)), points, np.full(points.shape, SIGMA_PX))


def median_seconds(function: Callable[[], object], runs: int) -> float:
    """Median time of a call after a warm-up."""
    function()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def opencv(field: TestField, observations: Observations) -> Callable[[], object]:
    """The same points and the same eight IOP through OpenCV."""
    f = INTERIOR.c / SENSOR.pixel_pitch
    K = np.array([[f, 0, SENSOR.centre[0]], [0, f, SENSOR.centre[1]], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    objects = field.points.astype(np.float32)[None]
    images = observations.points.astype(np.float32)[None]
    size = (SENSOR.width, SENSOR.height)
    return lambda: cv2.calibrateCameraExtended(
        objects, images, size, K.copy(), np.zeros(5), flags=flags
    )


def in_turn(a: Callable[[], object], b: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median seconds of two calls, taken in turn so that the machine's moods hit both."""
    pairs = [(median_seconds(a, 8), median_seconds(b, 8)) for _ in range(rounds)]
    return sorted(pairs, key=lambda p: p[0] / p[1])[rounds // 2]


def main() -> int:
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    field = corner_field()
    epochs = [observe(field, rng) for _ in range(1000)]
    single = iter(range(10**9))

    def one() -> object:
        return adjust(SENSOR, field, epochs[next(single) % 1000], INTERIOR, EXTERIOR)

    ours, peer = in_turn(one, opencv(field, epochs[0]), 31)
    settings = SeriesSettings(
        exterior="per_epoch", target_offsets=False, target_noise=False, snooping_alpha=0.001
    )

    grid = ObservationGrid.from_observations(field, epochs)

    def batch() -> object:
        return adjust_series(SENSOR, field, grid, INTERIOR, EXTERIOR, settings)

    per_epoch = median_seconds(batch, 5) / len(epochs)
    rows = [
        ("warm epoch / cv2.calibrateCameraExtended", ours / peer, 0.4),
        ("batch of 1,000, per epoch / warm epoch", per_epoch / ours, 0.06),
    ]
    print(f"{'':45} ratio   bound")
    for name, ratio, bound in rows:
        print(f"{name:45} {ratio:5.3f}  {bound:5.3f}  {'ok' if ratio <= bound else 'MISSED'}")
    print(
        f"(epoch {ours * 1e3:.3f} ms, OpenCV {peer * 1e3:.3f} ms, batch {per_epoch * 1e6:.1f} µs)"
    )
    return int(any(ratio > bound for _, ratio, bound in rows))


if __name__ == "__main__":
    sys.exit(main())
