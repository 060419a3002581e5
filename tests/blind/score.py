"""Score the discovery on blind recordings: confusion matrix, parameters, gap, power.

    python -m tests.blind.score [--seeds 5] [--part single-0.3 …] [--store FILE]
        [--write FILE.md]

Runs `discover_series`, the function of the command, in memory.
"""

from __future__ import annotations

import argparse
import os
import pickle
import time
from collections.abc import Iterable, Iterator
from itertools import combinations
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tests.blind.bridge import generated
from tests.blind.case import OUTSIDE, SINGLE, Case
from tests.blind.outcome import Outcome, compare
from tests.blind.tables import row, write
from thermocald.discovery.result import Discovery, discover_series
from thermocald.thermal.reduce import reduce_together

NUMBERS = {
    "thermal_lag": ("tau",), "time_offset": ("d",), "hysteresis": ("half_width",),
    "softening": ("T_k",), "self_heating": ("tau",), "cyclic_interference": ("P",),
    "slip": ("time",), "target_displacement": ("time",),
}  # fmt: skip


def discover_case(case: Case) -> tuple[Discovery, dict, float]:
    """Run discovery on a case; return its result, the truth, and processor time, s."""
    inputs, truth = generated(case)
    begin = time.process_time()
    discovery = discover_series(reduce_together(inputs))
    return discovery, truth, time.process_time() - begin


def judge(case: Case) -> Outcome:
    """Run and score one case."""
    return judge_discovery(case, *discover_case(case))


def judge_discovery(case: Case, discovery: Discovery, truth: dict, seconds: float) -> Outcome:
    """Compare the discovery with the hidden effects."""
    outside = case.effects == (OUTSIDE,)
    out = compare(case, discovery, seconds, (("unnamed",),) if outside else ())
    if out.right and case.effects and not outside:
        out.pulls = dict(_pulls(discovery, truth))
    else:
        out.gap_closed = None
    return out


def _pulls(discovery: Discovery, truth: dict) -> Iterator[tuple[str, float]]:
    """Yield (name, (estimate - truth) / sd) of every parameter of the truth."""
    by_name = {e["effect"]: e for e in truth["effects"][0]}
    for effect in discovery.effects:
        true = by_name.get(effect.effect, {})
        for key, estimate in effect.estimates.items():
            if key in true and isinstance(estimate["value"], float):
                value, estimated = float(true[key]), estimate["value"]
                if effect.effect == "cyclic_interference" and key != "P":
                    # a sine is the same with the opposite sign and phase + π
                    turned = np.cos(effect.estimates["phase"]["value"] - float(true["phase"])) < 0
                    if key == "phase":
                        estimated += np.pi * turned
                        value = estimated - (estimated - value + np.pi) % (2 * np.pi) + np.pi
                    elif turned:
                        estimated = -estimated
                yield f"{effect.effect}.{key}", (estimated - value) / estimate["sd"]


def cases(part: str, seeds: Iterable[int]) -> Iterator[Case]:
    kind, _, px = part.partition("-")
    strength = float(px) if px else 0.3
    for seed in seeds:
        if kind in ("single", "hard"):
            yield from (Case((e,), strength, seed, hard=kind == "hard") for e in SINGLE)
        elif kind == "pair":
            rng = np.random.default_rng(seed)
            every = list(combinations(SINGLE, 2))
            for i in rng.permutation(len(every))[:19]:
                yield Case(every[i], strength, seed * 1000 + int(i))
        elif kind == "outside":
            yield from (Case((OUTSIDE,), strength, seed * 10 + k) for k in range(10))
        elif kind in NONE:
            yield from (Case((), 0.3, seed * 20 + k, **NONE[kind]) for k in range(20))
        else:
            raise SystemExit(f"no such part: {part}")


PARTS = (
    "single-0.3", "single-0.1", "single-0.05", "single-0.03", "single-0.02", "single-0.01",
    "pair-0.3", "hard-0.3", "outside-0.3", "none", "none2", "nonehard",
)  # fmt: skip


NONE: dict[str, dict] = {"none": {}, "none2": {"thermometer_k": 0.08}, "nonehard": {"hard": True}}
# more recordings without an effect, to show that fewer than one in a hundred has a name
MORE_SEEDS = {"none": 5, "none2": 5}


def run(
    part: str, seeds: Iterable[int], show: bool = False, store: Path | None = None
) -> list[Outcome]:
    """Score all cases of a part, but for those whose outcomes the file `store` holds."""
    done = pickle.loads(store.read_bytes()) if store and store.exists() else {}
    outcomes = []
    for case in cases(part, seeds):
        if case not in done:
            done[case] = judge(case)
            if store:
                store.write_bytes(pickle.dumps(done))
            if show:
                _show(part, done[case])
        outcomes.append(done[case])
    return outcomes


def _show(part: str, o: Outcome) -> None:
    """Print an outcome in which something is wrong."""
    far = {name: f"{pull:.1f} sd" for name, pull in o.pulls.items() if abs(pull) > 3}
    if far or not o.right or (o.gap_closed or 1.0) < 0.9:
        print(
            f"  {part} seed {o.case.seed} {o.case.effects}: {o.found} ({o.verdict}), listed "
            f"{o.listed}, {far}, gap closed {o.gap_closed}, left {o.misfit_px:.4f} px", flush=True,
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--part", action="append")
    parser.add_argument("--store", type=Path, help="outcomes; an interrupted run is resumed")
    parser.add_argument("--write", type=Path)
    a = parser.parse_args()
    found: dict[str, list[Outcome]] = {}
    for part in a.part or PARTS:
        seeds = range(a.first, a.first + a.seeds * MORE_SEEDS.get(part, 1))
        found[part] = run(part, seeds, show=True, store=a.store)
        print(row(part, found[part]), flush=True)
    if a.write:
        write(a.write, found)


if __name__ == "__main__":
    main()
