"""Faults between stations and a server: each is reported clearly, and nothing is lost."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from tests.fleet.conftest import address, count, execute, new_cluster
from thermocald.cli.server import find_tasks
from thermocald.errors import (
    RecordingError,
    ServerError,
    ServerGone,
    StoreVersionError,
    TestFieldError,
)
from thermocald.fleet.forward import Forwarder
from thermocald.store.database.store import Store
from thermocald.store.server.connection import ServerAddress, create_tables, grant
from thermocald.store.server.fleet_reader import FleetReader
from thermocald.store.server.reader import ServerStore


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
        ("testfield SET csv = replace(csv, 'target,', 'target,x,')", TestFieldError, "line"),
        ("series SET head = replace(head, 'interval\": ', 'interval\": -')", RecordingError, "key"),
    ):
        execute(server, f"UPDATE {change}")
        with ServerStore(there) as found, pytest.raises(error, match=where + what):
            found.all_series()
    with FleetReader(there) as fleet, pytest.raises(RecordingError, match=where + "key"):
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
        with pytest.raises(StoreVersionError, match=said):
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
