"""The golden cases: a user's commands, in the order of their dependencies.

They run in one folder, which contains `data` if the reference data are present. Commands that
depend on the machine or on a running daemon are not here (`EXCUSED` names their tests).
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass

from tests.golden.compare import Bounds

ARITHMETIC = Bounds(1e-9, 1e-6, 1e-7)
"""Sums, and solutions in closed form or at convergence."""
ESTIMATE = Bounds(1e-5, 1e-3, 1e-4)
"""Results of a search, whose last step is smaller than this but not zero."""
REAL = Bounds(3e-6, 1e-5, 1e-2)
"""Weakly determined results: another kind of processor changes an sd by 4e-3, the packages of
Debian 13 a probability and sigma0 by 4e-7.
"""
REAL_ESTIMATE = Bounds(1e-4, 1e-3, 2e-3)
"""A search on real corners: the packages of Debian 13 change scores by 2e-5."""


@dataclass(frozen=True)
class Case:
    """One command line; writes: files that it writes; after: cases that it needs."""

    name: str
    line: str
    writes: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    tolerance: Bounds = ARITHMETIC

    @property
    def words(self) -> list[str]:
        return shlex.split(self.line)

    @property
    def needs_data(self) -> bool:
        return "data/" in self.line or self.name.startswith("real-")


RPI = ("simulate-M1", "simulate-M2")
CASES = (
    Case("list", "simulate --list"),
    Case("simulate-M1", "simulate --preset rpi-v2.1-heating --seed 1 --out M1",
         ("M1/epochs.csv", "M1/observations.csv", "M1/testfield.csv")),
    Case("simulate-M2", "simulate --preset rpi-v2.1-heating --seed 2 --series M2 --out M2"
         " --json M2.json",
         ("M2.json",)),
    Case("simulate-lag", "simulate --preset nexus5-cold --seed 3 --out N1 --effect lag.yaml"
         " --model-out N1.yaml", ("N1.yaml",)),
    Case("check", "check M1 --json check.json", ("check.json",), RPI),
    Case("replay", "replay M1 --json replay.json", ("replay.json",), RPI),
    Case("replay-per-epoch", "replay N1 --exterior per_epoch --free c,x0,y0", (),
         ("simulate-lag",)),
    Case("export", "export M1 -o M1.csv", ("M1.csv",), RPI),
    Case("store", "replay N1 --store N1.db", (), ("simulate-lag",)),
    Case("export-store", "export N1.db -o N1.csv", ("N1.csv",), ("store",)),
    Case("status", "status --store N1.db", (), ("store",)),  # no daemon runs
    Case("backup", "backup N1.db copy.db", (), ("store",)),
    Case("archive", "archive N1.db --to archived --json -", (), ("store",)),
    Case("convert", "convert archived/nexus5-M1 --to parquet --keep", (), ("archive",)),
    Case("study", "study M1 M2 --json study.json --sets 2000", ("study.json",), RPI, ESTIMATE),
    Case("fit", "fit M1 M2 -o camera.yaml --effect thermal_lag --json fit.json --code camera",
         ("camera.yaml", "fit.json", "camera.py"), RPI, ESTIMATE),
    Case("predict", "predict --model camera.yaml --temperature 35 --json predict.json",
         ("predict.json",), ("fit",), ESTIMATE),
    Case("predict-log", "predict --model camera.yaml --log M2/epochs.csv --json along.json",
         ("along.json",), ("fit",), ESTIMATE),
    Case("predict-test", "predict --model camera.yaml --test M2 --json tested.json",
         ("tested.json",), ("fit",), ESTIMATE),
    Case("predict-programme", "predict --model camera.yaml --programme programme.yaml"
         " --extrapolate", (), ("fit",), ESTIMATE),
    Case("predict-far", "predict --model camera.yaml --temperature 95", (), ("fit",)),
    Case("correct", "correct points.csv --model camera.yaml --log M1/epochs.csv --out as25.csv"
         " --to 25 --json correct.json", ("as25.csv", "correct.json"), ("fit",), ESTIMATE),
    Case("discover", "discover M1 --verify M2 --json discover.json --model-out found.yaml"
         " --effect-out effect.yaml", ("discover.json", "found.yaml", "effect.yaml"), RPI,
         ESTIMATE),
    Case("discover-lag", "discover lag/M1 --verify lag/M2 --json lag.json --effect-out"
         " lag-effect.yaml --model-out lag-model.yaml",
         ("lag.json", "lag-model.yaml", "lag-effect.yaml"), (), ESTIMATE),
    Case("blind-time-offset", "discover time_offset/M1 --verify time_offset/M2 --json b1.json",
         ("b1.json",), (), ESTIMATE),
    Case("blind-pair", "discover pair/M1 --verify pair/M2 --json b2.json", ("b2.json",), (),
         ESTIMATE),
    Case("real-lag", "discover real/M1 --verify real/M2 --json real.json", ("real.json",), (),
         REAL_ESTIMATE),
    Case("camera-convert", "camera convert pi.json --to opencv -o cv.yaml", ("cv.yaml",)),
    Case("camera-ros", "camera convert cv.yaml --to ros -o ros.yaml", ("ros.yaml",),
         ("camera-convert",)),
    Case("testfield-print", "testfield print --paper A4 --out sheets --json print.json",
         ("print.json", "sheets/testfield.csv")),
    Case("testfield-check", "testfield check M1/testfield.csv --from 900 950 700 --at 10 20 30"
         " --json field.json", ("field.json",), RPI),
    Case("testfield-import", "testfield import --chessboard 9x6 --square 25 -o board.csv",
         ("board.csv",)),
    Case("import", "import photos --log log.csv --testfield M1/testfield.csv --out imported"
         " --timezone Europe/Berlin --pixel-pitch 0.01 --json import.json",
         ("import.json", "imported/epochs.csv", "imported/recording.yaml"), RPI),
    Case("reprocess", "reprocess archived --out again", (), ("archive",)),
    Case("missing", "replay nowhere"),
    Case("wrong-option", "study M1 --window 30", (), RPI),
    Case("data-replay", "replay data/aviary-cam6 --json cam6.json", ("cam6.json",), (), REAL),
    Case("data-export", "export data/aviary-cam2 --exterior series -o cam2.csv", ("cam2.csv",), (),
         REAL),
    Case("data-calibrate", "calibrate data/frc --testfield walls.csv --camera lifecam.yaml"
         " --json walls.json", ("walls.json",), (), REAL),
)  # fmt: skip

EXCUSED = {
    "demo": "simulate, replay and discover on a clock of its own: tests/cli/test_commands.py",
    "devices": "what is plugged in: tests/cli/test_devices.py",
    "doctor": "the machine: tests/packaging",
    "run": "a daemon: tests/daemon; what it writes is `replay`'s",
    "dashboard": "a daemon: tests/output/test_dashboard.py",
    "top": "a terminal: tests/cli/test_status.py",
    "session": "a daemon: tests/daemon/test_sessions.py",
    "server": "PostgreSQL: tests/store",
    "fleet": "PostgreSQL: tests/fleet",
    "forward": "PostgreSQL: tests/fleet",
    "measure": "against the truth: tests/cli/test_measure.py",
}
