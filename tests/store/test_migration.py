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
def version_1(filled):
    """A file of 20 epochs as this program writes it."""
    store, _ = filled
    store.close()
    return store.path


@pytest.fixture
def steps(monkeypatch):
    """(steps) → both databases have the made-up next version."""

    def make(*more) -> None:
        monkeypatch.setattr(schema, "FILE_STEPS", (schema.FILE_STEPS[0], *more))
        monkeypatch.setattr(schema, "SERVER_STEPS", (schema.SERVER_STEPS[0], *more))

    return make


def dump(path):
    with closing(sqlite3.connect(path)) as database:
        return database.execute("PRAGMA user_version").fetchone()[0], *database.iterdump()


def test_the_columns_are_those_that_the_program_knows():
    assert [schema.sql_name(name) for name in PARAMETER_NAMES] == list(schema._PARAMETERS)


def test_an_older_store_is_read_and_brought_up_to_date(version_1, steps, make_epoch):
    """Reading changes nothing; writing makes a backup first, which a downgrade names."""
    before, copy = dump(version_1), version_1.with_name("small.db.version-1")
    steps(STEP)
    for mode in ("read", "append"):
        with Store.open(version_1, mode) as store:
            series = store.find_series()
            found = store.series_columns(series, ["epoch", "c"])["epoch"]
            assert found.tolist() == list(range(1, 21))
            (stored,) = store.epochs(series, 9, 9)
            seen = make_epoch(9).observations
            assert np.array_equal(stored.epoch.observations.points, seen.points)
            assert store._db.execute("SELECT count(*) FROM weather").fetchone() == (0,)
            assert store.identity
        assert dump(version_1)[0] == (1 if mode == "read" else 2)
        assert copy.exists() == (mode == "append")
        assert dump(copy if mode == "append" else version_1) == before
    steps()
    for mode in ("read", "append"):
        with pytest.raises(StoreVersionError, match=r"or use .*small\.db\.version-1, the backup"):
            Store.open(version_1, mode)
    copy.unlink()
    with pytest.raises(StoreVersionError, match=r"update thermocald$"):
        Store.open(version_1)


def test_a_step_that_fails_or_finds_no_room_for_the_copy_changes_nothing(
    version_1, steps, monkeypatch
):
    def full(*_):
        raise OutputError("No space left on device")

    before = dump(version_1)
    steps(FAILS)
    with pytest.raises(StoreError, match="nowhere"):
        Store.open(version_1, "append")
    assert dump(version_1) == before
    version_1.with_name("small.db.version-1").unlink()
    monkeypatch.setattr(file, "copy_database", full)
    with pytest.raises(StoreError, match="nothing was changed"):
        Store.open(version_1, "append")
    assert dump(version_1) == before


@pytest.mark.slow
def test_a_server_is_brought_up_to_date_as_a_whole_or_not_at_all(server, steps):  # noqa: F811
    place = address(server)
    steps(FAILS)
    with pytest.raises(ServerError, match="tables cannot be created"):
        create_tables(place)
    steps()
    with ServerStore(place) as store:
        assert store.all_series() == []
        assert store._query("SELECT to_regclass('half_done')") == [(None,)]
    steps(STEP)
    with pytest.raises(StoreVersionError, match=r"version 1.* are 2; run `thermocald server init`"):
        ServerStore(place)
    for _ in range(2):  # the second time there is nothing to do
        create_tables(place)
        with ServerStore(place) as store:
            assert store._query("SELECT count(*) FROM weather") == [(0,)]
