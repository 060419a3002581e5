"""Measure the errors of M2's image points as predicted by a model of M1, per catalogue effect.

Run: python -m benchmarks.prediction [--seeds 3] [--first 100] [--px 0.3] [--discover]
Uses blind recordings (tests/blind) and the commands `fit` and `predict --test`. The noise floor is
the generator's noise. Bounds, over all cases: RMS ≤ 1.1 × floor, coverage of the stated 95 % bands
93 to 97 %. --discover fits the effects that `discover` finds in M1 instead of the true ones.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests.analysis.test_blind_prediction import SINGLE, pooled, predict_case


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--px", type=float, default=0.3)
    parser.add_argument("--effect", action="append")
    parser.add_argument("--discover", action="store_true")
    a = parser.parse_args()
    every = []
    print("| hidden effect | RMS on M2, px | RMS / noise floor | worst | inside 95 % bands |")
    print("|---|---|---|---|---|")
    for name in a.effect or ("none", *SINGLE):
        cases = []
        for seed in range(a.first, a.first + a.seeds):
            with tempfile.TemporaryDirectory() as folder:
                cases.append(predict_case(name, seed, Path(folder), a.px, a.discover))
        ratio, coverage = pooled(cases)
        rms = sum(rms_px for _, _, rms_px in cases) / len(cases)
        worst = max(cases)[0]
        print(f"| `{name}` | {rms:.4f} | {ratio:.3f} | {worst:.3f} | {coverage:.1%} |", flush=True)
        every += cases
    ratio, coverage = pooled(every)
    print(f"| all | | {ratio:.3f} | {max(every)[0]:.3f} | {coverage:.1%} |")
    passed = ratio <= 1.1 and 0.93 <= coverage <= 0.97
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
