"""The daemon on a virtual clock, as the demo runs it: rendered devices go away and come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermocald.config import parse_config
from thermocald.daemon.plan import demo_config
from thermocald.daemon.service import Service
from thermocald.hal import VirtualClock
from thermocald.store.database.store import Store

START = 1_600_000_000.0


@pytest.fixture
def run(tmp_path):
    """Options of camera and thermometer, a count → what the daemon stored of so many epochs."""

    def ran(epochs, camera=None, thermometer=None):
        document = demo_config(tmp_path, 1).model_dump(mode="json", by_alias=True)
        document["cameras"][0]["options"] |= camera or {}
        document["thermometers"][0]["options"] |= thermometer or {}
        config = parse_config(document, Path("config.yaml"))
        Service(config, epochs=epochs, until_finished=True, clock=VirtualClock(START)).run()
        with Store.open(config.store.path) as store:
            series = store.find_series()
            names = ["frame_time", "temperature_time", "temperature", "c", "sd_c"]
            status = store.series_columns(series, ["status"])["status"].tolist()
            return status, store.series_columns(series, names)

    return ran


def test_every_tick_is_an_epoch_however_long_calibration_takes(run):
    status, found = run(6)
    assert status == ["ok"] * 6
    assert np.diff(found["frame_time"]) == pytest.approx([10.0] * 5, abs=1e-3)
    skew = found["temperature_time"] - found["frame_time"]
    assert ((skew > 0) & (skew < 1)).all()
    assert np.isfinite(found["sd_c"]).all()


def test_a_camera_that_is_away_loses_its_epochs_and_nothing_else(run):
    gone = {"faults": [{"kind": "unplugged", "at_s": 15, "for_s": 20}]}
    status, found = run(4, camera=gone)
    assert status == ["ok"] * 4
    assert np.round(np.diff(found["frame_time"])).tolist() == [10.0, 30.0, 10.0]


def test_a_thermometer_that_is_away_gives_no_reading_that_was_not_taken(run):
    gone = {"faults": [{"kind": "unplugged", "at_s": 5, "for_s": 10}]}
    _, found = run(3, thermometer=gone)
    skew = found["temperature_time"] - found["frame_time"]
    own = (skew > 0) & (skew < 1)  # else the reading of a tick next to it, at its own time
    assert own.tolist() == [True, False, True]
