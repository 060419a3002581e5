"""Measure the study and report of a year of 10 s epochs (3.15 million): time, memory, size.

Run: python -m benchmarks.study [EPOCHS]   (exit status 1 if a bound is missed)
Bounds: < 60 s and < 1.5 GB for the study; < 10 MB for the report.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import sys
import time

import numpy as np

from thermocald.analysis.study.measured import MeasuredSeries, Thermometer
from thermocald.analysis.study.study import study
from thermocald.output.study.report import render_study
from thermocald.photogrammetry.camera.camera_model import Sensor

YEAR = 3_153_600
BASE = np.array([3.04, 0.012, -0.018, -0.004, 5e-4, 0.0, 1e-4, -2e-4, 0.0, 0.0])
PER_KELVIN = np.array([2e-4, 6e-4, 4e-4, 2e-7, 0.0, 0.0, 6e-7, 4e-7, 0.0, 0.0])
SDS = np.array([6e-5, 6e-6, 6e-6, 3e-5, 1.5e-5, 2e-6, 1.5e-6, 2e-6, np.nan, np.nan])


def year(epochs: int) -> MeasuredSeries:
    """Return a series with days and seasons, built column by column, as it is read from a store."""
    rng = np.random.default_rng(0)
    time_s = np.arange(epochs) * 10.0
    true = 5 * np.sin(2 * np.pi * time_s / 86_400) + 10 * np.sin(2 * np.pi * time_s / 31_557_600)
    values, sds = np.empty((epochs, 10), order="F"), np.empty((epochs, 10), order="F")
    for k in range(10):
        values[:, k] = BASE[k] + PER_KELVIN[k] * true
        if np.isfinite(SDS[k]):
            values[:, k] += SDS[k] * rng.standard_normal(epochs)
        sds[:, k] = SDS[k]
    true += 15 + 0.05 * rng.standard_normal(epochs)
    return MeasuredSeries(
        "rpi",
        "year",
        "rpi",
        Sensor(3280, 2464, 0.00112),
        "formula",
        time_s,
        (Thermometer("temperature", true, 0.05),),
        values,
        sds,
        1 + 0.03 * rng.standard_normal(epochs),
        np.full(epochs, 280.0),
        np.tile(np.eye(10), (5000, 1, 1)),
        "series",
    )


def peak_mb() -> float:
    """Return the peak resident size so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def main() -> int:
    epochs = int(sys.argv[1]) if len(sys.argv) > 1 else YEAR
    series = year(epochs)
    print(f"{epochs} epochs in memory: {peak_mb():.0f} MB")
    begin, cpu = time.perf_counter(), time.process_time()
    result = study([series])
    seconds, cpu_seconds = time.perf_counter() - begin, time.process_time() - cpu
    memory = peak_mb()
    print(f"study in {seconds:.1f} s, processor time {cpu_seconds:.1f} s (bound 60 s)")
    print(f"peak memory {memory:.0f} MB (bound 1500 MB)")
    begin = time.perf_counter()
    size = len(render_study(result).encode()) / 1e6
    print(f"report of {size:.1f} MB in {time.perf_counter() - begin:.1f} s (bound 10 MB)")
    return 0 if cpu_seconds < 60 and memory < 1500 and size < 10 else 1


if __name__ == "__main__":
    sys.exit(main())
