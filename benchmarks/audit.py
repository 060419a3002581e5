"""Compare every printed standard deviation with the scatter of its quantity, and every level.

Run: python -m benchmarks.audit [SECTION …] [--draws N] [--seed S] [--page FILE]
Prints the rows whose range docs/reference/standard-deviations.md shows: error over stated standard
deviation (root mean square over the draws; 1 if the statement is true) or the share of false
alarms. Exit status 1 if a ratio is outside 0.9 to 1.1, or above its level, by more than three of
its own sds; rows that are known to be cautious have a lower bound of their own. --page rewrites
the tables of that page.
No images are rendered. A new seed is drawn for each run and printed; the same seed prints the same
rows.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks import audit_camera, audit_field, audit_null, audit_study, audit_thermal
from benchmarks.audit_rows import HEADER, Row, ratio, share, table

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["HEADER", "SECTIONS", "main", "ratio", "share", "table", "with_rows"]

SECTIONS: dict[str, Callable[[int, np.random.Generator], list[Row]]] = {
    "epoch": audit_camera.epoch,
    "series": audit_camera.series,
    "mount": audit_camera.mount,
    "calibrate": audit_camera.calibrate,
    "noise": audit_camera.noise,
    "cameras": audit_camera.cameras,
    "survey": audit_field.survey,
    "online": audit_camera.online,
    "significance": audit_study.significance,
    "null": audit_null.null,
    "named": audit_null.named,
    "thermal": audit_thermal.thermal,
    "lenses": audit_thermal.other_cameras,
    "distortion": audit_thermal.distortion,
    "delay": audit_thermal.delay,
    "thermometer": audit_thermal.thermometer,
    "outside": audit_thermal.outside,
    "discovery": audit_thermal.discovery,
}


def with_rows(page: str, section: str, rows: list[Row]) -> str:
    """Return the page with the rows of one section replaced."""
    old = rf"(^\| {section} \|.*\n)+"
    return re.sub(old, lambda _: table(section, rows) + "\n", page, flags=re.M)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, help="default: a new one; the page has seed 1")
    parser.add_argument("--page", type=Path, help="a page whose tables are rewritten")
    given = parser.parse_args()
    unknown = set(given.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"{min(unknown)}: not a section; choose from {', '.join(SECTIONS)}")
    seed = given.seed or int(np.random.SeedSequence().generate_state(1)[0])
    missed = 0
    for name in given.sections or SECTIONS:
        begin = time.process_time()
        rows = SECTIONS[name](given.draws, np.random.default_rng(seed))
        for row in rows:
            print(row.text(seed) + ("" if row.met else "  <- outside"), flush=True)
            missed += not row.met
        if given.page is not None:
            page = given.page.read_text(encoding="utf-8")
            given.page.write_text(with_rows(page, name, rows), encoding="utf-8")
        print(f"{name}: {time.process_time() - begin:.0f} s of processor time", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
