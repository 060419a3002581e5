"""A stored series becomes a recording with the same content; neither names files elsewhere."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import thermocald as tc
from tests.commands import finish
from tests.daemon.conftest import make_recording
from tests.recordings import read_rows, write_rows, write_table
from tests.store.small import change, write_recording
from tests.store.test_bad_recordings import refused, set_field
from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.store import archive
from thermocald.store.archive import archive_series, archive_store
from thermocald.store.database.columns import KEPT, row_checksum
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import LoggedReading, clock_corrections, series_times


def test_a_series_becomes_a_recording(filled, tmp_path, make_epoch, monkeypatch):
    """With an epoch that a daemon stores in the meantime."""
    store, series = filled

    def times_and_one_more(*given):
        times = series_times(*given)
        store.append(series, make_epoch(21), extra={"camera_focus": 0.3})
        return times

    monkeypatch.setattr(archive, "series_times", times_and_one_more)
    archive_series(store, series, tmp_path / "M1")
    recording = read_recording(tmp_path / "M1")
    assert replace(recording.head, extra={}) == series.head
    assert recording.head.extra == {"start": "cold", "device": {"serial": "x1"}}
    assert recording.testfield.names == series.testfield.names
    assert recording.further_columns()["camera_focus"][20:].tolist() == [0.3]
    for epoch, made in zip(recording.epochs, map(make_epoch, range(1, 22)), strict=True):
        assert (epoch.number, epoch.temperatures) == (made.number, made.temperatures)
        assert epoch.frame_time == pytest.approx(made.frame_time, abs=1e-6)
        assert np.array_equal(epoch.observations.points, made.observations.points)


def test_a_replayed_log_and_further_columns_come_back(tmp_path):
    """A store had only the readings of the epochs: the first frame was 0.06 K off."""
    played = make_recording(tmp_path / "R", 12, interval=10.0)
    rows = read_rows(played / "epochs.csv")
    for i, row in enumerate(rows):
        row |= {"wind": "" if i == 3 else f"{0.1 + i}", "c": "1", "sky": "clear"}
    write_rows(played / "epochs.csv", rows)
    times = np.arange(1.7e9 - 20.0, 1.7e9 + 140.0, 7.0)
    write_table(played / "readings.csv", ("time", "temperature"), [(t, t % 13) for t in times])
    set_field(played / "readings.csv", 5, "temperature", "")
    finish("replay", played, "--store", tmp_path / "t.db")
    finish("archive", tmp_path / "t.db", "--to", tmp_path, "--json", tmp_path / "j")
    assert not json.loads((tmp_path / "j").read_text())["readings"]
    first, *others = (tc.open(tmp_path / name).observed() for name in ("R", "t.db", "rpi-M1"))
    for other in others:
        np.testing.assert_array_equal(other.reading_times, first.reading_times)
        np.testing.assert_array_equal(other.readings["temperature"], first.readings["temperature"])
        np.testing.assert_array_equal(other.columns["wind"], first.columns["wind"])


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


SEALED = {
    "epoch": KEPT["epoch"],
    "reading": KEPT["reading"],
    "series JOIN testfield ON testfield.id = testfield_id": (
        ["created_utc"], ["camera", "name", "start", "head", "identity", "settings", "digest"],
    ),
}  # fmt: skip


def craft(path, statement: str, *values) -> None:
    """Change rows as an attacker would, with matching checksums."""
    change(path, statement, values=values)
    with closing(sqlite3.connect(path)) as database, database:
        for tables, (numbers, texts) in SEALED.items():
            table = tables.partition(" ")[0]
            listed = ", ".join([f"{table}.id", *numbers, *texts])
            for id_, *row in database.execute(f"SELECT {listed} FROM {tables}").fetchall():
                found = row_checksum(row[: len(numbers)], row[len(numbers) :])
                database.execute(f"UPDATE {table} SET checksum = ? WHERE id = ?", (found, id_))


@pytest.fixture
def crafted(filled, tmp_path):
    """A store beside a folder of frames and a secret."""
    store, _ = filled
    store.add_readings([LoggedReading("air", 1.6e9, {"temperature": 20.0})])
    store.close()
    (tmp_path / "frames").mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    return store.path


def archived(path):
    place = path.parent
    return archive_store(path, place / "out", place / "frames", None, False, False, lambda _: None)


OUTSIDE = [
    *((f"series SET {column}", name, "part of a file's name") for column in ("camera", "name")
      for name in ("../../x", "/etc/x", "..", ".hidden", "a/b", "a\x1b[2Jb", " ")),
    ("series SET head = replace(head, '\"rpi\"', '\"../../x\"'), identity", "{}", "its head names"),
    ("reading SET thermometer", "../../air", "thermometer"),
    *(("epoch SET frame", frame, "leads out")
      for frame in ("/etc/passwd", "../secret.jpg", "a/../../secret.jpg")),
]  # fmt: skip


@pytest.mark.parametrize(("column", "name", "message"), OUTSIDE)
def test_a_name_that_leads_out_is_refused(crafted, tmp_path, column, name, message):
    craft(crafted, f"UPDATE {column} = ?", name)
    with pytest.raises(StoreError, match=message):
        archived(crafted)
    written = [p.name for p in tmp_path.rglob("*.[jc]*") if p.parent.name != "rpi-M1"]
    assert written == ["secret.jpg"]
    assert not list(tmp_path.rglob("*partial*"))


def test_a_link_among_the_frames_is_not_followed_out(crafted, tmp_path):
    frames = tmp_path / "frames"
    (frames / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    (frames / "away").symlink_to(tmp_path)
    (frames / "kept.jpg").write_bytes(b"kept")
    for number, frame in enumerate(["link.jpg", "away/secret.jpg", "kept.jpg", "gone.jpg"], 3):
        craft(crafted, "UPDATE epoch SET frame = ? WHERE number = ?", frame, number)
    archived(crafted)
    kept = {e.number: e.frame for e in read_recording(tmp_path / "out/rpi-M1").epochs if e.frame}
    assert list(kept) == [5]
    assert [p.read_bytes() for p in (tmp_path / "out/rpi-M1/frames").iterdir()] == [b"kept"]


@pytest.mark.parametrize(("frame", "leads"), [
    ("{outside}/secret.jpg", ""), ("../outside/secret.jpg", ""),
    ("frames/1.jpg", "{outside}/secret.jpg"), ("linked/secret.jpg", "{outside}"),
    ("frames/1.jpg", "/dev/zero"), ("frames/1.jpg", "a pipe"),
])  # fmt: skip
def test_a_recording_names_frames_of_its_own_only(recording_path, tmp_path, frame, leads):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret.jpg").write_bytes(b"secret")
    (recording_path / "frames").mkdir()
    node = recording_path / frame.removesuffix("/secret.jpg")
    if leads == "a pipe":
        os.mkfifo(node)
    elif leads:
        node.symlink_to(leads.format(outside=outside))
    set_field(recording_path / "epochs.csv", 2, "frame", frame.format(outside=outside))
    refused(recording_path, "is missing or outside the recording")
