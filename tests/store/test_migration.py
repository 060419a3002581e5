"""A store of an older version becomes one of this version, as a whole or not at all."""

from __future__ import annotations

import sqlite3
import zlib
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from thermocald.errors import StoreError, StoreVersionError
from thermocald.store.database import columns, connection, migrations
from thermocald.store.database.store import Store

KEPT = ("testfield", "series", "epoch", "detail", "event")


@pytest.fixture
def version_1(store_path, tmp_path, field, head, make_epoch, make_result, monkeypatch):
    """A file as version 1 wrote it: no column chunks, no readings, no checksums."""
    monkeypatch.setattr(columns, "CHUNK", 8)
    new = tmp_path / "new.db"
    with Store.open(new, "append", durable=False) as store:
        series = store.create_series(head, field)
        for i in range(1, 21):
            status = "ok" if i % 3 else "weak"
            store.append(series, make_epoch(i), replace(make_result(i), status=status))
    database = sqlite3.connect(store_path, isolation_level=None)
    migrations.migrate(database, 0, 1)
    database.execute("ATTACH ? AS new", (str(new),))
    for table in KEPT:
        names = [row[1] for row in database.execute(f"PRAGMA main.table_info({table})")]
        listed = ", ".join(names)
        database.execute(f"INSERT INTO main.{table} ({listed}) SELECT {listed} FROM new.{table}")
    database.close()
    return store_path


def version(path) -> int:
    database = sqlite3.connect(path)
    (number,) = database.execute("PRAGMA user_version").fetchone()
    database.close()
    return number


def test_the_steps_are_text_and_make_what_they_made_when_they_were_released():
    """Frozen: a released step never changes, since stores in the field were made by it."""
    text = "\n".join(" ".join(line.split()) for step in migrations.STEPS for line in step)
    assert all(isinstance(line, str) for step in migrations.STEPS for line in step)
    assert (len(migrations.STEPS), zlib.crc32(text.encode())) == (4, 3778381292)


@pytest.mark.parametrize("mode", ["read", "append"])
def test_version_1_is_brought_up_to_date(version_1, make_epoch, make_result, mode):
    with Store.open(version_1, mode) as store:
        series = store.find_series()
        (chunks,) = store._db.execute(
            "SELECT count(DISTINCT first_row) FROM column_chunk"
        ).fetchone()
        assert chunks == 2
        found = store.series_columns(series, ["epoch", "c", "status"])
        assert found["epoch"].tolist() == list(range(1, 21))
        assert found["c"].tolist() == [make_result(i).values[0] for i in range(1, 21)]
        assert found["status"].tolist() == ["ok" if i % 3 else "weak" for i in range(1, 21)]
        (stored,) = store.epochs(series, 9, 9)
        assert np.array_equal(stored.epoch.observations.points, make_epoch(9).observations.points)
    assert version(version_1) == migrations.VERSION


def test_a_migration_that_fails_changes_nothing(version_1, monkeypatch):
    before = version_1.read_bytes()
    fails = ("CREATE TABLE half_done (id)", "INSERT INTO nowhere VALUES (1)")
    monkeypatch.setattr(migrations, "STEPS", (migrations.STEPS[0], fails))
    with pytest.raises(StoreError, match="nowhere"):
        Store.open(version_1, "append")
    assert version(version_1) == 1
    database = sqlite3.connect(version_1)
    assert not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'half_done'").fetchall()
    database.close()
    assert len(version_1.read_bytes()) == len(before)


def test_an_up_to_date_store_is_not_touched(version_1):
    with Store.open(version_1, "append"):
        pass
    before = version_1.read_bytes()
    with Store.open(version_1):
        pass
    assert version_1.read_bytes() == before


@pytest.mark.parametrize("mode", ["read", "append"])
def test_before_it_is_changed_an_older_store_is_copied(version_1, mode):
    before = version_1.read_bytes()
    with Store.open(version_1, mode):
        in_the_file = int.from_bytes(version_1.read_bytes()[60:64])
        assert mode != "read" or in_the_file == migrations.VERSION  # not in the log alone
    copy = version_1.with_name("small.db.version-1")
    assert version(copy) == 1
    assert version(version_1) == migrations.VERSION
    rows = dump(copy)
    version_1.write_bytes(before)
    assert rows == dump(version_1)


def test_after_a_downgrade_the_copy_that_serves_is_named(version_1, monkeypatch):
    with Store.open(version_1, "append"):
        pass
    monkeypatch.setattr(connection, "VERSION", 1)
    with pytest.raises(StoreVersionError, match=r"go on with .*small\.db\.version-1, the copy"):
        Store.open(version_1)
    version_1.with_name("small.db.version-1").unlink()
    with pytest.raises(StoreVersionError, match=r"update thermocald$"):
        Store.open(version_1)


def dump(path):
    with closing(sqlite3.connect(path)) as database:
        return list(database.iterdump())


def test_without_room_for_the_copy_nothing_is_changed(version_1, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(connection, "copy_database", full)
    with pytest.raises(StoreError, match="nothing was changed"):
        Store.open(version_1, "append")
    assert version(version_1) == 1
