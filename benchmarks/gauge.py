"""Measure the daemon at a gauge: processor time of a tick with twelve control points, and memory.

Run: python -m benchmarks.gauge [--ticks 200] [--size 3280]     (exit status 1 if a bound is missed)
A tick decodes an 8 MP grey JPEG, matches twelve crosses, predicts the camera, and computes the
resection. The goal is 1.2 times the processor time of a tracked frame, with adjustment, of a test
field of about 150 targets in a JPEG of similar size. Without decoding (some camera drivers give
grey values) a cross costs more than a target: it is searched anew in each frame, and its patch may
rotate and stretch. Memory is that of `thermocald run` with the service's settings, twelve crosses,
a store and a log: at most 90 MB resident between two frames, the median of two seconds after 200
ticks; an 8 MP frame takes 10 MB more for the 40 ms of its measurement.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
import yaml

from tests.analysis.test_gauge import START, TAU, World, thermal_camera
from tests.main_paths.crooked import SIZE, project
from tests.photogrammetry.exact_rendering import noisy
from tests.photogrammetry.fields import PI_CAMERA, PI_SENSOR, corner_field, draw, station
from tests.store.small import write_recording
from thermocald.analysis.thermal.gauge import plan_gauge
from thermocald.epoch import Epoch
from thermocald.photogrammetry.epoch.adjustment import adjust
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.targets.image_file import EncodedImage
from thermocald.store.recording.head import CameraSpec, Channel, Head

GOAL = 1.2
# Runs on two machines gave 1.14 to 1.21 for JPEGs; for grey values see above
TICK_BOUND = {True: 1.25, False: 4.0}  # JPEG, grey values
MEMORY_BOUND_MB = 90.0
ROUNDS = 30
PERIOD_S = 0.25
CROSSES = 12


def render(world: World, T: float, width: int, rng: np.random.Generator) -> bytes:
    """Render a JPEG of river banks with a white cross on a dark board at each control point."""
    scale = width / SIZE[0]
    height = round(SIZE[1] * scale)
    fine = cv2.GaussianBlur(rng.normal(0, 1, (height, width)).astype(np.float32), (0, 0), 5)
    image = 110 + 8 * fine / fine.std()
    at = (project(world.points, world.pose, **world.interior(T)) + 0.5) * scale - 0.5
    for x, y in at:
        for (across, down), grey in (((30, 30), 40.0), ((25, 6), 225.0), ((6, 25), 225.0)):
            box = np.array([[-across, -down], [across, -down], [across, down], [-across, down]])
            place = np.round((box * max(scale, 0.4) + [x, y]) * 256).astype(np.int32)
            cv2.fillConvexPoly(image, place, grey, cv2.LINE_AA, 8)
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 0.8, image.shape)
    grey8 = np.clip(np.round(image), 0, 255).astype(np.uint8)
    return simplejpeg.encode_jpeg(grey8[..., None], 85, "GRAY")


class Site:
    """A folder with a thermal model, clicked control points, a few frames, and a recording."""

    def __init__(self, folder: Path, width: int, ticks: int) -> None:
        self.folder, rng = folder, np.random.default_rng(12)
        self.world = world = World(5, CROSSES)
        self.thermal = thermal_camera(TAU).for_images(width, round(SIZE[1] * width / SIZE[0]))
        self.thermal.save(folder / "camera.thermal.yaml")
        self.warmth = np.full(4, 20.0)
        self.frames = []
        for k, T in enumerate(self.warmth):
            path = folder / f"{k}.jpg"
            path.write_bytes(render(world, float(T), width, rng))
            self.frames.append(path)
        scale = width / SIZE[0]
        clicks = project(world.points, world.pose, **world.interior(20.0))
        clicks = np.round((clicks + 0.5) * scale - 0.5)
        with (folder / "gcp.csv").open("w", newline="") as out:
            rows = csv.writer(out)
            rows.writerow(["target", "X", "Y", "Z", "sX", "sY", "sZ", "x", "y", "sx", "sy"])
            for name, X, uv in zip(world.field.names, world.field.points, clicks, strict=True):
                rows.writerow([name, *X, 8, 8, 8, *uv, 1, 1])
        spec = CameraSpec("gauge", self.thermal.model.sensor, 3.04)
        head = Head("gauge", "M1", PERIOD_S, spec, {"temperature": Channel(0.01)})
        write_recording(folder / "recording", head, world.field, self.epochs(ticks))

    def epochs(self, count: int):
        for k in range(count):
            i = k % len(self.frames)
            time_s = START + PERIOD_S * k
            yield Epoch(k + 1, time_s, time_s, {"temperature": float(self.warmth[i])},
                        self.frames[i])  # fmt: skip

    def calibrator(self):
        points = self.folder / "gcp.csv"
        return plan_gauge(self.thermal, points, "mm", self.frames[0], None, 0.001)[0]

    def configuration(self) -> Path:
        folder = self.folder
        replay = {"driver": "replay", "recording": str(folder / "recording"), "loop": True,
                  "period_s": PERIOD_S}  # fmt: skip
        camera = {
            "name": "gauge", "thermal_model": str(folder / "camera.thermal.yaml"),
            "control_points": str(folder / "gcp.csv"), "control_unit": "mm",
            "control_reference": str(self.frames[0]), "thermometers": ["box"], **replay,
        }  # fmt: skip
        document = {
            "store": {"path": str(folder / "gauge.db")}, "frames": {"keep": "none"},
            "cameras": [camera], "thermometers": [{"name": "box", **replay}],
            "outputs": [{"name": "log", "driver": "jsonl", "path": str(folder / "log.jsonl")}],
        }  # fmt: skip
        path = folder / "config.yaml"
        path.write_text(yaml.safe_dump(document))
        return path


def tick_is_cheap(site: Site) -> bool:
    """Return whether a tick's least processor time is within its bound of a tracked frame's."""
    cv2.setNumThreads(1)
    field, normals = corner_field()
    clean, rng = draw(field, normals).render(PI_CAMERA, station()), np.random.default_rng(3)
    fields = [simplejpeg.encode_jpeg(noisy(clean, rng)[..., None], 85, "GRAY") for _ in range(4)]
    banks = [path.read_bytes() for path in site.frames]
    passed = True
    for encoded in (True, False):
        tracker = Tracker(field, CameraSpec("", PI_SENSOR, 3.04))
        o = tracker.measure(EncodedImage(fields[0])).orientation
        assert o is not None
        camera, exterior = o.camera.interior, o.exterior
        gauge, epochs = site.calibrator(), list(site.epochs(ROUNDS))
        images = [[EncodedImage(f) if encoded else EncodedImage(f).whole() for f in files]
                  for files in (fields, banks)]  # fmt: skip
        tracked, tick = np.inf, np.inf
        for k in range(ROUNDS):
            begin = time.thread_time()
            seen = tracker.measure(images[0][k % 4]).observations
            adjusted = adjust(PI_SENSOR, field, seen, camera, exterior)
            between = time.thread_time()
            assert adjusted.interior is not None
            assert adjusted.exterior is not None
            camera, exterior = adjusted.interior, adjusted.exterior
            again = time.thread_time()
            done = gauge.calibrate(epochs[k], images[1][k % 4]).adjustment
            end = time.thread_time()
            assert done.status == "resected", done.reason
            assert done.n_observations == CROSSES, done.n_observations
            if k:
                tracked, tick = min(tracked, between - begin), min(tick, end - again)
        what = "grey values"
        if encoded:
            what = f"JPEGs of {len(fields[0]) / 1e6:.2f} and {len(banks[0]) / 1e6:.2f} MB"
        print(
            f"{what}: tracked frame of {len(seen)} targets {1e3 * tracked:.1f} ms, tick with "
            f"{CROSSES} control points {1e3 * tick:.1f} ms, ratio {tick / tracked:.2f} "
            f"(goal {GOAL}, bound {TICK_BOUND[encoded]})",
            flush=True,
        )
        passed &= tick <= TICK_BOUND[encoded] * tracked
    return passed


def memory(site: Site, ticks: int) -> dict[str, float]:
    """Return a daemon's memory after `ticks` ticks, MB: resident, its peak, proportional share."""
    log = site.folder / "log.jsonl"
    environment = {**os.environ, "MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "131072",
                   "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # fmt: skip
    command = [sys.executable, "-m", "thermocald", "run", "--config", str(site.configuration())]
    with (site.folder / "log.txt").open("wb") as out:
        daemon = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
    try:
        deadline = time.monotonic() + 120 + 4 * ticks * PERIOD_S
        while not log.exists() or log.read_bytes().count(b"\n") < ticks:
            if daemon.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError((site.folder / "log.txt").read_text())
            time.sleep(0.2)
        resident = []
        for _ in range(100):
            time.sleep(0.02)
            status = Path(f"/proc/{daemon.pid}/status").read_text()
            resident.append(int(status.split("VmRSS:")[1].split()[0]) / 1024)
        found = {}
        for name in ("status", "smaps_rollup"):
            for line in Path(f"/proc/{daemon.pid}/{name}").read_text().splitlines():
                key, _, value = line.partition(":")
                if key in ("VmHWM", "Pss"):
                    found[key] = int(value.split()[0]) / 1024
        found["VmRSS"] = float(np.median(resident))
        words = {line.split('"status": "')[1].split('"')[0] for line in log.read_text().splitlines()
                 if '"status": "' in line}  # fmt: skip
    finally:
        daemon.terminate()
        daemon.wait(30)
    print(f"after {ticks} ticks ({', '.join(sorted(words))}): resident {found['VmRSS']:.1f} MB "
          f"(bound {MEMORY_BOUND_MB:g}), peak {found['VmHWM']:.1f} MB, "
          f"proportional share {found['Pss']:.1f} MB")  # fmt: skip
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=200)
    parser.add_argument("--size", type=int, default=SIZE[0], help="width of the frames, px")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        site = Site(Path(folder), a.size, a.ticks)
        passed = tick_is_cheap(site)
        held = memory(site, a.ticks)
    return int(not passed or held["VmRSS"] > MEMORY_BOUND_MB)


if __name__ == "__main__":
    sys.exit(main())
