"""Measure the public interface: a camera from a fresh interpreter, and live correction of frames.

Run: python -m benchmarks.front_door   (exit status 1 if a bound is missed)
Bounds: from a fresh interpreter to a camera at 35 °C ≤ 3.5 × `import numpy`, each in its own
process (0.35 s beside 0.1 s); `import thermocald` ≤ 30 ms more than Python's start; update and
correct of 1640 × 1232 frames ≤ 1.15 × cv2.remap alone, at 10 Hz through a warm-up of 25 minutes,
including renewals of the maps. Times are processor times.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

import thermocald as tc

FRESH, IMPORT_S, LIVE = 3.5, 0.030, 1.15
SIZE = (1640, 1232)
_RUNS = 7
_FRAMES = 600  # every 25th of 15,000


def spent(program: str, *words: str) -> float:
    """Return the processor time, s, of a program in a fresh interpreter."""
    before = os.times()
    subprocess.run([sys.executable, "-c", program, *words], check=True)
    after = os.times()
    children = after.children_user - before.children_user
    return children + after.children_system - before.children_system


def fresh(model: Path) -> tuple[float, float, float, float]:
    """Return median times, s: Python itself, NumPy, thermocald, a camera at 35 °C."""
    camera = "import sys, thermocald as tc; tc.load_camera(sys.argv[1]).at(35.0).sd"
    programs = ("pass", "import numpy", "import thermocald", camera)
    times = [[spent(p, str(model)) for p in programs] for _ in range(_RUNS)]
    bare, numpy, ours, found = (statistics.median(column) for column in zip(*times, strict=True))
    return bare, numpy, ours, found


def live(model: Path) -> tuple[float, float, int]:
    """Return times per frame, s, of update and correct and of cv2.remap; and renewals of the maps.

    The time of all renewals in the warm-up is spread over its frames.
    """
    cv2.setNumThreads(1)
    camera = tc.load_camera(model).live(SIZE)
    frame = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    duration, hertz = 1500.0, 10.0
    ours, alone, renewing, renewed = [], [], [], 0
    last = None
    for k in range(int(duration * hertz)):
        t = k / hertz
        T = 25.0 + 24.5 * (1.0 - np.exp(-t / 400.0))
        begin = time.thread_time()
        camera.update(t, T)
        updated = time.thread_time() - begin
        maps = camera.maps()
        new = maps is not last
        if new:
            renewed += 1
            renewing.append(time.thread_time() - begin - updated)
            last = maps
        if k % 25:
            continue
        begin = time.thread_time()
        camera.correct(frame)
        ours.append(updated + time.thread_time() - begin)
        begin = time.thread_time()
        cv2.remap(frame, *maps, cv2.INTER_LINEAR)
        alone.append(time.thread_time() - begin)
    spread = sum(renewing) / (duration * hertz)
    return float(np.mean(ours)) + spread, float(np.mean(alone)), renewed


def main() -> None:
    missed = []
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "camera.yaml"
        series = [tc.simulate("rpi-v2.1-heating", seed=k) for k in (1, 2)]
        tc.fit(*series, effects=["thermal_lag"]).save(model)
        bare, numpy, ours, camera = fresh(model)
        print(
            f"fresh interpreter: numpy {numpy:.3f} s, thermocald {ours - bare:.3f} s over Python "
            f"(bound {IMPORT_S}), camera at 35 °C {camera:.3f} s = {camera / numpy:.2f} × numpy "
            f"(bound {FRESH})"
        )
        if camera / numpy > FRESH:
            missed.append("camera")
        if ours - bare > IMPORT_S:
            missed.append("import")
        both, alone, renewed = live(model)
        print(
            f"live: update and correct {1e3 * both:.2f} ms, cv2.remap {1e3 * alone:.2f} ms at "
            f"{SIZE[0]} × {SIZE[1]}: {both / alone:.3f} (bound {LIVE}); {renewed} map renewals"
        )
        if both / alone > LIVE:
            missed.append("live")
    if missed:
        raise SystemExit(f"MISSED: {', '.join(missed)}")


if __name__ == "__main__":
    main()
