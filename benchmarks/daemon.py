"""Measure the daemon's punctuality and the cost of an epoch.

Run: python -m benchmarks.daemon [--ticks 600] [--epochs 40]

Punctuality: absolute deadlines beside a plain `sleep` loop, with ticks of 50 ms, both idle and
beside two busy threads; then a day of 10 s ticks in virtual time. Cost: the CPU time of one 8 MP
epoch from frame to store, against a tenth of a 10 s period on a machine ten times slower.

On a machine that is busy with other programs, run it at the service's priority: nice -n -10.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from thermocald.acquisition.device_loop import Schedule
from thermocald.acquisition.pipeline import AcquiredEpoch
from thermocald.acquisition.thermometers import pair_readings
from thermocald.analysis.online.observer import OnlineObserver
from thermocald.epoch import Epoch
from thermocald.hal import SystemClock, VirtualClock, open_device
from thermocald.photogrammetry.targets.image_file import decode_grey

PERIOD_S = 0.05


def percentile(values: list[float], p: float) -> float:
    return float(np.percentile(values, p))


def load(stop: threading.Event) -> None:
    """Work like the calibrating and storing threads: array operations, and Python between them."""
    rng = np.random.default_rng(0)
    a, image = rng.normal(size=(300, 16)), rng.integers(0, 255, (600, 800)).astype(np.uint8)
    while not stop.is_set():
        np.linalg.inv(a.T @ a)
        cv2.GaussianBlur(image, (5, 5), 1.0)
        sum(i * i for i in range(2000))


def scheduled(ticks: int, work_s: float) -> tuple[list[float], float, int]:
    """Return (lateness s, drift s, skipped ticks) of the daemon's schedule."""
    schedule = Schedule(SystemClock(), PERIOD_S, time.monotonic())
    late, last = [], None
    for _ in range(ticks):
        last = schedule.wait()
        assert last is not None
        late.append(time.monotonic() - schedule.due(last))
        time.sleep(work_s)
    assert last is not None
    drift = schedule.due(last) - (schedule.begin + last * PERIOD_S)
    return late, drift, int(schedule.stats()["skipped"])


def sleeping(ticks: int, work_s: float) -> tuple[list[float], float, int]:
    """Return the same for `while True: work(); sleep(period)`, late against the ideal instants."""
    begin = time.monotonic()
    late = []
    for k in range(ticks):
        late.append(time.monotonic() - (begin + k * PERIOD_S))
        time.sleep(work_s)
        time.sleep(PERIOD_S)
    return late, late[-1], 0


def rhythm(ticks: int) -> None:
    sys.setswitchinterval(0.0005)  # as the daemon does
    print(f"punctuality: {ticks} ticks of {PERIOD_S * 1000:.0f} ms, 10 ms of work each")
    print(f"{'':28}{'late p50':>10}{'p99':>10}{'max':>10}{'drift':>12}{'skipped':>9}")
    for loaded in (False, True):
        stop = threading.Event()
        threads = [threading.Thread(target=load, args=(stop,)) for _ in range(2 * loaded)]
        for thread in threads:
            thread.start()
        for name, loop in (("schedule", scheduled), ("sleep loop", sleeping)):
            late, drift, skipped = loop(ticks, 0.010)
            what = f"{name}, {'2 busy threads' if loaded else 'idle'}"
            figures = [statistics.median(late), percentile(late, 99), max(late)]
            row = "".join(f"{1e3 * value:8.2f}ms" for value in figures)
            print(f"{what:28}{row}{1e3 * drift:10.2f}ms{skipped:9d}")
        stop.set()
        for thread in threads:
            thread.join()


def virtual_day() -> None:
    clock = VirtualClock()
    schedule = Schedule(clock, 10.0, clock.monotonic())
    rng = np.random.default_rng(1)
    late = []
    for _ in range(8640):
        tick = schedule.wait()
        assert tick is not None
        late.append(clock.monotonic() - schedule.due(tick))
        clock.sleep_until(clock.monotonic() + float(rng.uniform(0.0, 9.0)))
    print(
        f"virtual day: 8640 ticks of 10 s, up to 9 s of work each: at most {max(late):g} s late, "
        f"drift {schedule.due(tick) - 8639 * 10.0:g} s, {schedule.stats()['skipped']} skipped"
    )


def epoch_cost(epochs: int) -> None:
    """Measure the steps from an 8 MP frame to the store, on one thread."""
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.plan import mock_config, plan_cameras, running_series
    from thermocald.daemon.series_run import Runtime, SeriesRun
    from thermocald.daemon.store_guard import StoreGuard

    clock = VirtualClock()
    config = mock_config()
    with tempfile.TemporaryDirectory() as folder:
        plan = replace(plan_cameras(config, clock)[0], series="bench")
        thermometer = open_device("thermometer", "mock", {"seed": 2}, clock)
        guard = StoreGuard(Path(folder) / "t.db", durable=True)
        runtime = Runtime(guard, SteadyClock(clock), LiveState(Path(folder)))
        thermometers, frames = Thermometers(config, clock), FrameFolder(config.frames)
        run = SeriesRun(plan, runtime, thermometers, frames, [], dict)
        assert plan.sensor is not None
        assert plan.testfield is not None
        observer = OnlineObserver(plan.sensor, plan.testfield, lambda *_: None)
        calibrator, running = plan.calibrator, running_series(plan)
        assert calibrator is not None
        assert running is not None
        steps = ("decode a JPEG", "measure + adjust", "online filter", "running series", "store")
        spent: dict[str, list[float]] = {name: [] for name in steps}
        skew = []
        with plan.camera, thermometer:
            for k in range(epochs):
                clock.sleep_until(10.0 * k)
                frame = plan.camera.capture()
                readings = {"temperature": thermometer.read()}
                utc, temperatures, _ = pair_readings(readings, frame.monotonic)
                epoch = Epoch(k + 1, frame.utc, utc, temperatures)
                jpeg = cv2.imencode(".jpg", frame.image)[1].tobytes()
                z = time.thread_time()
                decode_grey(
                    jpeg
                )  # only a phone's frame is a JPEG; the mock camera gives grey values
                a = time.thread_time()
                calibrated = calibrator.calibrate(epoch, frame.image)
                b = time.thread_time()
                observer.observe(calibrated)
                c = time.thread_time()
                seen = calibrated.epoch.observations
                assert seen is not None
                calibrated = replace(calibrated, adjustment=running.refine(calibrated, seen)[0])
                e = time.thread_time()
                item = AcquiredEpoch(k + 1, frame, True, calibrated.epoch)
                item.calibrated = calibrated
                run.keep(item)
                d = time.thread_time()
                skew.append(epoch.temperature_time - epoch.frame_time)
                if k:  # the whole first frame is searched
                    parts = (a - z, b - a, c - b, e - c, d - e)
                    for name, seconds in zip(spent, parts, strict=True):
                        spent[name].append(seconds)
        guard.close()
    total = sum(statistics.median(s) for s in spent.values())
    least = sum(min(s) for s in spent.values())
    print(f"CPU time of an 8 MP epoch, {len(plan.testfield)} targets, {epochs - 1} epochs:")
    print(f"  {'':20}{'median':>11}{'least':>11}")
    for name, seconds in spent.items():
        print(f"  {name:20}{1e3 * statistics.median(seconds):8.1f} ms{1e3 * min(seconds):8.1f} ms")
    print(
        f"  total: median {1e3 * total:.1f} ms, least {1e3 * least:.1f} ms; on a machine ten times "
        f"slower {10 * total:.2f} s = {100 * total:.1f} % of a 10 s period (bound 10 %), at least "
        f"{100 * least:.1f} %"
    )
    print(f"  temperature time minus frame time: median {1e3 * statistics.median(skew):.0f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=600)
    parser.add_argument("--epochs", type=int, default=40)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rhythm(arguments.ticks)
    virtual_day()
    epoch_cost(arguments.epochs)


if __name__ == "__main__":
    main()
