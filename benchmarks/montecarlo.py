"""Compare the Monte-Carlo simulation with a loop over cv2.undistortPoints (one thread, same run).

Run: python -m benchmarks.montecarlo   (exit status 1 if a bound is missed)
Bounds: 50,000 sets × 9 points, including drawing and clustering, ≤ 0.25 × the loop (runs vary from
0.19 to 0.22, of least times taken in turn); distances equal to 1e-6 mm; ≤ 20 MB, for five million
sets too.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
import tracemalloc

import cv2
import numpy as np

from benchmarks.adjustment import least_seconds
from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.montecarlo import draw_root, on_plane, plane_errors, simulate_errors
from thermocald.photogrammetry.camera.camera_model import Sensor

SENSOR = Sensor(3264, 2448, 0.0014)
IOP = np.array([3.97, 0.021, -0.034, 0.0051, -4e-4, 1e-5, 1.2e-4, -0.9e-4, 0.0, 0.0])
SDS = np.array([0.0018, 0.005, 0.0028, 2e-5, 2e-6, 1e-7, 5e-6, 5e-6, 0.0, 0.0])
CORRELATION = np.eye(10)
CORRELATION[3, 4] = CORRELATION[4, 3] = CORRELATION[4, 5] = CORRELATION[5, 4] = -0.9
CORRELATION[3, 5] = CORRELATION[5, 3] = 0.8
CORRELATION[1, 6] = CORRELATION[6, 1] = 0.6
SETS, DISTANCE_MM = 50_000, 10_000.0


def opencv_loop(sets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the ideal points of every set, with one OpenCV call per set."""
    pitch, centre = SENSOR.pixel_pitch, SENSOR.centre
    image = points.reshape(-1, 1, 2)
    ideal = np.empty((len(sets), len(points), 2))
    matrix = np.eye(3)
    for i, (c, x0, y0, a1, a2, a3, b1, b2, _, _) in enumerate(sets):
        matrix[0, 0] = matrix[1, 1] = c / pitch
        matrix[0, 2], matrix[1, 2] = centre[0] + x0 / pitch, centre[1] - y0 / pitch
        distortion = np.array([a1 * c**2, a2 * c**4, -b2 * c, b1 * c, a3 * c**6])
        ideal[i] = cv2.undistortPoints(image, matrix, distortion)[:, 0]
    return ideal


def main() -> int:
    cv2.setNumThreads(1)
    points = image_grid(SENSOR)
    root = draw_root(SDS, CORRELATION)
    sets = IOP + np.random.default_rng(0).standard_normal((SETS, len(root))) @ root
    settings = StudySettings(sets=SETS)
    ours, loop = least_seconds(
        [
            lambda: simulate_errors(SENSOR, IOP, SDS, CORRELATION, settings),
            lambda: opencv_loop(sets, points),
        ],
        4,
    )

    plane = opencv_loop(sets, points) * [DISTANCE_MM, -DISTANCE_MM]
    theirs = np.linalg.norm(plane - on_plane(SENSOR, IOP, points, DISTANCE_MM), axis=2)
    mine = np.hypot(
        *plane_errors(SENSOR, sets, points, on_plane(SENSOR, IOP, points, DISTANCE_MM), DISTANCE_MM)
    ).T
    difference = float(np.abs(mine - theirs).max())

    def peak_mb(count: int) -> float:
        tracemalloc.start()
        simulate_errors(SENSOR, IOP, SDS, CORRELATION, StudySettings(sets=count))
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        return peak

    begin = time.process_time()
    many = peak_mb(5_000_000)
    million = time.process_time() - begin
    few = peak_mb(SETS)
    rows = [
        ("50,000 sets × 9 points, thermocald", f"{ours:.3f} s", f"{ours / loop:.3f}", "≤ 0.25"),
        ("loop over cv2.undistortPoints", f"{loop:.3f} s", "1", ""),
        ("largest difference of distances", f"{difference:.1e} mm", "", "≤ 1e-6 mm"),
        ("peak memory, 50,000 sets", f"{few:.1f} MB", "", "≤ 20 MB"),
        ("peak memory, 5,000,000 sets", f"{many:.1f} MB", "", "≤ 20 MB"),
        ("5,000,000 sets, with memory tracing", f"{million:.1f} s", "", ""),
    ]
    for name, value, ratio, bound in rows:
        print(f"{name:38}{value:>14}{ratio:>8}   {bound}")
    kept = ours / loop <= 0.25 and difference <= 1e-6 and max(few, many) <= 20
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
