"""A store of an older version becomes one of this version, as a whole or not at all.

There is only one version yet, so the step to the next is made up here.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from tests.fleet.conftest import address, cluster, server, template  # noqa: F401
from thermocald.errors import OutputError, ServerError, StoreError, StoreVersionError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store import schema
from thermocald.store.database import file
from thermocald.store.database.store import Store
from thermocald.store.server.connection import create_tables
from thermocald.store.server.reader import ServerStore

STEP = (
    "ALTER TABLE event ADD COLUMN mood TEXT NOT NULL DEFAULT 'calm'",
    "CREATE TABLE weather (id INTEGER PRIMARY KEY)",
)
FAILS = ("CREATE TABLE half_done (id INTEGER)", "INSERT INTO nowhere VALUES (1)")


@pytest.fixture
def version_1(filled, store_path):
    """A file of 20 epochs as this program writes it."""
    store, _ = filled
    store.checkpoint()
    store.close()
    return store_path


@pytest.fixture
def version_2(monkeypatch):
    """The made-up next version of both databases."""
    monkeypatch.setattr(schema, "FILE_STEPS", (*schema.FILE_STEPS, STEP))
    monkeypatch.setattr(schema, "SERVER_STEPS", (*schema.SERVER_STEPS, STEP))


def version(path) -> int:
    with closing(sqlite3.connect(path)) as database:
        return database.execute("PRAGMA user_version").fetchone()[0]


def dump(path):
    with closing(sqlite3.connect(path)) as database:
        return list(database.iterdump())


def test_the_columns_are_those_that_the_program_knows():
    assert [schema.sql_name(name) for name in PARAMETER_NAMES] == list(schema._PARAMETERS)


@pytest.mark.parametrize("mode", ["read", "append"])
def test_an_older_store_is_read_and_brought_up_to_date(version_1, version_2, make_epoch, mode):
    before = dump(version_1)
    with Store.open(version_1, mode) as store:
        series = store.find_series()
        found = store.series_columns(series, ["epoch", "c"])
        assert found["epoch"].tolist() == list(range(1, 21))
        (stored,) = store.epochs(series, 9, 9)
        assert np.array_equal(stored.epoch.observations.points, make_epoch(9).observations.points)
        assert store._db.execute("SELECT count(*) FROM weather").fetchone() == (0,)
        assert store.identity
    # reading changes nothing; writing makes a backup first
    assert version(version_1) == (1 if mode == "read" else 2)
    copy = version_1.with_name("small.db.version-1")
    assert copy.exists() == (mode == "append")
    assert dump(copy if mode == "append" else version_1) == before


def test_a_step_that_fails_changes_nothing(version_1, monkeypatch):
    before = dump(version_1)
    monkeypatch.setattr(schema, "FILE_STEPS", (*schema.FILE_STEPS, FAILS))
    with pytest.raises(StoreError, match="nowhere"):
        Store.open(version_1, "append")
    assert version(version_1) == 1
    assert dump(version_1) == before


def test_after_a_downgrade_the_copy_that_serves_is_named(version_1, monkeypatch):
    with monkeypatch.context() as newer:
        newer.setattr(schema, "FILE_STEPS", (*schema.FILE_STEPS, STEP))
        Store.open(version_1, "append").close()
    for mode in ("read", "append"):
        with pytest.raises(StoreVersionError, match=r"or use .*small\.db\.version-1, the backup"):
            Store.open(version_1, mode)
    version_1.with_name("small.db.version-1").unlink()
    with pytest.raises(StoreVersionError, match=r"update thermocald$"):
        Store.open(version_1)


def test_without_room_for_the_copy_nothing_is_changed(version_1, version_2, monkeypatch):
    def full(*_):
        raise OutputError("No space left on device")

    monkeypatch.setattr(file, "copy_database", full)
    with pytest.raises(StoreError, match="nothing was changed"):
        Store.open(version_1, "append")
    assert version(version_1) == 1


@pytest.mark.slow
def test_a_server_is_brought_up_to_date_as_a_whole_or_not_at_all(server, monkeypatch):  # noqa: F811
    place = address(server)
    with monkeypatch.context() as broken:
        broken.setattr(schema, "SERVER_STEPS", (*schema.SERVER_STEPS, FAILS))
        with pytest.raises(ServerError, match="tables cannot be created"):
            create_tables(place)
    with ServerStore(place) as store:
        assert store.all_series() == []
        assert store._query("SELECT to_regclass('half_done')") == [(None,)]
    monkeypatch.setattr(schema, "SERVER_STEPS", (*schema.SERVER_STEPS, STEP))
    with pytest.raises(StoreVersionError, match=r"version 1.* are 2; run `thermocald server init`"):
        ServerStore(place)
    for _ in range(2):  # the second time there is nothing to do
        create_tables(place)
        with ServerStore(place) as store:
            assert store._query("SELECT count(*) FROM weather") == [(0,)]
    monkeypatch.setattr(schema, "SERVER_STEPS", schema.SERVER_STEPS[:1])
    with pytest.raises(StoreVersionError, match="update thermocald here"):
        ServerStore(place)
