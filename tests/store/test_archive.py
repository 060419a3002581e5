"""Archiving: a stored series becomes a recording with the same content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import thermocald as tc
from tests.store.small import write_recording
from thermocald.epoch import Epoch
from thermocald.store.database import archive
from thermocald.store.database.archive import archive_series, archive_store
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import clock_corrections, series_times


def test_a_series_becomes_a_recording(filled, tmp_path, make_epoch, monkeypatch):
    """With an epoch that a daemon stores in the meantime."""
    store, series = filled

    def times_and_one_more(*given):
        times = series_times(*given)
        store.append(series, make_epoch(21))
        return times

    monkeypatch.setattr(archive, "series_times", times_and_one_more)
    archive_series(store, series, tmp_path / "M1")
    recording = read_recording(tmp_path / "M1")
    assert replace(recording.head, extra={}) == series.head
    assert recording.head.extra == {"start": "cold", "device": {"serial": "x1"}}
    assert recording.testfield.names == series.testfield.names
    for epoch, made in zip(recording.epochs, map(make_epoch, range(1, 22)), strict=True):
        assert (epoch.number, epoch.temperatures) == (made.number, made.temperatures)
        assert epoch.frame_time == pytest.approx(made.frame_time, abs=1e-6)
        assert np.array_equal(epoch.observations.points, made.observations.points)


def test_a_clock_that_was_set_back_is_in_the_head(filled, tmp_path, make_epoch):
    """Its times are corrected: see test_times."""
    store, series = filled
    store.append(series, replace(make_epoch(21), frame_time=make_epoch(21).frame_time - 3600))
    store.append(series, replace(make_epoch(22), frame_time=make_epoch(22).frame_time - 3600))
    archive_series(store, series, tmp_path / "M1")
    (step,) = read_recording(tmp_path / "M1").head.extra["clock_set_back"]
    assert step == {"epoch": 21, "seconds": pytest.approx(-3600.0)}


def test_a_camera_that_was_off_is_no_clock_that_was_set():
    """Clocks that were set are in test_times."""
    times = 1.75e9 + np.arange(20) * 10.0
    times[9:] += 1.0e7
    assert not clock_corrections(times, 10.0, np.ones(20), []).any()
    assert not clock_corrections(np.array([0.0, 10, 500]), 10.0, np.zeros(3), []).any()


def test_two_series_never_share_a_folder(tmp_path, head, field, make_epoch):
    """`a-b`/`c` and `a`/`b-c`: with --skip-existing the second would never be archived."""
    with Store.open(tmp_path / "s.db", "append") as store:
        for camera, name in (("a-b", "c"), ("a", "b-c"), ("a", "b")):
            one = replace(head, series=name, camera=replace(head.camera, name=camera))
            store.append(store.create_series(one, field), make_epoch(0))
    place = (tmp_path / "s.db", tmp_path / "out")
    found = [archive_store(*place, None, None, False, True, lambda _: None) for _ in range(2)]
    assert found[1]["recordings"] == []  # all exist already
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a--b-c", "a-b", "a-b--c"]
    assert read_recording(tmp_path / "out/a-b").columns.numbers.tolist() == [0]


@pytest.mark.parametrize(("place", "named"), [("", "M1/frames/000001.png"), ("away", None)])
def test_a_replay_names_frames_in_the_folder_of_its_store_only(tmp_path, field, head, place, named):
    """Regression: a store that named frames elsewhere could not be read."""
    (tmp_path / "away").mkdir()
    (tmp_path / "0.png").write_bytes(b"no image")
    readings = dict.fromkeys(head.channels, 20.0)
    epoch = Epoch(1, 0.0, 0.0, readings, frame=tmp_path / "0.png")
    write_recording(tmp_path / "M1", head, field, [epoch])
    path = tmp_path / place / "t.db"
    assert tc.open(tmp_path / "M1").calibrate(store=path).status == ("bad_frame",)
    with Store.open(path) as store:
        (stored,) = store.epochs(store.find_series())
    assert stored.epoch.frame == (named and Path(named))
