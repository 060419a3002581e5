"""Faults between stations and a server: each is reported clearly, and nothing is lost."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
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
    StoreError,
    StoreVersionError,
    TestFieldError,
)
from thermocald.fleet.forward import Forwarder
from thermocald.store.database.store import Store
from thermocald.store.server.connection import ServerAddress, create_tables, grant
from thermocald.store.server.fleet_reader import FleetReader
from thermocald.store.server.reader import ServerStore

HOSTILE = ["x'); DROP TABLE epoch; --", 'a"b', "%s", "{0}", "$1", "; SELECT pg_sleep(9)", "é\\'"]


def test_names_are_values_and_never_statements(server, tmp_path, head, field, make_epoch):
    """Any names of station, camera, series, channel and extra column are stored and selected by."""
    base = Path(server.address(name="thermocald"))
    for evil in HOSTILE:
        channel = evil.translate(str.maketrans("", "", ",;='\"\\/")).strip()
        camera = replace(head.camera, name=evil)
        hostile = replace(head, series=evil, camera=camera,
                          channels={channel: head.channels["temperature"]})  # fmt: skip
        path = tmp_path / f"{HOSTILE.index(evil)}.db"
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
    assert count(server, "epoch") == len(HOSTILE)
    tasks = find_tasks([base], tmp_path / "out", "discover")
    assert {task[1].parent for task in tasks} == {tmp_path / "out"}


def test_what_is_wrong_with_a_series_names_the_server_as_it_was_given(filled, server):
    """As a path, the address had lost a slash."""
    store, _ = filled
    Forwarder(store.path, address(server), "bank").send_waiting()
    where = f"^postgresql://owner@127.0.0.1:{server.port}/thermocald, "
    execute(server, "UPDATE testfield SET csv = replace(csv, 'target,', 'target,x,')")
    with (
        ServerStore(address(server)) as there,
        pytest.raises(TestFieldError, match=where + "line"),
    ):
        there.all_series()
    execute(server, "UPDATE series SET head = replace(head, 'interval\": ', 'interval\": -')")
    with ServerStore(address(server)) as there, pytest.raises(RecordingError, match=where + "key"):
        there.all_series()
    with FleetReader(address(server)) as fleet, pytest.raises(RecordingError, match=where + "key"):
        fleet.cameras(2e9)


def test_a_newer_server_is_told_from_an_older_one(filled, server):
    store, _ = filled
    execute(server, "UPDATE thermocald_version SET version = 9999")
    there = address(server)
    forwarder = Forwarder(store.path, there, "b")
    for use in (forwarder.send_waiting, lambda: ServerStore(there), lambda: FleetReader(there)):
        with pytest.raises(StoreVersionError, match="update thermocald here"):
            use()
    execute(server, "UPDATE thermocald_version SET version = 0")
    with pytest.raises(StoreVersionError, match="server init"):
        Forwarder(store.path, there, "b").send_waiting()
    execute(server, "UPDATE thermocald_version SET version = 1")
    assert Forwarder(store.path, address(server), "b").send_waiting().rows == 20


@pytest.fixture
def small_disk():
    """A disk of 16 MB that belongs to PostgreSQL's user."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("nothing can be mounted here: needs root")
    folder = tempfile.mkdtemp(prefix="thermocald-disk-")
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", folder]
    if subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("nothing can be mounted here")
    Path(folder).chmod(0o755)
    (Path(folder) / "space").mkdir()
    shutil.chown(Path(folder) / "space", "postgres")
    yield Path(folder)
    subprocess.run(["umount", "-l", folder], check=False)
    Path(folder).rmdir()


@pytest.mark.slow
def test_a_full_disk_of_the_server_is_said_and_made_up_for(small_disk, filled):
    store, series = filled
    with new_cluster() as server:
        with psycopg.connect(server.address(), autocommit=True) as connection:
            connection.execute(f"CREATE TABLESPACE small LOCATION '{small_disk / 'space'}'")
            connection.execute("CREATE DATABASE thermocald TABLESPACE small")
        create_tables(address(server))
        free = shutil.disk_usage(small_disk).free
        (small_disk / "ballast").write_bytes(b"x" * (free - 300_000))
        again = next(store.epochs(series, 20, 20)).epoch
        for number in range(1001, 1801):
            store.append(series, replace(again, number=number))
        forwarder = Forwarder(store.path, address(server), "bank", batch=20)
        with pytest.raises(ServerGone, match=r"disk is full; .*nothing is lost here"):
            forwarder.send_waiting()
        assert 0 < count(server, "epoch") < 820
        (small_disk / "ballast").unlink()
        forwarder.send_waiting()
        with ServerStore(address(server)) as there:
            numbers = there.series_columns(there.find_series(), ["epoch"])["epoch"].tolist()
        assert numbers == [*range(1, 21), *range(1001, 1801)]


@pytest.fixture
def certificates(tmp_path):
    """An authority, and certificates of a server and of the station `pi`, also expired ones;
    and one of `pi` that no authority signed.
    """
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")

    def openssl(*arguments):
        subprocess.run(["openssl", *arguments], cwd=tmp_path, check=True, capture_output=True)

    made = ("req", "-newkey", "rsa:2048", "-nodes")
    for name, common in (("ca", "ca"), ("foreign", "pi")):
        openssl(*made, "-x509", "-subj", f"/CN={common}", "-keyout", f"{name}.key",
                "-out", f"{name}.crt")  # fmt: skip
    (tmp_path / "foreign.key").chmod(0o600)
    for name, common, days in (("server", "localhost", "2"), ("stale", "localhost", "-1"),
                               ("pi", "pi", "2"), ("late", "pi", "-1")):  # fmt: skip
        openssl(*made, "-subj", f"/CN={common}", "-keyout", f"{name}.key", "-out", f"{name}.csr")
        openssl("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.crt", "-CAkey", "ca.key",
                "-CAcreateserial", "-days", days, "-out", f"{name}.crt")  # fmt: skip
        (tmp_path / f"{name}.key").chmod(0o600)
    return tmp_path


@pytest.mark.slow
def test_certificates(certificates, filled):
    """A client certificate suffices; an expired or foreign one, of either side, is reported."""
    store, _ = filled

    def use(server, of: str) -> None:
        for name in (f"{of}.crt", f"{of}.key", "ca.crt"):
            target = server.folder / "data" / name.replace(of, "server")
            shutil.copy(certificates / name, target)
            target.chmod(0o600)
            if server.user:
                shutil.chown(target, "postgres")

    def prepare(server):
        use(server, "server")
        (server.folder / "data" / "pg_hba.conf").write_text(
            "hostssl all pi 127.0.0.1/32 cert\nhost all all 127.0.0.1/32 scram-sha-256\n"
        )
        server.options = "-c ssl=on -c ssl_ca_file=ca.crt"

    def send(certificate="pi", root="ca") -> int:
        query = (
            f"?sslmode=verify-full&sslrootcert={certificates}/{root}.crt&hostaddr=127.0.0.1"
            f"&sslcert={certificates}/{certificate}.crt&sslkey={certificates}/{certificate}.key"
        )
        place = f"postgresql://pi@localhost:{server.port}/thermocald{query}"
        return Forwarder(store.path, ServerAddress.parse(place), "bank").send_waiting().rows

    with new_cluster(prepare) as server:
        with psycopg.connect(server.address(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE thermocald")
            connection.execute("CREATE ROLE pi LOGIN")
        create_tables(address(server))
        grant(address(server), "pi", writes=True)
        with pytest.raises(ServerError, match="certificate") as late:
            send("late")
        with pytest.raises(ServerError, match="of another authority") as unknown:
            send("foreign")
        with pytest.raises(ServerError, match="certificate is not accepted"):
            send(root="foreign")
        use(server, "stale")
        server.stop("fast")
        server.start()
        with pytest.raises(ServerError, match="certificate is not accepted; is it expired") as old:
            send()
        for told in (late, unknown, old):
            assert not isinstance(told.value, ServerGone)
        use(server, "server")
        server.stop("fast")
        server.start()
        assert send() == 20


def test_a_path_that_is_not_there_is_said(tmp_path):
    with pytest.raises(StoreError):
        Forwarder(tmp_path / "none.db", ServerAddress.parse("postgresql://h/d"), "b").send_waiting()
