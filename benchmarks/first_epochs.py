"""The first epochs of the shipped configuration: python -m benchmarks.first_epochs [--starts 200]

Each start is config.yaml's mock camera with another seed, its frames rendered and measured, as the
daemon would take them. Of every epoch, pooled over the starts: the median sigma0, errors of c, x0
and y0 over their standard deviations, and how many targets were rejected, none of which is wrong.
Exit status 1 where a bound is broken: sigma0 0.85 to 1.15, errors 0.9 to 1.1 times what is stated
(or what so few starts allow), one target in 1,000.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermocald.acquisition.pipeline import calibrate_frame
from thermocald.config import load_config
from thermocald.daemon.plan import plan_cameras, running_series
from thermocald.epoch import Epoch
from thermocald.hal import VirtualClock, open_device


def start(seed: int, epochs: int) -> np.ndarray:
    """Rows (epochs, 6): sigma0, three normed errors, rejected, offered."""
    clock = VirtualClock()
    config = load_config(Path(__file__).parents[1] / "config.yaml")
    camera = config.cameras[0]
    options = {**camera.options, "seed": seed}
    one = replace(
        plan_cameras(config, clock)[0], camera=open_device("camera", camera.driver, options, clock)
    )
    running = running_series(one)
    assert running is not None
    assert one.calibrator is not None
    thermometer = open_device("thermometer", "mock", {"seed": seed}, clock)
    rows = []
    with one.camera, thermometer:
        for number in range(1, epochs + 1):
            begin = clock.monotonic()
            frame, reading = one.camera.capture(), thermometer.read()
            epoch = Epoch(number, frame.utc, reading.utc, dict(reading.values))
            calibrated = calibrate_frame(one.calibrator, epoch, frame)
            seen = calibrated.epoch.observations
            assert seen is not None
            result, _ = running.refine(calibrated, seen)
            truth = one.camera.truth(frame.monotonic).iop[0, :3]  # type: ignore[attr-defined]
            errors = (result.values[:3] - truth) / result.sd[:3]
            rows.append([result.sigma0, *errors, len(result.rejected), result.n_observations])
            clock.sleep_until(begin + camera.period_s)
    return np.array(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1000)
    given = parser.parse_args()
    every = np.array([start(given.seed + k, given.epochs) for k in range(given.starts)])
    sigma0 = np.median(every[..., 0], axis=0)
    errors = np.sqrt(np.mean(every[..., 1:4] ** 2, axis=0))
    rejected = every[..., 4].sum(axis=0) / every[..., 5].sum(axis=0)
    for k in range(given.epochs):
        print(
            f"epoch {k + 1:3}: sigma0 {sigma0[k]:.3f}, errors of c, x0, y0 "
            + ", ".join(f"{e:.2f}" for e in errors[k])
            + f" of their sd, {1e3 * rejected[k]:.2f} of 1,000 rejected"
        )
    spread = max(0.1, 3.0 / np.sqrt(2 * given.starts))
    whole = every[..., 4].sum() / every[..., 5].sum()
    pooled = np.sqrt(np.mean(every[..., 1:4] ** 2, axis=(0, 1)))
    print("all: errors", ", ".join(f"{e:.3f}" for e in pooled), f"; {1e3 * whole:.2f} of 1,000")
    holds = (np.abs(sigma0 - 1) <= 0.15).all() and (np.abs(errors - 1) <= spread).all()
    return int(not (holds and whole <= 1e-3))


if __name__ == "__main__":
    sys.exit(main())
