"""Score the formulas proposed for influences outside the catalogue.

    python -m tests.blind.outside_score [--first 0] [--seeds 1] [--kind tanh …] [--px 0.3] [--check]

Runs `discover_series`, the function of the command, in memory. With --check, the exit status is 1
if fewer than 60 % of the recorded influences have a description that closes 80 % of the gap on M2,
or if an unrecorded one has a description.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests.blind.case import OUTSIDE, Case
from tests.blind.generator import Unseen
from tests.blind.outcome import excess_closed
from tests.blind.outside import HUMID, RECORDED, UNRECORDED
from tests.blind.score import discover_case

DESCRIBED = 0.6
"""Least share of recorded influences with a transferable description."""


@dataclass
class Described:
    """A described influence: statement, whether by formula or name, and share of the gap on M2."""

    kind: str
    seed: int
    statement: str
    proposed: bool
    named: bool
    closed: float
    seconds: float

    @property
    def transferable(self) -> bool:
        """Whether a formula, or names of the catalogue, hold on M2."""
        return (self.proposed or self.named) and self.closed >= 0.8


def describe(kind: str, seed: int, px: float = 0.3) -> Described:
    """Hide one influence, run discovery, and return its description."""
    case = Case((OUTSIDE,), px, seed, influence=kind, record_humidity=kind in HUMID)
    found, _, seconds = discover_case(case)
    first = found.effects[0] if found.effects else None
    proposed = first is not None and first.effect == "unnamed" and first.term is not None
    return Described(
        kind, seed, first.statement if proposed else found.headline, proposed,
        found.verdict == "effects_found", excess_closed(found) or 0.0, seconds,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--px", type=float, default=0.3)
    parser.add_argument("--kind", action="append")
    parser.add_argument("--check", action="store_true")
    a = parser.parse_args()
    done = []
    for kind in a.kind or (*RECORDED, *HUMID, *UNRECORDED):
        for seed in range(a.first, a.first + a.seeds):
            try:
                d = describe(kind, seed, a.px)
            except Unseen as why:
                print(f"{kind:18s} {seed} {why}")
                continue
            done.append(d)
            print(f"{kind:18s} {seed} closed {d.closed:6.3f} {d.seconds:4.1f} s  "
                  f"{d.statement[:150]}", flush=True)  # fmt: skip
    recorded = [d for d in done if d.kind not in UNRECORDED]
    if recorded:
        print(f"recorded: {sum(d.proposed and d.transferable for d in recorded)} formulas and "
              f"{sum(d.named and d.transferable for d in recorded)} names of the catalogue close "
              f"80 % of the gap on M2, of {len(recorded)} cases")  # fmt: skip
    left = [d for d in done if d.kind in UNRECORDED]
    if left:
        print(f"unrecorded: {sum(d.proposed for d in left)} formulas and "
              f"{sum(d.named for d in left)} names of the catalogue, of {len(left)}")  # fmt: skip
    few = sum(d.transferable for d in recorded) < DESCRIBED * len(recorded)
    if a.check and (few or any(d.proposed or d.named for d in left)):
        raise SystemExit("the goal is missed")


if __name__ == "__main__":
    main()
