"""Measure the thermal model's speed: `at`, undistorting a million points, fitting 20 series.

Run: python -m benchmarks.thermal_model   (exit status 1 if a bound is missed)
Bounds: `at` ≤ 50 µs; undistorting 1 M points ≤ 2 × cv2.undistortPoints, which stops at a coarser
answer (one thread each); reducing 20 series of 1,000 epochs × 147 targets and fitting them with an
effect that has a memory (permanent_set) and two drifts of the distortion ≤ 20 s and < 1 GB.
Times are thread times, so that a busy machine does not count.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import resource
import sys
import time
from dataclasses import replace

import cv2
import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect
from thermocald.physics.presets import preset_simulation
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input

SERIES, EPOCHS = 20, 1000


def fitted() -> tuple[ThermalCamera, bool]:
    series, reducing = [], 0.0
    for k in range(SERIES):
        s = preset_simulation("rpi-v2.1-heating", seed=k)
        lamp = Course.steps([0, 2000 + 100 * k, 5000, 7000, 2e4], [4.0, 0.0, 3.0, 0.0])
        s = replace(s, programme=replace(s.programme, epochs=EPOCHS, sources={"housing": lamp}))
        epochs = list(s.epochs())
        begin = time.thread_time()
        source = epochs_input(s.head, s.field, epochs, f"M{k}")
        series.append(reduce_series(source, strict=False))
        reducing += time.thread_time() - begin
    listed = [
        ModelEffect("permanent_set", {"x0": 0.0, "y0": 0.0}),
        ModelEffect("radial_distortion_drift", {"A1": 0.0}),
        ModelEffect("decentering_drift", {"B1": 0.0, "B2": 0.0}),
    ]
    begin = time.thread_time()
    model = fit_thermal_model(series, listed, T0=25.0)
    fitting = time.thread_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{SERIES} series × {EPOCHS} epochs: reduced in {reducing:.1f} s, fitted in "
        f"{fitting:.1f} s (bound 20 s in all), peak memory {peak:.0f} MB (bound 1000 MB)"
    )
    return model, reducing + fitting <= 20.0 and peak < 1000


def use(camera: ThermalCamera) -> bool:
    state = camera.at(35.0)
    took = []
    for _ in range(20):
        begin = time.thread_time()
        for _ in range(100):
            camera.at(35.0)
        took.append((time.thread_time() - begin) / 100)
    ratio = undistorting(state)
    print(
        f"at(): {min(took) * 1e6:.0f} µs (bound 50 µs); undistorting 1 M points: {ratio:.2f} × "
        "cv2.undistortPoints (bound 2)"
    )
    return min(took) <= 50e-6 and ratio <= 2.0


def undistorting(state: Camera) -> float:
    """Return the time to undistort a million points over that of cv2.undistortPoints."""
    points = np.random.default_rng(0).uniform([0, 0], [3279, 2463], (1_000_000, 2))
    i, p = state.interior, state.sensor.pixel_pitch
    K = np.array([[i.c / p, 0, 3279 / 2 + i.x0 / p], [0, i.c / p, 2463 / 2 - i.y0 / p], [0, 0, 1]])
    D = np.array([i.A1 * i.c**2, i.A2 * i.c**4, -i.B2 * i.c, i.B1 * i.c, i.A3 * i.c**6])
    ours, theirs = [], []
    for _ in range(7):
        begin = time.thread_time()
        state.undistort(points)
        middle = time.thread_time()
        cv2.undistortPoints(points[:, None], K, D)
        ours.append(middle - begin)
        theirs.append(time.thread_time() - middle)
    return min(ours) / min(theirs)


def main() -> int:
    cv2.setNumThreads(1)
    model, passed = fitted()
    passed = use(model) and passed
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
