"""Crafted stores and recordings cannot name files outside their own folders."""

from __future__ import annotations

import json
import os
import sqlite3

import pytest

from thermocald.errors import RecordingError, StoreError
from thermocald.store.database.archive import archive_readings, archive_series
from thermocald.store.database.columns import KEPT, row_checksum
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import LoggedReading


def change(path, statement: str, *values) -> None:
    """Change rows as an attacker would, with matching checksums."""
    database = sqlite3.connect(path)
    for table in ("series", "epoch", "reading"):
        database.execute(f"DROP TRIGGER IF EXISTS {table}_update")
    database.execute(statement, values)
    sealed = {
        "epoch": KEPT["epoch"],
        "reading": KEPT["reading"],
        "series": (
            ["created_utc"], ["camera", "name", "start", "head", "identity", "settings", "digest"],
        ),
    }  # fmt: skip
    for table, (numbers, texts) in sealed.items():
        join = " JOIN testfield ON testfield.id = testfield_id" if table == "series" else ""
        listed = ", ".join(f"{name}" for name in [*numbers, *texts])
        query = f"SELECT {table}.id, {listed} FROM {table}{join}"
        for id_, *row in database.execute(query).fetchall():
            found = row_checksum(row[: len(numbers)], row[len(numbers) :])
            database.execute(f"UPDATE {table} SET checksum = ? WHERE id = ?", (found, id_))
    database.commit()
    database.close()


@pytest.fixture
def crafted(filled):
    store, _ = filled
    store.add_readings([LoggedReading("air", 1.6e9, {"temperature": 20.0})])
    store.close()
    return store.path


@pytest.mark.parametrize("name", ["../../x", "/etc/x", "..", ".hidden", "a/b", "a\x1b[2Jb", " "])
@pytest.mark.parametrize("column", ["camera", "name"])
def test_a_name_that_leads_out_is_refused_when_it_is_read(crafted, name, column):
    change(crafted, f"UPDATE series SET {column} = ?", name)
    with Store.open(crafted) as store, pytest.raises(StoreError, match="part of a file's name"):
        store.all_series()


def test_a_head_of_another_name_is_refused(crafted):
    database = sqlite3.connect(crafted)
    (head,) = database.execute("SELECT head FROM series").fetchone()
    database.close()
    document = json.loads(head)
    document["camera"]["name"] = "../../x"
    change(crafted, "UPDATE series SET head = ?", json.dumps(document))
    with Store.open(crafted) as store, pytest.raises(StoreError, match="its head names"):
        store.all_series()


def test_a_thermometers_name_that_leads_out_is_refused(crafted, tmp_path):
    change(crafted, "UPDATE reading SET thermometer = '../../air'")
    (tmp_path / "out").mkdir()
    with Store.open(crafted) as store, pytest.raises(StoreError, match="thermometer"):
        archive_readings(store, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("frame", ["/etc/passwd", "../secret.jpg", "a/../../secret.jpg"])
def test_a_frame_that_leads_out_is_refused(crafted, tmp_path, frame):
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (tmp_path / "frames").mkdir()
    change(crafted, "UPDATE epoch SET frame = ? WHERE number = 3", frame)
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
        change(crafted, "UPDATE epoch SET frame = ? WHERE number = ?", frame, number)
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
