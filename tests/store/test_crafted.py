"""Crafted stores and recordings cannot name files outside their own folders."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing

import pytest

from tests.store.small import change
from thermocald.errors import RecordingError, StoreError
from thermocald.store.database.archive import archive_store
from thermocald.store.database.columns import KEPT, row_checksum
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
def crafted(filled, tmp_path):
    """A store beside a folder of frames and a secret."""
    store, _ = filled
    store.add_readings([LoggedReading("air", 1.6e9, {"temperature": 20.0})])
    store.close()
    (tmp_path / "frames").mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    return store.path


def archive(path):
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
        archive(crafted)
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
    archive(crafted)
    kept = {e.number: e.frame for e in read_recording(tmp_path / "out/rpi-M1").epochs if e.frame}
    assert list(kept) == [5]
    assert [p.read_bytes() for p in (tmp_path / "out/rpi-M1/frames").iterdir()] == [b"kept"]


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
    head, first, *rows = table.read_text().splitlines()
    first = first.rsplit(",", 1)[0] + f",{frame.format(outside=outside)}"
    table.write_text("\n".join([head, first, *rows, ""]))
    with pytest.raises(RecordingError, match="is missing or outside the recording"):
        read_recording(recording_path)
