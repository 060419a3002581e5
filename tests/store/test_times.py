"""Analyses of a store read right times although the clock was wrong for a while."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from tests.commands import call, finish
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import Event, clock_corrections
from thermocald.store.sources import open_source

EPOCHS = 40
# name → {first epoch, last epoch: error of their times, s}; the step that was followed
CLOCKS = {
    "a glitch of 120 days": ({(10, 14): 120 * 86400.0}, None),
    "two steps back": ({(1, 10): 7200.0, (11, 20): 3600.0}, None),
    "NTP after a start without a clock, and a glitch": ({(1, 8): -2.0e7, (20, 22): 7200.0}, 2.0e7),
}


@pytest.fixture
def stamp(tmp_path, head, field, make_epoch, make_result):
    """(errors of the clock, the step that was followed) → a store stamped by that clock."""

    def make(wrong, followed):
        path = tmp_path / ("stamped.db" if wrong else "right.db")
        with Store.open(path, "append", durable=False) as store:
            series = store.create_series(head, field, start="cold")
            for number in range(1, EPOCHS + 1):
                epoch = make_epoch(number)
                error = sum(s for (first, last), s in wrong.items() if first <= number <= last)
                times = epoch.frame_time + error, epoch.temperature_time + error
                epoch = replace(epoch, frame_time=times[0], temperature_time=times[1])
                store.append(series, epoch, make_result(number), clock_trusted=not error)
            if followed is not None:
                data = {"seconds": followed, "adopted": True}
                store.add_event(Event(1.6e9, "clock_step", "the clock was set", data=data))
        return path

    return make


def test_a_glitch_between_slow_frames_is_paired():
    """The next frame came 100 s late, less than three intervals."""
    times = 60.0 * np.arange(10) + 7200.0 * np.isin(np.arange(10), (3, 4, 5))
    times[6:] += 100.0
    corrections = clock_corrections(times, 60.0, np.ones(10), [])
    assert np.flatnonzero(corrections).tolist() == [3, 4, 5]


def read(path) -> dict[str, np.ndarray]:
    """Return times, and what depends on them, as every analysis reads them."""
    fitted = tc.open(path).observed()  # fit and discover
    studied = tc.open(path).measured(exterior="per_epoch")
    assert call("archive", path, "--to", path.with_suffix("")).returncode == 0
    archived = read_recording(path.with_suffix("") / "rpi-M1")
    rows = list(csv.DictReader(io.StringIO(finish("export", path, "--exterior", "stored").stdout)))
    with open_source(path) as store:
        epochs = [s.epoch.frame_time for s in store.epochs(store.find_series(), 10, 20)]
    return {
        "fit": fitted.frame_times, "readings": fitted.reading_times, "epochs": np.array(epochs),
        "archive": archived.columns.frame_time, "archived": archived.columns.temperature_time,
        "study": studied.time_s, "start": np.array([studied.start_utc]),
        "thermometer": studied.thermometers[0].values,
        "export": np.array([float(row["frame_time"]) for row in rows]),
        "exported": np.array([float(row["temperature"]) for row in rows]),
    }  # fmt: skip


@pytest.mark.parametrize("clock", CLOCKS)
def test_every_analysis_reads_the_right_times(stamp, clock):
    stamped, right = stamp(*CLOCKS[clock]), stamp({}, None)
    with Store.open(stamped) as store:
        times = store.series_columns(store.find_series(), ["frame_time"])["frame_time"]
    assert np.abs(np.diff(times)).max() > 3000
    expected = read(right)
    assert expected["export"].tolist() == [1.6e9 + 10.0 * i for i in range(1, EPOCHS + 1)]
    for name, values in read(stamped).items():
        assert values == pytest.approx(expected[name], abs=1e-5), name
