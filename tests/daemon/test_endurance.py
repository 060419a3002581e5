"""Months in minutes, and the memory of a daemon that waits."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.conftest import ENVIRONMENT, columns_of, make_recording
from tests.daemon.test_page_attacks import resident_mb
from tests.daemon.test_systemd import values

pytestmark = pytest.mark.slow


def start(daemon, *words: str, **environment: str) -> None:
    """Start Python as a process of its own: a fork would share its memory."""
    daemon.process = subprocess.Popen(
        [sys.executable, *words], cwd=daemon.folder, env={**ENVIRONMENT, **environment},
        stderr=subprocess.DEVNULL,
    )  # fmt: skip


def test_a_daemon_that_waits_keeps_to_88_mb(daemon, replayed, tmp_path):
    """With its unit's variables, between two epochs of 12 targets: 84 with replay's series."""
    (variables,) = values("thermocald.service", "Environment")
    own = dict(pair.split("=") for pair in variables.split())
    path = make_recording(tmp_path / "short", 60, per_side=2, interval=1.0)
    daemon.configure(**replayed(path, period_s=1.0))
    words = ("-m", "thermocald", "run", "--config", str(daemon.config))
    start(daemon, *words, **{**own, "HOME": str(tmp_path)})
    daemon.more(12)
    assert resident_mb(daemon.process.pid) < 88.0
    assert daemon.stop() == 0


FAST = """
from pathlib import Path
from thermocald.config import load_config
from thermocald.daemon.service import Service
Service(load_config(Path({config!r})), fast=True, epochs={epochs}, until_finished=True).run()
"""


def watched(daemon) -> np.ndarray:
    """Return epochs stored, MB resident, open files, threads, CPU seconds: a row each a second."""
    proc, seen = Path(f"/proc/{daemon.process.pid}"), []
    while daemon.process.poll() is None:
        time.sleep(1.0)
        try:
            epoch = daemon.status()["cameras"]["rpi"]["stored"]
            files, threads = (len(list((proc / what).iterdir())) for what in ("fd", "task"))
            used = sum(map(int, (proc / "stat").read_text().rpartition(")")[2].split()[11:13]))
            resident = resident_mb(daemon.process.pid)
        except (OSError, KeyError, StopIteration):  # it has not begun, or has ended
            continue
        if epoch:
            seen.append((epoch, resident, files, threads, used / os.sysconf("SC_CLK_TCK")))
    assert daemon.process.returncode == 0
    return np.array(seen).T


@pytest.mark.timeout(1800)
def test_the_last_month_of_three_costs_what_the_first_did(daemon, replayed, tmp_path):
    """Ninety days by the recording's clock, a tick every quarter of an hour, in two minutes.

    THERMOCALD_SOAK_EPOCHS=100000 takes a quarter of an hour of an idle core.
    """
    ticks = int(os.environ.get("THERMOCALD_SOAK_EPOCHS", "8640"))
    period_s = 900.0  # windows fill during the first 2,500 epochs
    day = round(86_400 / period_s)
    path = make_recording(
        tmp_path / "days", 5 * day, interval=period_s,
        temperature_of=lambda k: 25.0 + 8.0 * np.sin(2 * np.pi * k / day),
    )  # fmt: skip
    store = {"path": str(daemon.store), "durable": False}
    daemon.configure(**{**replayed(path, period_s=period_s), "outputs": []}, store=store)
    start(daemon, "-c", FAST.format(config=str(daemon.config), epochs=ticks))
    epochs, resident, files, threads, used = watched(daemon)
    cost_ms, held_mb = [], []
    for third in range(3):
        # during the first days modules are loaded and windows fill
        low, high = (ticks * (0.05 + 0.95 * (third + k) / 3) for k in (0, 1))
        part = (epochs >= low) & (epochs <= high)
        assert part.sum() >= 3
        cost_ms.append(1e3 * np.ptp(used[part]) / np.ptp(epochs[part]))
        held_mb.append(float(np.median(resident[part])))
    print(f"ms a tick in each third {np.round(cost_ms, 2)}, MB resident {np.round(held_mb, 1)}, "
          f"files {set(files.tolist())}, threads {set(threads.tolist())}")  # fmt: skip
    assert held_mb[2] - held_mb[1] < 1.5
    assert held_mb[2] - held_mb[0] < 5.0
    (most,) = values("thermocald.service", "MemoryMax")
    assert resident.max() < 0.5 * int(most.removesuffix("M"))
    warm = (epochs > 0.7 * ticks) & (epochs < 0.98 * ticks)
    assert np.ptp(files[warm]) <= 2  # status.json may be open
    assert np.ptp(threads[warm]) == 0
    assert cost_ms[2] < 1.25 * cost_ms[0]  # on a machine that may be busy; measured: 1.00 and 1.15
    times = columns_of(daemon.store, "frame_time")["frame_time"]
    assert len(times) == ticks
    assert np.ptp(times) > 89 * 86_400
    assert (np.diff(times) > 0).all()
