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
from thermocald.store.server.schema import create_tables, grant


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


# what the extension's functions do to a table, as far as our statements see it
STAND_IN = """
CREATE TABLE made (relation regclass, time_column text, settings text);
CREATE FUNCTION create_hypertable(relation regclass, time_column_name name,
  time_partitioning_func regproc, chunk_time_interval interval) RETURNS void LANGUAGE sql
  AS $$ INSERT INTO made VALUES ($1, $2, $3::text || ' ' || $4::text) $$
"""


@pytest.mark.parametrize("version", ["2.17.2", "2.18.0"])
def test_what_it_does_with_a_stand_in_for_the_extension(
    server, filled, monkeypatch, version, caplog
):
    """Debian has no TimescaleDB; our statements run here against functions of the same names."""
    with psycopg.connect(server.address(name="thermocald"), autocommit=True) as connection:
        connection.execute(STAND_IN)
        connection.execute("CREATE ROLE pi LOGIN PASSWORD 'p'")
    grant(address(server), "pi", writes=True)
    monkeypatch.setattr(timescale, "_version", lambda connection: version)
    engine = connect(address(server))
    try:
        used = timescale.use_timescale(engine)
        again = timescale.use_timescale(engine)
        pi = address(server, user="pi:p")
        for _ in range(2):
            Forwarder(filled[0].path, pi, "bank").send_waiting()
            filled[0].path.with_name(f"{filled[0].path.name}.forwarded").unlink()
        with psycopg.connect(server.address(name="thermocald")) as connection:
            made = connection.execute("SELECT relation::text, time_column, settings FROM made")
            expected = [("epoch", "frame_time", "thermocald_time 1 mon")]
            assert made.fetchall() == (expected if version == "2.18.0" else [])
            assert connection.execute("SELECT sum(epochs) FROM summary").fetchone() == (20,)
    finally:
        engine.dispose()
        with psycopg.connect(server.address(name="thermocald"), autocommit=True) as connection:
            connection.execute("DROP OWNED BY pi")
            connection.execute("DROP ROLE pi")
    assert (used, again) == (version == "2.18.0", False)
    assert partitioned(server) == (0 if used else 1)
    assert count(server, "epoch") == 20
    assert ("2.18 or later is needed" in caplog.text) == (not used)
