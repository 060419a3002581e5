"""Audit the first epochs of config.yaml: python -m benchmarks.first_epochs [--starts 200]

Each start is config.yaml's mock camera with another seed. The frames of the first starts are
rendered and measured as in the daemon. Later starts draw their corners: true positions, plus the
errors that each marker's corners had in one of the rendered frames. For each epoch number, pooled
over the starts, it prints the median sigma0, the errors of c, x0 and y0 over their standard
deviations, and the share of rejected targets, all of which are good. Exit status 1 if a bound is
missed: sigma0 0.85 to 1.15, errors 0.9 to 1.1 standard deviations (more for few starts), one
rejected target in 1,000.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermocald.acquisition.pipeline import calibrate_frame
from thermocald.config import load_config
from thermocald.daemon.plan import plan_cameras, running_series
from thermocald.epoch import Epoch
from thermocald.hal import VirtualClock, open_device
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations


def corners(camera: Any, frame: Any) -> np.ndarray:
    """Return the true corners of a frame, (T, 2) px."""
    truth = camera.truth(frame.monotonic)
    return project(camera.scene.sensor, truth.iop[0], truth.eop[0], camera.field.points)


@dataclass(eq=False)
class Pool:
    """Corner errors (F, T, 2) px of rendered frames, NaN if not seen, and their sds (T, 2) px."""

    errors: np.ndarray
    sigmas: np.ndarray

    def observations(self, true: np.ndarray, groups: np.ndarray, seed: list[int]) -> Observations:
        """Draw a frame's corners; each marker has the errors it had in one rendered frame."""
        of = np.random.default_rng(seed).integers(0, len(self.errors), groups.max() + 1)[groups]
        points = true + self.errors[of, np.arange(len(true))]
        seen = np.flatnonzero(np.isfinite(points).all(axis=1))
        return Observations(seen, points[seen], self.sigmas[seen])


def start(seed: int, epochs: int, pool: Pool | None) -> tuple[np.ndarray, Pool]:
    """Run one start; return rows (epochs, 6) and the corners' errors.

    A row is sigma0, the errors of c, x0, y0 over their sds, targets rejected and targets offered.
    """
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
    assert one.testfield is not None
    mock: Any = one.camera
    if pool is not None:
        mock._picture = lambda _: np.zeros((1, 1), np.uint8)  # not measured
    thermometer = open_device("thermometer", "mock", {"seed": seed}, clock)
    rows, errors = [], np.full((epochs, len(one.testfield), 2), np.nan)
    sigmas = np.full((len(one.testfield), 2), np.nan)
    with one.camera, thermometer:
        for number in range(1, epochs + 1):
            begin = clock.monotonic()
            frame, reading = mock.capture(), thermometer.read()
            epoch = Epoch(number, frame.utc, reading.utc, dict(reading.values))
            true = corners(mock, frame)
            if pool is not None:
                seen = pool.observations(true, one.testfield.groups, [seed, number])
                calibrated = one.calibrator.calibrate(replace(epoch, observations=seen))
            else:
                calibrated = calibrate_frame(one.calibrator, epoch, frame)
            drawn = calibrated.epoch.observations
            assert drawn is not None
            errors[number - 1, drawn.targets] = drawn.points - true[drawn.targets]
            sigmas[drawn.targets] = drawn.sigmas
            result, _ = running.refine(calibrated, drawn)
            truth = mock.truth(frame.monotonic).iop[0, :3]
            normed = (result.values[:3] - truth) / result.sd[:3]
            rows.append([result.sigma0, *normed, len(result.rejected), result.n_observations])
            clock.sleep_until(begin + camera.period_s)
    return np.array(rows), Pool(errors, sigmas)


def report(every: np.ndarray) -> bool:
    """Print the statistics of the starts (S, E, 6); return whether the bounds hold."""
    starts, epochs = every.shape[:2]
    sigma0 = np.median(every[..., 0], axis=0)
    errors = np.sqrt(np.mean(every[..., 1:4] ** 2, axis=0))
    rejected = every[..., 4].sum(axis=0) / every[..., 5].sum(axis=0)
    for k in range(epochs):
        print(
            f"epoch {k + 1:3}: sigma0 {sigma0[k]:.3f}; errors of c, x0, y0 "
            + ", ".join(f"{e:.2f}" for e in errors[k])
            + f" sd; {1e3 * rejected[k]:.2f} of 1,000 targets rejected"
        )
    spread = max(0.1, 3.0 / np.sqrt(2 * starts))
    whole = every[..., 4].sum() / every[..., 5].sum()
    pooled = np.sqrt(np.mean(every[..., 1:4] ** 2, axis=(0, 1)))
    pooled_text = ", ".join(f"{e:.3f}" for e in pooled)
    print(f"all: errors {pooled_text} sd; {1e3 * whole:.2f} of 1,000 targets rejected")
    holds = (np.abs(sigma0 - 1) <= 0.15).all() and (np.abs(errors - 1) <= spread).all()
    return bool(holds and whole <= 1e-3)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--rendered", type=int, default=10, help="starts that are rendered")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="begin no start after this time"
    )
    given = parser.parse_args()
    until = time.monotonic() + 60.0 * given.minutes
    every: list[np.ndarray] = []
    pools: list[Pool] = []
    while len(every) < given.starts and (time.monotonic() < until or not every):
        known = None
        if len(every) >= max(given.rendered, 1):
            errors, sigmas = ([getattr(p, part) for p in pools] for part in ("errors", "sigmas"))
            known = Pool(np.concatenate(errors), np.fmin.reduce(sigmas))
        found, pool = start(given.seed + len(every), given.epochs, known)
        every.append(found)
        if known is None:
            pools.append(pool)
    print(f"{len(every)} starts, {len(pools)} of them rendered")
    return int(not report(np.array(every)))


if __name__ == "__main__":
    sys.exit(main())
