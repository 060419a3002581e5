"""Crafted stores and recordings cannot name files outside their own folders."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing

import pytest

from tests.store.small import change
from thermocald.errors import RecordingError, StoreError
from thermocald.store.database.archive import archive_readings, archive_series
from thermocald.store.database.columns import KEPT, row_checksum
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import LoggedReading

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
def crafted(filled):
    store, _ = filled
    store.add_readings([LoggedReading("air", 1.6e9, {"temperature": 20.0})])
    store.close()
    return store.path


@pytest.mark.parametrize("column", ["camera", "name"])
def test_a_name_that_leads_out_is_refused_when_it_is_read(crafted, column):
    for name in ("../../x", "/etc/x", "..", ".hidden", "a/b", "a\x1b[2Jb", " "):
        craft(crafted, f"UPDATE series SET {column} = ?", name)
        with Store.open(crafted) as store, pytest.raises(StoreError, match="part of a file's name"):
            store.all_series()


def test_a_head_of_another_name_is_refused(crafted):
    database = sqlite3.connect(crafted)
    (head,) = database.execute("SELECT head FROM series").fetchone()
    database.close()
    document = json.loads(head)
    document["camera"]["name"] = "../../x"
    craft(crafted, "UPDATE series SET head = ?", json.dumps(document))
    with Store.open(crafted) as store, pytest.raises(StoreError, match="its head names"):
        store.all_series()


def test_a_thermometers_name_that_leads_out_is_refused(crafted, tmp_path):
    craft(crafted, "UPDATE reading SET thermometer = '../../air'")
    (tmp_path / "out").mkdir()
    with Store.open(crafted) as store, pytest.raises(StoreError, match="thermometer"):
        archive_readings(store, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_frame_that_leads_out_is_refused(crafted, tmp_path):
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (tmp_path / "frames").mkdir()
    for frame in ("/etc/passwd", "../secret.jpg", "a/../../secret.jpg"):
        craft(crafted, "UPDATE epoch SET frame = ? WHERE number = 3", frame)
        with Store.open(crafted) as store, pytest.raises(StoreError, match="leads out"):
            archive_series(store, store.find_series(), tmp_path / "out", tmp_path / "frames")
        assert not (tmp_path / "out").exists()
        assert not list(tmp_path.glob(".*partial"))


def test_a_link_among_the_frames_is_not_followed_out(crafted, tmp_path):
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames/link.jpg").symlink_to(tmp_path / "secret.jpg")
    (tmp_path / "frames/away").symlink_to(tmp_path)
    (tmp_path / "frames/kept.jpg").write_bytes(b"kept")
    for number, frame in ((3, "link.jpg"), (4, "away/secret.jpg"), (5, "kept.jpg")):
        craft(crafted, "UPDATE epoch SET frame = ? WHERE number = ?", frame, number)
    with Store.open(crafted) as store:
        archive_series(store, store.find_series(), tmp_path / "out", tmp_path / "frames")
    kept = {p.name: p.read_bytes() for p in (tmp_path / "out/frames").iterdir()}
    assert kept == {"000005.jpg": b"kept"}


@pytest.mark.parametrize(
    ("frame", "leads"),
    [
        ("{outside}/secret.jpg", ""),
        ("../outside/secret.jpg", ""),
        ("frames/1.jpg", "{outside}/secret.jpg"),
        ("linked/secret.jpg", "{outside}"),
        ("frames/1.jpg", "/dev/zero"),
        ("frames/1.jpg", "a pipe"),
    ],
)
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
    table = recording_path / "epochs.csv"
    lines = table.read_text().splitlines()
    lines[1] = lines[1].rsplit(",", 1)[0] + f",{frame.format(outside=outside)}"
    table.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordingError, match="is missing or outside the recording"):
        read_recording(recording_path)
