"""The wall clock of the real daemon's process is set, for seconds or permanently.

Real: the process, its threads, and the times that `clock_gettime`, `gettimeofday` and `time` of the
C library return. Not real: the kernel's clock; file times and its synchronisation state stay.
"""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

from thermocald.store.database.archive import archive_series
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

HOUR = 3600.0
DAY = 86400.0


def content(daemon, folder):
    """Return (columns, clock steps, archived times) of the only series."""
    with Store.open(daemon.store) as store:
        assert store.examine().damaged == ()
        series = store.find_series()
        names = ["epoch", "frame_time", "temperature_time", "clock_trusted"]
        columns = store.series_columns(series, names)
        steps = [e.data for e in store.events() if e.kind == "clock_step"]
        archive_series(store, series, folder / "archive")
    return columns, steps, read_recording(folder / "archive").columns.frame_time


@pytest.fixture
def clocked(daemon, devices, preloaded, tmp_path):
    """s → a daemon started with its clock off by this; `clocked.set` changes the offset."""
    frames = {"keep": "all", "folder": str(tmp_path / "frames"), "max_age_days": 90,
              "min_free_gb": 0.0}  # fmt: skip
    daemon.configure(**devices(period_s=0.3), frames=frames)
    daemon.forker = preloaded

    def set_clock(seconds):
        # overwritten, since the process holds the file open
        (tmp_path / "offset").write_text(str(int(seconds)).ljust(12))

    def start(seconds):
        set_clock(seconds)
        daemon.start(CLOCK_OFFSET_FILE=str(tmp_path / "offset"))
        daemon.more(2)

    start.set = set_clock
    return start


def test_a_glitch_moves_no_time_and_deletes_no_frame(daemon, clocked, tmp_path):
    """120 days ahead for 3 s, an hour back: this once deleted all frames and left times wrong."""
    clocked(0)
    for seconds, steps in ((120 * DAY, 1), (0, 2), (-HOUR, 3), (0, 4)):
        clocked.set(seconds)
        daemon.until(lambda n=steps: daemon.log().count("the clock was set") == n)
        daemon.more(2)
    assert daemon.stop() == 0
    columns, steps, archived = content(daemon, tmp_path)
    told = [(round(step["seconds"] / HOUR), step["adopted"]) for step in steps]
    assert told == [(2880, False), (-2880, False), (-1, False), (1, False)]
    numbers = columns["epoch"].astype(int).tolist()
    assert numbers == [r["epoch"] for r in daemon.results()]
    for name in ("frame_time", "temperature_time"):
        times = columns[name][np.isfinite(columns[name])]
        assert (np.diff(times) > 0).all()
        assert np.ptp(times) < 600.0
    assert np.abs(archived - columns["frame_time"]).max() < 2e-6
    assert len(list((tmp_path / "frames").rglob("*.png"))) == len(numbers)
    assert "frames_deleted" not in daemon.events()


def test_a_pi_that_starts_without_a_clock_loses_nothing_when_ntp_comes(daemon, clocked, tmp_path):
    clocked(60 - time.time())  # a minute after the start of 1970
    clocked.set(0)
    daemon.until(lambda: "time stamps follow" in daemon.log())
    assert re.search(r"was set forwards by \d{5} days; time stamps follow", daemon.log())
    daemon.more(2)
    daemon.until(lambda: daemon.status()["utc"] > 1.6e9)
    assert daemon.status()["utc"] - daemon.status()["started"] < 600.0  # it was 20,000 days
    assert daemon.stop() == 0
    columns, steps, archived = content(daemon, tmp_path)
    assert [step["adopted"] for step in steps] == [True]
    numbers = columns["epoch"].astype(int).tolist()
    assert numbers == [r["epoch"] for r in daemon.results()] == list(range(1, len(numbers) + 1))
    assert len(list((tmp_path / "frames").rglob("*.png"))) == len(numbers)
    assert columns["frame_time"][0] < 1e6
    # the earlier epochs are corrected
    assert np.diff(archived).max() < 60.0
    assert (np.diff(archived) > 0).all()
    assert abs(archived[-1] - time.time()) < 600.0
