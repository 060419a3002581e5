"""Forwarding: all rows arrive once and unchanged, whatever fails on the way."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from thermocald import errors
from thermocald.config import ForwardConfig
from thermocald.errors import ServerError, ServerGone, StoreError, UsageError
from thermocald.fleet.forward import Forwarder, forward_forever
from thermocald.store.series import Event, LoggedReading

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from tests.commands import succeed
from tests.fleet.conftest import address, count, execute, new_cluster
from thermocald.cli.server import find_tasks
from thermocald.store.database.store import Store
from thermocald.store.schema import COLUMN_NAMES
from thermocald.store.server.connection import ServerAddress, create_tables, grant
from thermocald.store.server.fleet_reader import FleetReader
from thermocald.store.server.reader import ServerStore, ServerWriter


def forwarder(server, station, choose, user="owner:secret", **options):
    """A forwarder of a station's store, and of its frames by a rule."""
    (store, folder), rule = station, ForwardConfig(frames=choose, **options)
    return Forwarder(store, address(server, user=user), "bank", frames=folder, rule=rule)


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
        pi = address(server, user="pi:berry")
        events = forwarder(server, station, "events", user="pi:berry")
        with pytest.raises(ServerError, match="grant it"):
            events.send_waiting()
        grant(address(server), "pi", writes=True)
        assert dict(events.send_waiting().sent) == SENT | {"epoch": 20, "frame": 2}
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


def test_a_cursor_that_cannot_be_written_is_waited_for(filled, server):
    """Its unit is not started again after this exit status: nothing more was sent until a boot."""
    forwarder, pauses = Forwarder(filled[0].path, address(server), "bank"), []
    forwarder._path.mkdir()

    def wait(seconds):
        pauses.append(seconds)
        shutil.rmtree(forwarder._path, ignore_errors=True)
        return len(pauses) == 2

    forward_forever(forwarder, wait)
    assert (pauses, count(server, "epoch")) == ([300.0, 30.0], 20)


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


# --- frames: limited, resumable, checked, without effect on retention ------------------------


def there(server):
    rows = execute(server, "SELECT number, name, digest, data FROM frame ORDER BY number")
    return {number: (name, digest, data) for number, name, digest, data in rows}


@pytest.mark.parametrize(
    ("choose", "numbers"),
    [("events", [7, 13]), ("every_n", [5, 10, 15, 20]), ("all", list(range(1, 21)))],
)
def test_the_chosen_frames_arrive_whole(server, station, choose, numbers):
    done = forwarder(server, station, choose, every_n=5).send_waiting()
    assert done.sent["frame"] == len(numbers)
    found = there(server)
    assert [*found] == numbers
    for number, (name, digest, data) in found.items():
        assert (name, data) == (f"rpi/M1/{number:07d}.jpg", bytes([number]) * 1000)
        assert digest == hashlib.sha256(data).hexdigest()


def test_a_day_has_a_limit_and_the_next_goes_on(server, station):
    limited = forwarder(server, station, "all", frames_mb_per_day=0.0035)
    day = [1.7e9]
    limited._clock = lambda: day[0]
    assert limited.send_waiting().sent["frame"] == 3
    assert limited.send_waiting().sent["frame"] == 0
    day[0] += 86400
    assert limited.send_waiting().sent["frame"] == 3
    assert [*there(server)] == [1, 2, 3, 4, 5, 6]


def test_it_goes_on_where_the_network_failed(server, station, monkeypatch):
    send, calls = ServerWriter.write_frame, []

    def fails_twice(self, series, frame, data):
        calls.append(frame.number)
        if len(calls) in (4, 9):
            raise ServerGone("cut")
        send(self, series, frame, data)

    monkeypatch.setattr(ServerWriter, "write_frame", fails_twice)
    every = forwarder(server, station, "all")
    for _ in range(2):
        with pytest.raises(ServerGone):
            every.send_waiting()
    every.send_waiting()
    assert [*there(server)] == list(range(1, 21))
    assert len(calls) == 22  # each frame once, and the two that failed again


def test_what_retention_has_deleted_or_leads_out_of_the_folder_is_passed_over(
    server, station, tmp_path
):
    (tmp_path / "secret").write_text("key")
    frames = station[1] / "rpi/M1"
    for number in (1, 2, 3, 20):
        (frames / f"{number:07d}.jpg").unlink()
    (frames / "0000001.jpg").symlink_to(tmp_path / "secret")
    assert forwarder(server, station, "all").send_waiting().sent["frame"] == 16
    assert [*there(server)] == list(range(4, 20))


def test_the_server_refuses_a_frame_that_is_not_what_was_read(server, station, monkeypatch):
    wrong = SimpleNamespace(sha256=hashlib.md5)
    monkeypatch.setattr("thermocald.store.server.reader.hashlib", wrong)
    done = forwarder(server, station, "events").send_waiting()
    assert (done.sent["frame"], done.refused) == (0, 2)
    assert there(server) == {}


# --- `thermocald forward` with the daemon's configuration, as its unit starts it --------------


CONFIG = """
store: {path: small.db}
frames: {folder: frames}
thermometers: [{name: air, driver: mock}]
forward: {to: %s, station: gauge7, frames: events}
"""


def test_everything_comes_from_the_configuration(station, server, tmp_path, monkeypatch):
    passwords = tmp_path / "pgpass"
    passwords.write_text("127.0.0.1:*:*:owner:secret\n")
    passwords.chmod(0o600)
    monkeypatch.setenv("PGPASSFILE", str(passwords))
    config = station[0].with_name("config.yaml")
    config.write_text(CONFIG % "null")
    assert "nothing is sent" in succeed("forward", "--config", config).stderr
    config.write_text(CONFIG % server.address(user="owner", name="thermocald"))
    result = succeed("forward", "--config", config, "--once", "--json", "-")
    assert [count(server, t) for t in ("epoch", "frame", "station")] == [20, 2, 1]
    assert "secret" not in result.output


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(UsageError, match="give STORE and --to"):
        succeed("forward")
    with pytest.raises(StoreError):
        succeed("forward", tmp_path / "none.db", "--to", "postgresql://h/d", "--once")


# --- faults between stations and a server: each is reported clearly, and nothing is lost -------


@pytest.mark.parametrize(
    "evil",
    ["x'); DROP TABLE epoch; --", 'a"b', "%s", "{0}", "$1", "; SELECT pg_sleep(9)", "é\\'"],
)
def test_names_are_values_and_never_statements(server, tmp_path, head, field, make_epoch, evil):
    """Any names of station, camera, series, channel and extra column are stored and selected by."""
    base, path = Path(server.address(name="thermocald")), tmp_path / "evil.db"
    channel = evil.translate(str.maketrans("", "", ",;='\"\\/")).strip()
    hostile = replace(head, series=evil, camera=replace(head.camera, name=evil),
                      channels={channel: head.channels["temperature"]})  # fmt: skip
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(hostile, field)
        epoch = replace(make_epoch(1), temperatures={channel: 21.5})
        store.append(series, epoch, extra={f"x{evil}": 2.0})
    Forwarder(path, address(server), evil).send_waiting()
    narrowed = ServerAddress.parse(base).narrowed(evil, evil, evil)
    with ServerStore.open(narrowed) as there:
        (found,) = there.all_series()
        columns = there.series_columns(found, [channel, f"x{evil}", "epoch"])
        assert [float(c[0]) for c in columns.values()] == [21.5, 2.0, 1.0]
        assert len([*there.epochs(found)]) == 1
    with FleetReader(ServerAddress.parse(narrowed)) as fleet:
        (record,) = fleet.cameras(2e9)
        assert (record.station, record.camera) == (evil, evil)
    with pytest.raises(ServerError, match="was not granted"):
        grant(address(server), evil, writes=True)
    assert count(server, "epoch") == 1
    (task,) = find_tasks([base], tmp_path / "out", "discover")
    assert task[1].parent == tmp_path / "out"


def test_what_is_wrong_with_a_series_names_the_server_as_it_was_given(filled, server):
    """As a path, the address had lost a slash."""
    there = address(server)
    Forwarder(filled[0].path, there, "bank").send_waiting()
    where = f"^postgresql://owner@127.0.0.1:{server.port}/thermocald, "
    for change, error, what in (
        ("testfield SET csv = replace(csv, 'target,', 'target,x,')", errors.TestFieldError, "line"),
        (
            "series SET head = replace(head, 'interval\": ', 'interval\": -')",
            errors.RecordingError,
            "key",
        ),
    ):
        execute(server, f"UPDATE {change}")
        with ServerStore(there) as found, pytest.raises(error, match=where + what):
            found.all_series()
    with FleetReader(there) as fleet, pytest.raises(errors.RecordingError, match=where + "key"):
        fleet.cameras(2e9)


def test_a_newer_server_is_told_from_an_older_one(filled, server):
    there = address(server)
    forwarder = Forwarder(filled[0].path, there, "b")
    newer, older = "update thermocald here", "server init"
    for version, use, said in (
        (9999, forwarder.send_waiting, newer), (9999, lambda: ServerStore(there), newer),
        (9999, lambda: FleetReader(there), newer), (0, forwarder.send_waiting, older),
    ):  # fmt: skip
        execute(server, f"UPDATE thermocald_version SET version = {version}")
        with pytest.raises(errors.StoreVersionError, match=said):
            use()
    execute(server, "UPDATE thermocald_version SET version = 1")
    assert forwarder.send_waiting().rows == 20


FULL = """CREATE FUNCTION fill() RETURNS trigger LANGUAGE plpgsql AS $$
  BEGIN RAISE 'could not extend file' USING ERRCODE = 'disk_full'; END $$;
CREATE TRIGGER fill BEFORE INSERT ON epoch FOR EACH ROW WHEN (NEW.number > 8)
  EXECUTE FUNCTION fill()"""


def test_a_full_disk_of_the_server_is_said_and_made_up_for(server, filled):
    execute(server, FULL)
    forwarder = Forwarder(filled[0].path, address(server), "bank", batch=4)
    with pytest.raises(ServerGone, match=r"disk is full; .*nothing is lost here"):
        forwarder.send_waiting()
    assert count(server, "epoch") == 8
    execute(server, "DROP TRIGGER fill ON epoch")
    assert forwarder.send_waiting().rows == 12
    assert count(server, "epoch") == 20


def make_certificate(folder: Path, name: str, common: str, days: str, *signed: str) -> None:
    """Write NAME.key and NAME.crt for a common name, signed by itself unless told by whom."""
    key = f"{name}.key"
    for command in (
        ["req", "-new", "-newkey", "rsa:2048", "-nodes", "-subj", f"/CN={common}", "-keyout", key,
         "-out", "request"],
        ["x509", "-req", "-in", "request", "-days", days, "-out", f"{name}.crt",
         *(signed or ["-signkey", key])],
    ):  # fmt: skip
        subprocess.run(["openssl", *command], cwd=folder, check=True, capture_output=True)
    (folder / key).chmod(0o600)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_certificates(filled, tmp_path):
    """A client certificate suffices; an expired one, or one of another authority, is reported."""
    by = "-CA", "ca.crt", "-CAkey", "ca.key"
    make_certificate(tmp_path, "ca", "ca", "2")
    make_certificate(tmp_path, "foreign", "pi", "2")
    make_certificate(tmp_path, "server", "localhost", "2", *by)
    make_certificate(tmp_path, "pi", "pi", "2", *by)
    make_certificate(tmp_path, "late", "pi", "-1", *by)

    def prepare(server):
        for name in ("server.crt", "server.key", "ca.crt"):
            shutil.copy(tmp_path / name, server.data)
            if server.user:
                shutil.chown(server.data / name, "postgres")
        (server.data / "pg_hba.conf").write_text(
            "hostssl all pi 127.0.0.1/32 cert\nhost all all 127.0.0.1/32 scram-sha-256\n"
        )
        server.options = "-c ssl=on -c ssl_ca_file=ca.crt"

    def send(certificate="pi", root="ca") -> int:
        query = (
            f"?sslmode=verify-full&sslrootcert={tmp_path}/{root}.crt&hostaddr=127.0.0.1"
            f"&sslcert={tmp_path}/{certificate}.crt&sslkey={tmp_path}/{certificate}.key"
        )
        place = f"postgresql://pi@localhost:{server.port}/thermocald{query}"
        return Forwarder(filled[0].path, ServerAddress.parse(place), "bank").send_waiting().rows

    with new_cluster(prepare) as server:
        with psycopg.connect(server.address(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE thermocald")
            connection.execute("CREATE ROLE pi LOGIN")
        create_tables(address(server))
        grant(address(server), "pi", writes=True)
        for wrong in ({"certificate": "late"}, {"certificate": "foreign"}, {"root": "foreign"}):
            with pytest.raises(ServerError, match="certificate is not accepted; is it") as told:
                send(**wrong)
            assert not isinstance(told.value, ServerGone)
        assert send() == 20
