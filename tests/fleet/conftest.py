"""A real PostgreSQL on loopback, and the small store of tests/store to forward to it."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from glob import glob
from pathlib import Path

import pytest

import thermocald as tc
from tests.store.conftest import (  # for `filled`
    field,
    filled,
    head,
    make_epoch,
    make_result,
    series,
    small_store,
    store,
    store_path,
)
from thermocald.store.database.store import Store
from thermocald.store.server.connection import ServerAddress

__all__ = [
    "field", "filled", "head", "make_epoch", "make_result", "series", "small_store", "store",
    "store_path",
]  # fmt: skip


def address(server: Server, query: str = "", **given: str) -> ServerAddress:
    """The address of the database `thermocald` of a cluster."""
    return ServerAddress.parse(server.address(query, name="thermocald", **given))


def execute(server: Server, statement: str, *values: object) -> list[tuple]:
    """Return a statement's rows in the database `thermocald`."""
    import psycopg

    with psycopg.connect(server.address(name="thermocald")) as connection:
        cursor = connection.execute(statement, values or None)
        return cursor.fetchall() if cursor.description else []


def count(server: Server, table: str) -> int:
    """Return the number of rows of a table in the database `thermocald`."""
    return execute(server, f"SELECT count(*) FROM {table}")[0][0]


class Server:
    """A cluster in a folder, which can be stopped and started repeatedly."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self.programs, self.folder, self.data = programs, folder, folder / "data"
        self.options = ""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        # PostgreSQL refuses to run as root
        self.user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        if self.user:
            shutil.chown(folder, "postgres")
        (folder / "password").write_text("secret\n")
        self.run("initdb", "-A", "scram-sha-256", "-U", "owner", f"--pwfile={folder}/password",
                 "--no-sync")  # fmt: skip

    def run(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [*self.user, self.programs / program, "-D", self.data, *arguments],
            check=True, stdout=subprocess.DEVNULL, cwd="/", timeout=60,
        )  # fmt: skip

    def start(self) -> None:
        options = (
            f"-p {self.port} -c listen_addresses=127.0.0.1 -c fsync=off "
            f"-c unix_socket_directories={self.folder} {self.options}"
        )
        self.run("pg_ctl", "-w", "-o", options, "-l", str(self.folder / "log"), "start")

    def stop(self, mode: str = "immediate") -> None:
        self.run("pg_ctl", "-w", "-m", mode, "stop")

    def address(self, query="", *, user="owner:secret", name="postgres") -> str:
        return f"postgresql://{user}@127.0.0.1:{self.port}/{name}{query}"


@pytest.fixture(scope="session")
def cluster():
    with new_cluster() as server:
        yield server


@contextmanager
def new_cluster(prepare=lambda server: None):
    """Make a new cluster; prepare(server) is called before it is started."""
    found = shutil.which("initdb") or max(glob("/usr/lib/postgresql/*/bin/initdb"), default=None)
    if found is None:
        pytest.skip("PostgreSQL is not installed (apt install postgresql)")
    pytest.importorskip("psycopg", reason="pip install thermocald[server]")
    # not among pytest's folders: another user must reach it through every folder above
    folder = Path(tempfile.mkdtemp(prefix="thermocald-postgres-"))
    folder.chmod(0o755)
    server = Server(Path(found).parent, folder)
    prepare(server)
    server.start()
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder)


@pytest.fixture(scope="session")
def template(cluster):
    """A database with the tables, since copying is faster than making them."""
    import psycopg

    from thermocald.store.server.connection import create_tables

    with psycopg.connect(cluster.address(), autocommit=True) as connection:
        connection.execute("CREATE DATABASE initialised")
    create_tables(ServerAddress.parse(cluster.address(name="initialised")))
    return "initialised"


@pytest.fixture
def server(cluster, template):
    """The cluster with an empty, initialised database `thermocald`."""
    import psycopg

    with psycopg.connect(cluster.address(), autocommit=True) as connection:
        connection.execute("DROP DATABASE IF EXISTS thermocald WITH (FORCE)")
        connection.execute(f"CREATE DATABASE thermocald TEMPLATE {template}")
    return cluster


@pytest.fixture
def station(tmp_path, store_path, head, field, make_epoch, make_result):
    """A store of 20 epochs with frames of 1000 bytes; 7 and 13 have no result."""
    folder = tmp_path / "frames"
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for n in range(1, 21):
            frame = Path("rpi", "M1", f"{n:07d}.jpg")
            (folder / frame).parent.mkdir(parents=True, exist_ok=True)
            (folder / frame).write_bytes(bytes([n]) * 1000)
            result = make_result(n, "no_targets" if n in (7, 13) else "ok")
            store.append(series, replace(make_epoch(n), frame=frame), result)
    return store_path, folder


@pytest.fixture(scope="session")
def archive(tmp_path_factory):
    """Two recordings of one camera, 40 epochs each."""
    folder = tmp_path_factory.mktemp("archive")
    for name in ("M1", "M2"):
        tc.simulate("rpi-v2.1-heating", seed=1, series=name, epochs=40, out=folder / name)
    return folder
