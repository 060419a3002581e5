"""Audit rendered rivers: the water line's error over its sd, and the check of a model by the scene.

Run: python -m benchmarks.river [--scenes 56] [--days 100] [--first 100]
Bounds: pooled error/sd 0.9 to 1.1, with control points in the frame and, unless movement was
flagged, in the first frame only; thermal drift at least 10 times smaller with the model; movement
reported for every knock and in no other scene; at most 2 % false alarms. --days: days with a
correct model, and as many with models that lack an effect.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from tests.analysis.test_gauge import SD_RATE, START
from tests.analysis.test_river import KINDS, Outcome, play
from tests.analysis.test_scene import HOURS, LACKING, WARMTH, Bank, camera, drawn
from thermocald.analysis.thermal.scene import SceneCourse, follow_scene
from thermocald.store.logger.temperatures import TemperatureLog


def day(folder: Path, seed: int, lacks: str = "") -> SceneCourse:
    """Follow thirteen frames of a day from 10 to 35 °C and back; the model lacks an effect.

    Rates, readings, light and mount vary as their stated uncertainties.
    """
    bank, known = Bank(seed), camera()
    rng = bank.rng
    rates = {n: r + rng.normal(0, SD_RATE) for n, r in known.model.rates.items()}
    true = replace(known, model=replace(known.model, rates=rates, effects=LACKING[lacks]))
    times = START + 3600 * HOURS
    states = true.along(times, {"housing": WARMTH}, times[::12])
    bank.cold = states[0]
    frames = []
    for k, time in enumerate(times[::12]):
        path = folder / f"{seed}-{k}.png"
        turn = rng.normal(0, 2e-4, 3) if k else np.zeros(3)
        cv2.imwrite(str(path), bank.frame(states[k], turn, rng.uniform(0.8, 1.1)))
        frames.append((path, time))
    log = TemperatureLog(times, {"housing": WARMTH + rng.normal(0, 0.05, len(WARMTH))})
    course = follow_scene(known, log, frames)
    for path, _ in frames:
        path.unlink()
    return course


def rms(values: list[float]) -> float:
    found = np.array(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else float("nan")


def water_lines(count: int, first: int, folder: Path) -> bool:
    scenes = [play(first + k, KINDS[k % len(KINDS)], folder) for k in range(count)]
    columns = (
        "scene", "n", "status of the last frame", "error/sd, own pose", "error/sd, first pose",
        "drift without model mm", "with model mm", "moved", "flagged",
    )  # fmt: skip
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")

    def row(name: str, mine: list[Outcome]) -> tuple[float, float, float]:
        posed = rms([(s.chi2 / 6) ** 0.5 for s in mine])
        still = rms([(s.chi2_first / 6) ** 0.5 for s in mine if not s.flagged])
        before, after = rms([s.before for s in mine]), rms([s.after for s in mine])
        last = [s.statuses[-1] for s in mine]
        words = ", ".join(f"{last.count(w)} {w}" for w in sorted(set(last)))
        moved, flagged = (sum(getattr(s, n) for s in mine) for n in ("moved", "flagged"))
        figures = f"{posed:.2f} | {still:.2f} | {before:.1f} | {after:.2f} | {moved} | {flagged}"
        print(f"| {name} | {len(mine)} | {words} | {figures} |", flush=True)
        return posed, still, before / after

    for kind in KINDS:
        row(kind, [s for s in scenes if s.kind == kind])
    posed, still, ratio = row("all", scenes)
    right = all(s.moved == (s.kind == "knocked") for s in scenes)
    return 0.9 <= posed <= 1.1 and 0.9 <= still <= 1.1 and ratio >= 10 and right


def checks(count: int, first: int, folder: Path) -> bool:
    print("\n| the model lacks | days | reported |\n|---|---|---|")
    found = {}
    for i, lacks in enumerate(LACKING):
        days = count if not lacks else count // (len(LACKING) - 1)
        seeds = range(first + 1000 * i, first + 1000 * i + days)
        found[lacks] = sum(day(folder, seed, lacks).model_misses for seed in seeds)
        print(f"| {lacks or 'nothing'} | {days} | {found[lacks]} |", flush=True)
    return found[""] <= max(1, 0.02 * count)


def powers(draws: int) -> None:
    """Print how often an effect is found, by its largest change of c over a frame's sd."""
    sizes = (1.0, 2.0, 4.0, 8.0, 16.0)
    print(f"\n| share found of {draws} days, by effect / noise | {' | '.join(map(str, sizes))} |")
    print("|---" * (len(sizes) + 1) + "|")
    for lacks in filter(None, LACKING):
        rng, found = np.random.default_rng(1), []
        for size in sizes:
            count = sum(drawn(rng, lacks, size).model_misses for _ in range(draws))
            found.append(f"{count / draws:.2f}")
        print(f"| {lacks} | {' | '.join(found)} |", flush=True)
    rng = np.random.default_rng(2)
    false = sum(drawn(rng, "", 0.0).model_misses for _ in range(10 * draws))
    print(f"false alarms: {false} of {10 * draws}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=56)
    parser.add_argument("--days", type=int, default=100)
    parser.add_argument("--first", type=int, default=100)
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        passed = water_lines(a.scenes, a.first, Path(folder))
        passed &= checks(a.days, a.first, Path(folder))
    powers(200)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
