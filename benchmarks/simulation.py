"""Measure the simulation's speed: a rendered frame, a day of observations, the effects.

Run: python -m benchmarks.simulation   (exit status 1 if a bound is missed)
Bounds: an 8 MP frame of 147 targets (blur, noise, vignetting) ≤ 4 × OpenCV's JPEG encoder at its
default quality (95) on the same frame; simplejpeg at its default quality (85, which discards the
noise) is printed too. 8,640 epochs × 147 targets ≤ 10 s, including the CSV recording.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import simplejpeg

from thermocald.physics import catalogue
from thermocald.physics.heat import Course
from thermocald.physics.history import History
from thermocald.physics.presets import preset_simulation
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import demonstration_field, demonstration_model

if TYPE_CHECKING:
    from collections.abc import Callable

FRAME_BOUND = 4.0
DAY_BOUND_S = 10.0


def best(run: Callable[[], object], rounds: int = 15) -> float:
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


def frames() -> bool:
    passed = True
    for kind in ("plain", "circles", "markers"):
        field = demonstration_field(kind)
        model = demonstration_model(field)
        iop, eop = model.interior.as_array(), model.exterior.as_array()
        scene = Scene(model.sensor, field)
        image = scene.render(iop, eop)
        pixels = np.ascontiguousarray(image[:, :, None])
        rendered = best(partial(scene.render, iop, eop))
        encoded = best(partial(cv2.imencode, ".jpg", image))
        simple = best(partial(simplejpeg.encode_jpeg, pixels, colorspace="GRAY"))
        print(
            f"frame of {len(field)} targets ({kind}): {rendered * 1e3:.0f} ms = "
            f"{rendered / encoded:.2f} × cv2.imencode = {rendered / simple:.2f} × simplejpeg"
        )
        if kind == "plain":
            passed = rendered / encoded <= FRAME_BOUND
    return passed


def day() -> bool:
    s = preset_simulation("rpi-v2.1-heating")
    programme = replace(s.programme, epochs=8640, sources={"housing": Course.constant(4.0)})
    s = replace(s, programme=programme)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        s.write(Path(folder) / "day")
        took = time.perf_counter() - begin
    print(f"a day of 10 s epochs, {len(s.field)} targets, written in {took:.1f} s")
    return took <= DAY_BOUND_S


def courses() -> None:
    print("ms per effect: time course and sensitivity matrix of 180 epochs, then of 8,640 epochs")
    for name in catalogue.names():
        effect = catalogue.get(name)
        if effect.kind == "image":
            continue  # it has no time course
        values = {k: p.default for k, p in effect.nonlinear.items() if not p.text}
        values.pop("phase", None)
        row = []
        for epochs in (180, 8640):
            t = np.arange(epochs) * 10.0
            T = 25 + np.sin(t / 500)
            history = History(t, t + 0.3, {"a": T, "b": T}, "a", 25.0)
            course = effect.drive if effect.is_drive else effect.signal
            row.append(best(partial(course, history, **values), 5) * 1e3)
            row.append(best(partial(effect.sensitivity, history, **values), 3) * 1e3)
        print(f"  {name:<24}{row[0]:8.3f}{row[1]:8.3f}{row[2]:8.2f}{row[3]:8.2f}")


def main() -> int:
    cv2.setNumThreads(1)
    passed = [frames(), day()]
    courses()
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
