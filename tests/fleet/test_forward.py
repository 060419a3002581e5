"""Forwarding: all rows arrive once and unchanged, whatever fails on the way."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from thermocald.config import ForwardConfig
from thermocald.errors import ServerError, ServerGone
from thermocald.fleet.forward import Forwarder, forward_forever
from thermocald.store.series import Event, LoggedReading

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from tests.fleet.conftest import address, count, execute
from thermocald.store.schema import COLUMN_NAMES
from thermocald.store.server.connection import ServerAddress, grant
from thermocald.store.server.reader import ServerStore, ServerWriter

SENT = dict.fromkeys(("epoch", "event", "reading", "frame"), 0)


def test_a_last_report_that_is_lost_is_sent_again(filled, server, monkeypatch):
    lost = []

    def report(self, waiting, *rest):
        if waiting == 0 and not lost:
            lost.append(waiting)
            raise ServerGone("cut")
        _report(self, waiting, *rest)

    _report = ServerWriter.report
    monkeypatch.setattr(ServerWriter, "report", report)
    forwarder = Forwarder(filled[0].path, address(server), "bank")
    with pytest.raises(ServerGone):
        forwarder.send_waiting()
    forwarder.send_waiting()
    assert execute(server, "SELECT waiting FROM station") == [(0,)]


def test_server_and_store_give_the_same(filled, server, make_result):
    store, series = filled
    store.amend(series, 5, make_result(105, "ok"))
    store.add_event(Event(1.6e9, "knock", "a \0 knock", series.id, 3, {"px": 0.4}))
    store.add_readings([LoggedReading("logger", 1.6e9 + i, {"t": 20.0 + i}) for i in range(3)])
    done = Forwarder(store.path, address(server), "bank").send_waiting()
    assert dict(done.sent) == SENT | {"epoch": 21, "event": 1, "reading": 3}
    with ServerStore(address(server, "?station=bank&camera=rpi")) as there:
        (found,) = there.all_series()
        for name in ("head", "start", "settings"):
            assert getattr(found, name) == getattr(series, name)
        assert np.array_equal(found.testfield.points, series.testfield.points)
        with ServerStore(address(server)) as another:
            assert another.series_columns(found, ["epoch"])["epoch"].tolist() == [*range(1, 21)]
        names = [*COLUMN_NAMES, *series.head.channels, "blur"]
        mine, theirs = store.series_columns(series, names), there.series_columns(found, names)
        for name in names:
            assert np.array_equal(mine[name], theirs[name], equal_nan=name != "status"), name
        assert np.array_equal(store.covariances(series, [3, 5]), there.covariances(found, [3, 5]))
        for a, b in zip(store.epochs(series), there.epochs(found), strict=True):
            assert (a.epoch.number, a.revision, a.extra) == (b.epoch.number, b.revision, b.extra)
            assert np.array_equal(a.epoch.observations.points, b.epoch.observations.points)
            assert np.array_equal(a.result.covariance, b.result.covariance)
            assert a.result.rejected == b.result.rejected
        ((text, epoch, data),) = there._query("SELECT text, epoch, data FROM event")
        assert (text, epoch, json.loads(data)) == ("a \ufffd knock", 3, {"px": 0.4})
        readings = there._query("SELECT utc, temperatures FROM reading ORDER BY id")
        assert [(utc, json.loads(values)) for utc, values in readings] == [
            (reading.utc, reading.values) for reading in store.readings("logger")
        ]


def test_a_role_that_may_only_insert_is_enough(station, server):
    """A role that may only log in, to which writing is granted."""
    execute(server, "CREATE ROLE pi LOGIN PASSWORD 'berry'")
    try:
        pi, (store, frames) = address(server, user="pi:berry"), station
        rule = ForwardConfig(frames="events")
        forwarder = Forwarder(store, pi, "bank", frames=frames, rule=rule)
        with pytest.raises(ServerError, match="grant it"):
            forwarder.send_waiting()
        grant(address(server), "pi", writes=True)
        assert dict(forwarder.send_waiting().sent) == SENT | {"epoch": 20, "frame": 2}
        assert execute(server, "SELECT name, waiting FROM station") == [("bank", 0)]
        with ServerStore(pi) as there, pytest.raises(ServerError, match="lacks the permission"):
            there.all_series()
        for statement in ("DELETE FROM epoch", "UPDATE epoch SET number = 0"):
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                execute(server, f"SET ROLE pi; {statement}")
    finally:
        execute(server, "DROP OWNED BY pi; DROP ROLE pi")


def test_months_become_partitions_and_wrong_clocks_do_not_matter(server, filled, make_epoch):
    store, series = filled
    times = [1.7e9, -5.0, 0.0, 3.0, 1.7e9 + 40 * 86400, 9e12, 1.69e9]
    for number, time in enumerate(times, 100):
        store.append(series, replace(make_epoch(number), frame_time=time), clock_trusted=False)
    Forwarder(store.path, address(server), "bank").send_waiting()
    found = execute(server, "SELECT tableoid::regclass::text, count(*) FROM epoch GROUP BY 1")
    months = {"epoch_2020_09": 20, "epoch_2023_07": 1, "epoch_2023_11": 1, "epoch_2023_12": 1}
    assert dict(found) == months | {"epoch_other": 4}
    with ServerStore(address(server)) as there:
        columns = there.series_columns(there.find_series(), ["frame_time", "clock_trusted"])
    assert columns["frame_time"][20:].tolist() == times
    assert not columns["clock_trusted"][20:].any()


@pytest.mark.parametrize(
    ("user", "name", "words"),
    [
        ("owner:wrong", "thermocald", "password"),
        ("owner:secret", "nowhere", "no such database"),
        ("owner:secret", "postgres", "server init"),
    ],
)
def test_what_a_person_must_mend_is_said(filled, server, user, name, words):
    wrong = ServerAddress.parse(server.address(user=user, name=name))
    with pytest.raises(ServerError, match=words) as told:
        Forwarder(filled[0].path, wrong, "bank").send_waiting()
    assert not isinstance(told.value, ServerGone)
    assert "secret" not in str(told.value)
    assert "wrong" not in str(told.value).split("(")[0]


def test_a_row_that_the_server_refuses_stops_no_other(filled, server):
    """The partition of a month whose first batch failed is made by the next one."""
    store, _ = filled
    execute(server, "ALTER TABLE epoch ADD CHECK (number <> 7)")
    forwarder = Forwarder(store.path, address(server), "bank", batch=8)
    done = forwarder.send_waiting()
    assert (done.sent["epoch"], done.refused) == (19, 1)
    assert count(server, "epoch") == 19
    assert forwarder.send_waiting().rows == 0
    found = execute(server, "SELECT DISTINCT tableoid::regclass::text FROM epoch")
    assert found == [("epoch_2020_09",)]


def test_a_server_that_dies_and_comes_back_gets_everything_once(filled, server, make_epoch, caplog):
    store, series = filled
    rounds = []

    def wait(_seconds):
        rounds.append(count(server, "epoch") if len(rounds) in (0, 3, 4, 5) else None)
        if len(rounds) == 1:
            server.stop()
        for n in range(3):
            store.append(series, make_epoch(100 * len(rounds) + n))
        if len(rounds) == 3:
            server.start()
        return len(rounds) == 6

    forward_forever(Forwarder(store.path, address(server), "bank", batch=4), wait)
    assert rounds == [20, None, None, 29, 32, 35]
    assert caplog.text.count("cannot be reached") == 1


def test_a_damaged_row_is_not_sent_and_stops_no_other(filled, server):
    """Bits flipped on an SD card must not become values on the server."""
    store, _ = filled
    store.add_readings([LoggedReading("air", 1.6e9 + i, {"t": 20.0}) for i in range(3)])
    with closing(sqlite3.connect(store.path)) as other, other:
        triggers = other.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
        for (name,) in triggers:
            other.execute(f'DROP TRIGGER "{name}"')
        other.execute("UPDATE epoch SET c = c + 1e-3 WHERE number = 5")
        other.execute("UPDATE detail SET data = zeroblob(length(data)) WHERE id / 1024 = 9")
        other.execute("UPDATE reading SET utc = utc + 1 WHERE id = 2")
    done = Forwarder(store.path, address(server), "bank").send_waiting()
    assert (done.sent["epoch"], done.sent["reading"], done.refused) == (18, 2, 3)
    numbers = execute(server, "SELECT number FROM epoch ORDER BY 1")
    assert [n for (n,) in numbers] == [n for n in range(1, 21) if n not in (5, 9)]
    assert execute(server, "SELECT refused FROM station") == [(3,)]
