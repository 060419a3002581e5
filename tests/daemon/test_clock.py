"""The wall clock of the real daemon's process is set forth and back by an hour.

Real: the process, its threads, what `clock_gettime`, `gettimeofday` and `time` of the C library
tell it. Not real: the kernel's clock itself: file times and its word on synchronisation stay.
"""

from __future__ import annotations

import numpy as np

from thermocald.store.database.archive import archive_series
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

HOUR = 3600.0


def test_an_hour_forth_and_back_loses_and_disorders_nothing(daemon, devices, shim, tmp_path):
    offset = tmp_path / "offset"
    offset.write_text("0")
    daemon.configure(**devices(period_s=0.3))
    daemon.start(LD_PRELOAD=shim("clock_offset"), CLOCK_OFFSET_FILE=str(offset))
    daemon.until(lambda: len(daemon.results()) > 4)
    for hours, steps in ((1, 1), (-1, 2), (0, 3)):
        # written over, since the process holds the file open
        offset.write_text(str(int(hours * HOUR)).ljust(8))
        daemon.until(lambda n=steps: daemon.log().count("the clock was set") == n)
        count = len(daemon.results())
        daemon.until(lambda n=count: len(daemon.results()) > n + 4)
    assert daemon.stop() == 0
    with Store.open(daemon.store) as store:
        store.check()
        series = store.find_series()
        columns = store.series_columns(series, ["epoch", "frame_time", "temperature_time"])
        trusted = [e.clock_trusted for e in store.epochs(series, details=False)]
        events = [e for e in store.events() if e.kind == "clock_step"]
        archive_series(store, series, tmp_path / "archive")
    # every step is told: forth is followed, back is not, and forth again to where we are already
    told = [(round(e.data["seconds"] / HOUR), e.data["adopted"]) for e in events]
    assert told == [(1, True), (-2, False), (1, False)]
    assert columns["epoch"].astype(int).tolist() == [r["epoch"] for r in daemon.results()]
    for name in ("frame_time", "temperature_time"):
        times = columns[name][np.isfinite(columns[name])]
        assert (np.diff(times) > 0).all()
    steps_s = np.diff(columns["frame_time"])
    assert (steps_s > 0.5 * HOUR).sum() == 1
    # the rhythm did not notice: the monotonic clock is its own
    assert np.sort(steps_s)[-2] < 60.0
    # while ours and the machine's differ, no time stamp is called trusted
    back = next(i for i, e in enumerate(columns["frame_time"]) if e > events[1].utc)
    assert not any(trusted[back + 1 :])
    assert len(read_recording(tmp_path / "archive").epochs) == len(trusted)
