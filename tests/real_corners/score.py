"""Score the discovery of effects hidden in real corners.

    python -m tests.real_corners.score --first 500 --seeds 2 [--part nine] [--camera aviary-cam1]
        [--check]

Runs `discover_series`, the function of the command, in memory. Parts: `nine`, the nine effects of
the goal; `others`; `none`, no effect, with 25 recordings per camera and seed. With --check, the
exit status is 1 if a part misses its goal (`GOALS`).
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable, Iterator
from itertools import product

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tests.blind.generator import Series
from tests.blind.outcome import Outcome, compare
from tests.real_corners.generator import CAMERAS, NINE, OTHERS, SHARED, RealCase, generate
from thermocald.discovery.result import Discovery, discover_series
from thermocald.numbers import percent
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.reduce import reduce_together
from thermocald.thermal.series import SeriesInput
from thermocald.thermal.source import series_input

NONE_PER_SEED = 25
GOALS = {"nine": 0.9, "others": 0.9, "none": 1.0}
"""Least share of cases with exact or listed names, or without an effect, with no name."""
GAP_CLOSED = 0.8
"""Least share of the excess on M2 over the camera's noise that correct names explain."""


def input_of(series: Series, source: str) -> SeriesInput:
    """Return the series as the program reads it, without files."""
    recorded = series_input(read_recording(SHARED / source))
    grid = recorded.grid
    weights = np.zeros((len(series.times), len(recorded.field), 3))
    weights[..., :2] = np.isfinite(series.points[..., :1]) / series.sigma**2
    return SeriesInput(
        series.name, series.camera, recorded.sensor, recorded.field, recorded.principal_distance,
        series.times, series.reading_times, series.temperatures, dict.fromkeys(series.temperatures),
        type(grid)(np.round(series.points, 4), weights), series.numbers,
    )  # fmt: skip


def discover_case(case: RealCase) -> tuple[Discovery, dict, float]:
    """Run discovery on a case; return its result, the truth, and processor time, s."""
    series, truth = generate(case)
    inputs = [input_of(s, case.camera) for s in series]
    begin = time.process_time()
    found = discover_series(reduce_together(inputs))
    return found, truth, time.process_time() - begin


def judge(case: RealCase) -> Outcome:
    """Run and score one case."""
    return judge_discovery(case, *discover_case(case))


def judge_discovery(case: RealCase, discovery: Discovery, truth: dict, seconds: float) -> Outcome:
    """Compare the discovery with the hidden effects."""
    # real movements may be found, but not named
    return compare(case, discovery, seconds, () if case.effects else ((), ("unnamed",)))


def cases(part: str, seeds: Iterable[int], cameras: Iterable[str] = CAMERAS) -> Iterator[RealCase]:
    """Yield the cases of a part."""
    hidden = {"nine": NINE, "others": OTHERS}.get(part)
    for camera, seed in product(cameras, seeds):
        if hidden:
            yield from (RealCase(camera, (effect,), seed) for effect in hidden)
        else:
            none = range(seed * NONE_PER_SEED, (seed + 1) * NONE_PER_SEED)
            yield from (RealCase(camera, (), k) for k in none)


def missed(part: str, done: list[Outcome]) -> list[str]:
    """Return a sentence for each missed goal of a part."""
    named = float(np.mean([o.right_or_listed for o in done]))
    out, goal = [], GOALS[part]
    if named < goal:
        out.append(f"{part}: {percent(named)} named exactly or listed; the goal is {percent(goal)}")
    gaps = [o.gap_closed for o in done if o.right and o.case.effects and o.gap_closed is not None]
    open_ = sum(g < GAP_CLOSED for g in gaps)
    if open_ > 0.1 * len(gaps):
        out.append(
            f"{part}: {open_} of {len(gaps)} close less than {percent(GAP_CLOSED)} of the gap"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--part", action="append")
    parser.add_argument("--camera", action="append")
    parser.add_argument("--check", action="store_true")
    a = parser.parse_args()
    failed: list[str] = []
    for part in a.part or ("nine", "none"):
        done = []
        for case in cases(part, range(a.first, a.first + a.seeds), a.camera or CAMERAS):
            done.append(judge(case))
            print(done[-1], flush=True)
        right, listed = (sum(getattr(o, k) for o in done) for k in ("right", "right_or_listed"))
        print(f"{part}: exact {right} of {len(done)}, exact or listed {listed}")
        failed += missed(part, done)
    if a.check and failed:
        raise SystemExit("\n".join(failed))


if __name__ == "__main__":
    main()
