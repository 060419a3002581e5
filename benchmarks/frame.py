"""Measure the time from an 8 MP grey JPEG in memory to parameters, in multiples of its decoding.

Run: python -m benchmarks.frame        (exit status 1 if a bound is missed)
All on one thread. A tracked epoch is decoding, about 150 centres, and the adjustment with
covariance; a last line gives the shares of the three. Nine tenths of decoding a JPEG is reading its
bits in order. The goal of 1.10 would leave the centres a third
of the time that fetching their weights and grey values from cold memory takes. "From nothing" has
no prior but the sensor and the lens's nominal principal distance. OpenCV's routes give no
covariance of the parameters and do not identify targets.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg
from thermocald_drivers import support

from tests.photogrammetry.exact_rendering import noisy
from tests.photogrammetry.fields import PI_CAMERA, PI_SENSOR, corner_field, draw, station
from thermocald.photogrammetry.camera.camera_model import CameraSpec
from thermocald.photogrammetry.epoch.adjustment import Adjustment, adjust
from thermocald.photogrammetry.frame.measurement import measure
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.targets.image_file import EncodedImage

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

ROUNDS = 40
QUALITY = 90
GOALS = {
    "tracked epoch": 1.1,
    "tracked epoch, luminance plane (YU12) of a camera": 0.4,
    "from nothing": 3.0,
}
# For a missed goal: the bound instead, above the scatter of runs on two machines with different
# caches (1.15 to 1.39, 1.10 to 1.31, 3.35 to 4.24; on one machine 6 % of it), and the reason
MISSED = {
    "tracked epoch": (1.45, "nearly all bits have to be read"),
    "from nothing": (4.5, "a third of it is the fits of the discs, 110,000 pixels"),
}


class TimedImage(EncodedImage):
    """An encoded image that sums the time to decode it, s."""

    seconds = 0.0

    def whole(self) -> NDArray[Any]:
        """Decode like `EncodedImage.whole`."""
        begin = time.thread_time()
        grey = super().whole()
        self.seconds += time.thread_time() - begin
        return grey


def main() -> int:
    cv2.setNumThreads(1)
    field, normals = corner_field()
    exterior = station()
    clean = draw(field, normals).render(PI_CAMERA, exterior)
    rng = np.random.default_rng(3)
    frames = [
        simplejpeg.encode_jpeg(noisy(clean, rng)[..., None], QUALITY, "GRAY") for _ in range(4)
    ]
    truth = PI_CAMERA.project(exterior, field.points)
    seen = PI_SENSOR.contains(truth, 30)
    buffer = np.empty((PI_SENSOR.height, PI_SENSOR.width, 1), dtype=np.uint8)
    turn = [0]

    def decode() -> np.ndarray:
        turn[0] = (turn[0] + 1) % len(frames)
        simplejpeg.decode_jpeg(frames[turn[0]], "GRAY", buffer=buffer)
        return buffer[..., 0]

    stages = dict.fromkeys(("decoding", "grey values, centres", "adjustment"), np.inf)

    def tracked_epoch(
        images: Callable[[int], np.ndarray | EncodedImage], staged: bool = False
    ) -> Callable[[], object]:
        """Return a call that calibrates the next frame; with `staged` it times the three stages."""
        tracker = Tracker(field, CameraSpec("", PI_SENSOR, 3.04))
        start = tracker.measure(images(0))
        assert start.orientation is not None
        o = start.orientation
        last = adjust(PI_SENSOR, field, start.observations, o.camera.interior, o.exterior)
        number = 0

        def run() -> Adjustment:
            nonlocal last, number
            number = (number + 1) % len(frames)
            image, begin = images(number), time.thread_time()
            measured = tracker.measure(image)
            found = time.thread_time()
            assert not measured.searched, measured.searched
            # As in a series, the last epoch gives the initial values of the next
            assert last.interior is not None
            assert last.exterior is not None
            last = adjust(PI_SENSOR, field, measured.observations, last.interior, last.exterior)
            assert last.ok, last.reason
            if staged and isinstance(image, TimedImage):
                taken = (image.seconds, found - begin - image.seconds, time.thread_time() - found)
                for name, seconds in zip(stages, taken, strict=True):
                    stages[name] = min(stages[name], seconds)
            return last

        return run

    grey = [simplejpeg.decode_jpeg(frame, "GRAY")[..., 0] for frame in frames]
    chroma = np.full(grey[0].size // 2, 128, np.uint8)
    planar = [memoryview(np.concatenate([image.ravel(), chroma])) for image in grey]

    def luminance(number: int) -> np.ndarray:
        return support.decode(planar[number], "YU12", PI_SENSOR.width, PI_SENSOR.height)[0]

    def encoded(files: list[bytes]) -> Callable[[int], EncodedImage]:
        return lambda number: TimedImage(files[number])

    def from_nothing() -> Adjustment:
        measured = measure(decode(), field, CameraSpec("", PI_SENSOR, 3.04))
        o = measured.orientation
        assert o is not None
        result = adjust(PI_SENSOR, field, measured.observations, o.camera.interior, o.exterior)
        assert result.ok, result.reason
        return result

    def calibrate(points: np.ndarray) -> float:
        distance = np.linalg.norm(points[:, None] - truth[None, seen], axis=2)
        nearest, which = distance.min(axis=1), np.nonzero(seen)[0][distance.argmin(axis=1)]
        ok = nearest < 2
        K = np.array([[2700.0, 0, 1640], [0, 2700, 1232], [0, 0, 1]])
        rms, *_ = cv2.calibrateCameraExtended(
            [field.points[which[ok]].astype(np.float32)], [points[ok].astype(np.float32)],
            (PI_SENSOR.width, PI_SENSOR.height), K, np.zeros(5),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        )  # fmt: skip
        return float(rms)

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(dictionary)
    parameters = cv2.SimpleBlobDetector_Params()
    parameters.minArea, parameters.maxArea = 100, 5000
    blobs = cv2.SimpleBlobDetector_create(parameters)

    def markers_and_blobs() -> float:
        image = decode()
        detector.detectMarkers(image)
        return calibrate(np.array([k.pt for k in blobs.detect(image)]))

    def threshold_and_ellipses() -> float:
        _, mask = cv2.threshold(decode(), 115, 255, cv2.THRESH_BINARY_INV)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        fits = [cv2.fitEllipse(c)[0] for c in contours if len(c) > 15]
        return calibrate(np.array(fits))

    routes: list[tuple[str, Callable[[], object], int]] = [
        ("decode", decode, 1),
        ("tracked epoch", tracked_epoch(encoded(frames), staged=True), 1),
        ("tracked epoch, luminance plane (YU12) of a camera", tracked_epoch(luminance), 1),
        ("from nothing", from_nothing, 1),
        ("decode + threshold + fitEllipse + calibrateCameraExtended", threshold_and_ellipses, 2),
        ("decode + detectMarkers + SimpleBlobDetector + calibrateCameraExtended",
         markers_and_blobs, 10),
    ]  # fmt: skip
    # They take turns, so that all meet the same disturbances; the least processor time counts
    times = {name: np.inf for name, _, _ in routes}
    for k in range(ROUNDS):
        for name, work, every in routes:
            if k % every == 0:
                begin = time.thread_time()
                work()
                times[name] = min(times[name], time.thread_time() - begin)
    unit = times["decode"]
    print(
        f"{int(seen.sum())} targets, 8 MP JPEG of quality {QUALITY}, {len(frames[0]) / 1e6:.2f} MB"
    )
    print(f"{'':72s}{'ms':>8s}{'× decode':>10s}{'goal':>8s}{'bound':>8s}")
    failed = False
    for name, seconds in times.items():
        line = f"{name:72s}{seconds * 1e3:8.1f}{seconds / unit:10.2f}"
        if name in GOALS:
            bound, why = MISSED.get(name, (GOALS[name], ""))
            failed |= seconds > bound * unit
            line += f"{GOALS[name]:8.2f}{bound:8.2f}"
            if seconds > GOALS[name] * unit:
                line += f"  {why}" if seconds <= bound * unit else "  MISSED"
        print(line)
    print(
        "tracked epoch, × decode: "
        + ", ".join(f"{name} {seconds / unit:.2f}" for name, seconds in stages.items())
    )
    result = from_nothing()
    assert result.interior is not None
    error = (result.values - np.r_[PI_CAMERA.interior.as_array(), exterior.as_array()])[:3]
    print(
        f"from nothing: sigma0 {result.sigma0:.2f}, errors of c, x0, y0 "
        f"{', '.join(f'{e / s:+.1f} sd' for e, s in zip(error, result.sd[:3], strict=True))}; "
        f"RMS with OpenCV {threshold_and_ellipses():.3f} px (fitEllipse), "
        f"{markers_and_blobs():.3f} px (blobs)"
    )
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
