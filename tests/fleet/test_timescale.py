"""TimescaleDB where it is there; everything else runs without it."""

from __future__ import annotations

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from tests.fleet.conftest import address, count
from thermocald.fleet.forward import Forwarder
from thermocald.store.server import timescale
from thermocald.store.server.connection import connect
from thermocald.store.server.reader import ServerStore
from thermocald.store.server.schema import create_tables


def partitioned(server):
    with psycopg.connect(server.address(name="thermocald")) as connection:
        return connection.execute(
            "SELECT count(*) FROM pg_partitioned_table WHERE partrelid = 'epoch'::regclass"
        ).fetchone()[0]


def test_a_hypertable_where_the_extension_is(cluster, filled):
    with psycopg.connect(cluster.address(), autocommit=True) as connection:
        connection.execute("DROP DATABASE IF EXISTS thermocald WITH (FORCE)")
        connection.execute("CREATE DATABASE thermocald")
    with psycopg.connect(cluster.address(name="thermocald"), autocommit=True) as connection:
        try:
            connection.execute("CREATE EXTENSION timescaledb")
        except psycopg.Error as error:
            pytest.skip(f"TimescaleDB is not installed: {str(error).splitlines()[0]}")
    create_tables(address(cluster))
    assert partitioned(cluster) == 0
    store, series = filled
    for _ in range(2):
        Forwarder(store.path, address(cluster), "bank").send_waiting()
        store.path.with_name(f"{store.path.name}.forwarded").unlink()
    assert count(cluster, "epoch") == 20
    with ServerStore(address(cluster)) as there:
        found = there.find_series()
        numbers = there.series_columns(found, ["epoch"])["epoch"]
    assert numbers.tolist() == store.series_columns(series, ["epoch"])["epoch"].tolist()


def test_it_is_not_needed_and_what_fails_changes_nothing(server, filled, monkeypatch, caplog):
    """The statements fail here, on a server without the extension: the partitions stay."""
    assert partitioned(server) == 1
    monkeypatch.setattr(timescale, "_wanted", lambda connection: True)
    engine = connect(address(server))
    try:
        assert timescale.use_timescale(engine) is False
    finally:
        engine.dispose()
    assert "TimescaleDB is not used" in caplog.text
    store, _ = filled
    Forwarder(store.path, address(server), "bank").send_waiting()
    assert (partitioned(server), count(server, "epoch")) == (1, 20)
