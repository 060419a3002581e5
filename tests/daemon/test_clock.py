"""The wall clock of the real daemon's process is set, for seconds or permanently.

Real: the process, its threads, and the times that `clock_gettime`, `gettimeofday` and `time` of the
C library return. Not real: the kernel's clock; file times and its synchronisation state stay.
"""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

from tests.daemon.conftest import columns_of
from thermocald.store.archive import archive_series
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

HOUR = 3600.0
DAY = 86400.0


@pytest.fixture
def set_clock(daemon, devices, preloaded, tmp_path):
    """s → the clock of the daemon is off by this; begin: start it, and wait for two epochs."""
    daemon.configure(**devices(period_s=0.3), keep="all", frames={"max_age_days": 90})
    daemon.forker = preloaded

    def set_clock(seconds: float, begin: bool = False) -> None:
        # overwritten, since the process holds the file open
        (tmp_path / "offset").write_text(str(int(seconds)).ljust(12))
        if begin:
            daemon.start(CLOCK_OFFSET_FILE=str(tmp_path / "offset"))
            daemon.more(2)

    return set_clock


def content(daemon):
    """Stop it; return (columns, clock steps, archived times) of its series, whose frames are all
    there.
    """
    assert daemon.stop() == 0
    numbers, _ = daemon.stored()
    assert numbers == [r["epoch"] for r in daemon.results()]
    assert len(list(daemon.frames.rglob("*.png"))) == len(numbers)
    with Store.open(daemon.store) as store:
        steps = [e.data for e in store.events() if e.kind == "clock_step"]
        archive_series(store, store.find_series(), daemon.folder / "archive")
    columns = columns_of(daemon.store, "frame_time", "temperature_time")
    return columns, steps, read_recording(daemon.folder / "archive").columns.frame_time


def test_a_glitch_moves_no_time_and_deletes_no_frame(daemon, set_clock):
    """120 days ahead for 3 s, an hour back: this once deleted all frames and left times wrong."""
    set_clock(0, begin=True)
    for seconds, steps in ((120 * DAY, 1), (0, 2), (-HOUR, 3), (0, 4)):
        set_clock(seconds)
        daemon.until(lambda n=steps: daemon.log().count("the clock was set") == n)
        daemon.more(2)
    columns, steps, archived = content(daemon)
    told = [(round(step["seconds"] / HOUR), step["adopted"]) for step in steps]
    assert told == [(2880, False), (-2880, False), (-1, False), (1, False)]
    for times in columns.values():
        times = times[np.isfinite(times)]
        assert (np.diff(times) > 0).all()
        assert np.ptp(times) < 600.0
    assert np.abs(archived - columns["frame_time"]).max() < 2e-6
    assert "frames_deleted" not in daemon.events()


def test_a_pi_that_starts_without_a_clock_loses_nothing_when_ntp_comes(daemon, set_clock):
    set_clock(60 - time.time(), begin=True)  # a minute after the start of 1970
    set_clock(0)
    daemon.until(lambda: "time stamps follow" in daemon.log())
    assert re.search(r"was set forwards by \d{5} days; time stamps follow", daemon.log())
    daemon.more(2)
    daemon.until(lambda: daemon.status()["utc"] > 1.6e9)
    assert daemon.status()["utc"] - daemon.status()["started"] < 600.0  # it was 20,000 days
    columns, steps, archived = content(daemon)
    assert [step["adopted"] for step in steps] == [True]
    assert columns["frame_time"][0] < 1e6
    # the earlier epochs are corrected
    assert np.diff(archived).max() < 60.0
    assert (np.diff(archived) > 0).all()
    assert abs(archived[-1] - time.time()) < 600.0
