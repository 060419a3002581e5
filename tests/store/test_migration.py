"""A store of an older version becomes one of this version, as a whole or not at all."""

from __future__ import annotations

import sqlite3
from dataclasses import replace

import numpy as np
import pytest

from thermocald.errors import StoreError
from thermocald.store.database import columns, schema
from thermocald.store.database.store import Store


@pytest.fixture
def version_1(store_path, field, head, make_epoch, make_result, monkeypatch):
    """A file as version 1 wrote it: no column chunks, no codes of the statuses, no readings."""
    monkeypatch.setattr(columns, "CHUNK", 8)
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for i in range(1, 21):
            status = "ok" if i % 3 else "weak"
            store.append(series, make_epoch(i), replace(make_result(i), status=status))
    with sqlite3.connect(store_path) as database:
        database.execute("DROP TABLE column_chunk")
        database.execute("DROP TABLE status_code")
        database.execute("DROP TABLE late_epoch")
        database.execute("DROP TABLE reading")
        database.execute("PRAGMA user_version = 1")
    database.close()
    return store_path


def version(path) -> int:
    database = sqlite3.connect(path)
    (number,) = database.execute("PRAGMA user_version").fetchone()
    database.close()
    return number


def test_version_1_is_what_its_step_made(version_1, tmp_path):
    """The fixture's file has the tables that step 1 makes, and no others."""

    def tables(database) -> list:
        query = "SELECT type, name, sql FROM sqlite_master WHERE sql NOT NULL ORDER BY name"
        return database.execute(query).fetchall()

    database = sqlite3.connect(tmp_path / "one.db", isolation_level=None)
    schema.migrate(database, 0, 1)
    old = sqlite3.connect(version_1)
    assert tables(old) == tables(database)
    database.close()
    old.close()


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
    assert version(version_1) == schema.VERSION


def test_a_migration_that_fails_changes_nothing(version_1, monkeypatch):
    def fails(connection):
        connection.execute("CREATE TABLE half_done (id)")
        raise sqlite3.OperationalError("something is wrong")

    before = version_1.read_bytes()
    monkeypatch.setattr(schema, "STEPS", (schema.STEPS[0], fails))
    with pytest.raises(StoreError, match="something is wrong"):
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
