"""Measure the processor time and memory of commands for series of 10³ to 3 × 10⁶ epochs.

Run: python -m benchmarks.scale [--full] [--commands replay,fit] [--epochs 1000,10000]
Recordings are drawn as Parquet (`long_recording`); the dashboard's store is filled with columns.
Each command runs in its own process. Prints processor time, peak resident memory, and the exponent
of growth over the last decade, from which start-up (the time of the shortest series) is subtracted.
Bounds: exponent ≤ 1.05, 2000 MB; exit status 1 if one is missed. Default: up to 10⁵ epochs.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_MB = 2000.0
MOST_EXPONENT = 1.05
NOISE_S = 3.0  # shorter times give no reliable exponent on a busy machine
SHORT = (1_000, 10_000, 100_000)
FULL = (*SHORT, 1_000_000, 3_153_600)

SERIES = """
import sys; from pathlib import Path
from thermocald.store.recording.reader import open_recording
from thermocald.photogrammetry.series.long_series import adjust_long_series
from thermocald.photogrammetry.series.result import SeriesSettings
from benchmarks.adjustment import EXTERIOR, INTERIOR
r = open_recording(Path(sys.argv[1]))
found = adjust_long_series(r.camera.sensor, r.testfield, r, INTERIOR, EXTERIOR, SeriesSettings())
assert found.rows.status.count("ok") > 0.99 * len(r)
"""
QUERY = """
import sys; from pathlib import Path
from thermocald.output.dashboard.view import View
view = View(Path(sys.argv[1]), Path(sys.argv[1]).parent)
one = view.series()[0]
found = view.columns(one["camera"], one["series"], None, None, 1000)
assert len(found["c"]) <= 1000
"""


@dataclass(frozen=True)
class Cost:
    """Processor time, s, and peak resident memory, MB."""

    seconds: float
    megabytes: float


def arguments(command: str, folder: Path, recording: Path, store: Path) -> list[str]:
    """Return the command line of a command."""
    python, tool = sys.executable, str(Path(sys.executable).with_name("thermocald"))
    return {
        "replay": [tool, "replay", str(recording)],
        "series": [python, "-c", SERIES, str(recording)],
        "study": [tool, "study", str(recording), "--json", str(folder / "study.json")],
        "fit": [tool, "fit", str(recording), "-o", str(folder / "model.yaml")],
        "discover": [tool, "discover", str(recording)],
        "export": [tool, "export", str(recording), "-o", str(folder / "export.csv")],
        "dashboard": [python, "-c", QUERY, str(store)],
    }[command]


COMMANDS = ("replay", "series", "study", "fit", "discover", "export", "dashboard")


def cost(process: list[str]) -> Cost:
    """Run a process to its end; exit if it fails."""
    with tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(process, stdout=subprocess.DEVNULL, stderr=errors)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            errors.seek(0)
            sys.exit(f"{' '.join(process)[:200]}:\n{errors.read().decode()[-2000:]}")
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def exponent(epochs: list[int], costs: list[Cost]) -> float:
    """Return the exponent between the last two lengths without start-up; NaN if times are short."""
    if len(costs) < 3 or costs[-2].seconds - costs[0].seconds < NOISE_S:
        return float("nan")
    last, before = costs[-1].seconds - costs[0].seconds, costs[-2].seconds - costs[0].seconds
    longer = (epochs[-1] - epochs[0]) / (epochs[-2] - epochs[0])
    return float(np.log(last / before) / np.log(longer))


def row(command: str, epochs: list[int], costs: list[Cost]) -> tuple[str, bool]:
    """Return a line of the table, and whether its bounds hold."""
    growth = exponent(epochs, costs)
    cells = [f"{c.seconds:.1f} s, {c.megabytes:.0f} MB" for c in costs]
    shown = "" if np.isnan(growth) else f"{growth:.2f}"
    kept = not growth > MOST_EXPONENT and max(c.megabytes for c in costs) <= MOST_MB
    return f"| {command} | {' | '.join(cells)} | {shown} |", kept


def main() -> int:
    from benchmarks.long_recording import write_long_recording
    from benchmarks.store import fill_columns

    parser = argparse.ArgumentParser()
    parser.add_argument("--full", action="store_true", help="lengths up to a year of 10 s epochs")
    parser.add_argument("--epochs", help="lengths, comma-separated")
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument("--targets", type=int, default=21)
    parser.add_argument(
        "--folder", type=Path, help="folder for recordings and stores, which stay there"
    )
    options = parser.parse_args()
    lengths = list(FULL if options.full else SHORT)
    if options.epochs:
        lengths = [int(n) for n in options.epochs.split(",")]
    kept = True
    with tempfile.TemporaryDirectory() as name:
        folder = options.folder or Path(name)
        print(f"| {options.targets} targets | {' | '.join(f'{n:,}' for n in lengths)} | exponent |")
        print("|---|" + "---|" * (len(lengths) + 1), flush=True)
        for command in options.commands.split(","):
            costs = []
            for n in lengths:
                recording, store = folder / f"{n}", folder / f"{n}.db"
                if command == "dashboard" and not store.exists():
                    fill_columns(store, n)
                elif command != "dashboard" and not recording.exists():
                    write_long_recording(recording, n, options.targets)
                costs.append(cost(arguments(command, folder, recording, store)))
            line, good = row(command, lengths, costs)
            kept &= good
            print(line, flush=True)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
