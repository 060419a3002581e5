"""A hostile week, at random: kills, flipped bits, clock leaps, deletions.

Every epoch that was reported as stored is in the store as reported, or `check` names it, the gap in
its series, or the file as damaged. THERMOCALD_CHAOS_ROUNDS=300 runs the full test.
"""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from thermocald.errors import ThermocaldError
from thermocald.store.database.store import Store

pytestmark = pytest.mark.slow

ROUNDS = int(os.environ.get("THERMOCALD_CHAOS_ROUNDS", "40"))
SEED = int(os.environ.get("THERMOCALD_CHAOS_SEED", "1"))


class Chaos:
    """The daemons of a folder, the attacks on them, and the comparison of their stores."""

    def __init__(self, daemon, offset: Path) -> None:
        self.daemon = daemon
        self.folder = daemon.folder
        self.results = daemon.folder / "results.jsonl"
        self.results.touch()
        self.offset = offset

    def progress(self) -> None:
        """Wait for a new result."""
        size = self.results.stat().st_size
        self.daemon.until(lambda: self.results.stat().st_size > size)

    def told(self) -> dict[int, tuple[float, float]]:
        """Return {epoch: (c, frame_time)} of the epochs reported as stored."""
        return {r["epoch"]: (r["c"], r["frame_time"]) for r in self.daemon.results() if r["stored"]}

    def compare(self, path: Path) -> tuple[int, bool]:
        """Return (reported epochs that a store lacks or changed, whether `check` names them)."""
        told = self.told()
        try:
            with Store.open(path) as store:
                found = store.examine()
                series = store.find_series()
                kept = {
                    s.epoch.number: (s.result.values[0], s.epoch.frame_time)
                    for s in store.epochs(series)
                }
        except ThermocaldError:
            return len(told), True
        wrong = []
        for number, (c, frame_time) in told.items():
            found_c, found_time = kept.get(number, (None, None))
            # a deferred calibration may have been added since
            if found_time != frame_time or (c is not None and found_c != c):
                wrong.append(number)
        # only the last write can have been cut off
        unfinished = found.unfinished and wrong == [max(told)]
        return len(wrong), bool(found.damaged or found.gaps or unfinished)

    def flip(self, rng: np.random.Generator, scratch: Path) -> None:
        """Flip bits in a copy of a killed daemon's store, and compare it."""
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        names = [p for p in self.folder.glob("thermocald.db*") if p.is_file()]
        for name in names:
            if not name.name.endswith("-shm"):
                shutil.copy(name, scratch / name.name)
        before = self.compare(scratch / "thermocald.db")
        assert not before[0], f"{before} before any bit was flipped"
        (scratch / "thermocald.db-shm").unlink(missing_ok=True)
        victims = [p for p in scratch.iterdir() if p.stat().st_size]
        victim = victims[int(rng.integers(len(victims)))]
        data = bytearray(victim.read_bytes())
        for _ in range(int(rng.integers(1, 4))):
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        victim.write_bytes(data)
        wrong, named = self.compare(scratch / "thermocald.db")
        assert not wrong or named, f"{wrong} epochs are not right, and nothing says so: {victim}"


@pytest.fixture
def chaos(daemon, recording, replayed, preloaded, tmp_path):
    offset = tmp_path / "offset"
    offset.write_text("0".ljust(12))
    daemon.forker = preloaded
    daemon.configure(**replayed(recording))
    return Chaos(daemon, offset)


@pytest.mark.timeout(7200)
def test_what_was_reported_as_stored_is_there_and_right_or_named(chaos, tmp_path):
    rng = np.random.default_rng(SEED)
    for number in range(ROUNDS):
        chaos.daemon.start(CLOCK_OFFSET_FILE=str(chaos.offset))
        chaos.progress()
        if rng.random() < 0.3:
            leap = int(rng.choice([120 * 86400, -3600, 7200, -86400]))
            chaos.offset.write_text(str(leap).ljust(12))
            time.sleep(rng.uniform(0.1, 0.6))
            chaos.offset.write_text("0".ljust(12))
        if rng.random() < 0.3:
            files = sorted(p for p in chaos.folder.glob("thermocald.db*") if p.is_file())
            chosen = files if rng.random() < 0.5 else [files[int(rng.integers(len(files)))]]
            for path in chosen:
                path.unlink(missing_ok=True)
            chaos.progress()  # writes what the process holds
            chaos.progress()
        time.sleep(rng.uniform(0.0, 0.25))
        chaos.daemon.kill()
        if rng.random() < 0.5:
            chaos.flip(rng, tmp_path / "scratch")
        if number % 10 == 9 or number == ROUNDS - 1:
            wrong, _ = chaos.compare(chaos.daemon.store)
            assert wrong == 0
    assert "Traceback" not in chaos.daemon.log()
