"""Analyses of a store read right times although the clock was wrong for a while."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from tests.store.conftest import N_TARGETS
from thermocald.cli import application
from thermocald.store.database.store import Store
from thermocald.store.series import Event
from thermocald.store.sources import open_source

EPOCHS = 40
# name → {first epoch, last epoch: error of their times, s}; the step that was followed
CLOCKS = {
    "a glitch of 120 days": ({(10, 14): 120 * 86400.0}, None),
    "two steps back": ({(1, 10): 7200.0, (11, 20): 3600.0}, None),
    "NTP after a start without a clock, and a glitch": ({(1, 8): -2.0e7, (20, 22): 7200.0}, 2.0e7),
}


@pytest.fixture
def stores(tmp_path, head, field, make_epoch, make_result):
    """clock → (a store stamped by that clock, one stamped by a right clock)."""

    def make(name: str):
        wrong, followed = CLOCKS[name]
        paths = tmp_path / "stamped.db", tmp_path / "right.db"
        for path in paths:
            with Store.open(path, "append", durable=False) as store:
                series = store.create_series(head, field, start="cold")
                for number in range(1, EPOCHS + 1):
                    epoch, trusted = make_epoch(number), True
                    for (first, last), seconds in wrong.items():
                        if path == paths[0] and first <= number <= last:
                            times = epoch.frame_time + seconds, epoch.temperature_time + seconds
                            epoch = replace(epoch, frame_time=times[0], temperature_time=times[1])
                            trusted = False
                    store.append(series, epoch, make_result(number), clock_trusted=trusted)
                if followed is not None and path == paths[0]:
                    data = {"seconds": followed, "adopted": True}
                    store.add_event(Event(1.6e9, "clock_step", "the clock was set", data=data))
        return paths

    return make


@pytest.mark.parametrize("clock", CLOCKS)
def test_every_analysis_reads_the_right_times(stores, clock, capsys):
    stamped, right = stores(clock)
    with Store.open(stamped) as store:
        times = store.series_columns(store.find_series(), ["frame_time"])["frame_time"]
    assert np.abs(np.diff(times)).max() > 3000
    tables = []
    for path in (stamped, right):
        fitted = tc.open(path).observed()  # fit and discover
        studied = tc.open(path).measured(exterior="per_epoch")
        application()(["export", str(path), "--exterior", "stored"], standalone_mode=False)
        rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
        with open_source(path) as store:
            epochs = [s.epoch.frame_time for s in store.epochs(store.find_series(), 10, 20)]
        tables.append(
            {
                "fit": fitted.frame_times, "readings": fitted.reading_times,
                "study": studied.time_s, "start": np.array([studied.start_utc]),
                "thermometer": studied.thermometers[0].values,
                "export": np.array([float(row["frame_time"]) for row in rows]),
                "exported": np.array([float(row["temperature"]) for row in rows]),
                "epochs": np.array(epochs),
            }
        )  # fmt: skip
    assert len(tables[0]["export"]) == EPOCHS
    for name, values in tables[0].items():
        assert values == pytest.approx(tables[1][name], abs=1e-5), name


def test_times_that_need_no_correction_are_as_they_were_stamped(filled, store_path):
    store, series = filled
    with open_source(store_path) as source:
        (same,) = source.all_series()
        for name in ("frame_time", "temperature_time", "c"):
            found = source.series_columns(same, [name])[name]
            assert found.tolist() == store.series_columns(series, [name])[name].tolist()
        assert len(next(iter(source.epochs(same))).epoch.observations) == N_TARGETS
