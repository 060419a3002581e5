"""The page under clients that read slowly, send nothing, or request everything."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.conftest import ENVIRONMENT
from tests.store.small import create_small_series, small_epoch, small_result
from thermocald.store.database.store import Store


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def serves(port: int) -> bool:
    with socket.socket() as channel:
        return channel.connect_ex(("127.0.0.1", port)) == 0


def resident_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def make_store(path: Path, epochs: int) -> None:
    with Store.open(path, "append", durable=False) as store:
        series = create_small_series(store)
        for k in range(1, epochs + 1):
            epoch = replace(small_epoch(k, interval_s=10.0), temperatures={"t": k / 9})
            store.append(series, epoch, small_result(k / 7))


class Page:
    """A page in a separate process."""

    def __init__(self, folder: Path, store: Path) -> None:
        self.port = free_port()
        command = [sys.executable, "-m", "thermocald", "dashboard", "--store", str(store)]
        self.process = subprocess.Popen(
            [*command, "--port", str(self.port)], cwd=folder, env=ENVIRONMENT
        )
        deadline = time.monotonic() + 60
        while True:
            try:
                self.get("/healthz")
                return
            except urllib.error.HTTPError:
                return
            except OSError:
                assert time.monotonic() < deadline
                time.sleep(0.05)

    def get(self, path: str) -> bytes:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=60) as answer:
            return answer.read()

    def slow(self, path: str) -> socket.socket:
        """Open a connection that sends a request and reads nothing."""
        channel = socket.socket()
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        channel.connect(("127.0.0.1", self.port))
        channel.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        return channel

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def page_of(tmp_path):
    pages = []

    def start(store: Path) -> Page:
        pages.append(Page(tmp_path, store))
        return pages[-1]

    yield start
    for page in pages:
        page.close()


CSV = "/api/series.csv?camera=rpi&series=M1"


@pytest.mark.slow
def test_slow_and_silent_clients_take_no_memory_and_hold_nobody_up(daemon, measured, page_of):
    make_store(daemon.store, 6000)
    daemon.run(**measured)
    daemon.more(2)
    page = page_of(daemon.store)
    assert len(page.get(CSV).splitlines()) == 6001
    before, count = resident_mb(page.process.pid), len(daemon.results())
    slow = [page.slow(CSV) for _ in range(50)]
    silent = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(30)]
    time.sleep(1.0)
    refused = 0
    for channel in slow:
        channel.setblocking(False)
        try:
            refused += b" 503 " in channel.recv(60)
        except BlockingIOError:
            continue
    begin = time.monotonic()
    for _ in range(10):
        page.get("/api/status")
        page.get("/api/columns?camera=rpi&series=M1&points=500")
    assert time.monotonic() - begin < 60.0  # on a busy machine
    assert refused == 46  # four are served at once
    assert resident_mb(page.process.pid) < before + 25.0
    # a silent client is disconnected
    for channel in silent:
        channel.settimeout(25.0)
        assert channel.recv(1) == b""
        channel.close()
    for channel in slow:
        channel.close()
    # the daemon beside it went on, at ten epochs a second
    assert daemon.stop() == 0
    results = daemon.results()
    assert len(results) - count > 5.0 * (time.monotonic() - begin)
    assert all(r["stored"] for r in results)


def test_a_port_in_use_is_one_error_and_the_daemon_goes_on(daemon, measured):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        daemon.configure(**measured, dashboard={"enabled": True, "port": port})
        daemon.start(INVOCATION_ID="")
        daemon.until(lambda: "acquisition goes on without it" in daemon.log())
        daemon.more(4)
        assert daemon.log().count("in use by another program") == 1
        assert "the page is at" not in daemon.log()
        daemon.until(
            lambda: "cannot be used" in daemon.status().get("dashboard", {}).get("why", "")
        )
        assert daemon.stop() == 0


def test_the_page_follows_the_configuration_and_ends_with_a_killed_daemon(daemon, measured):
    """A port changed by SIGHUP was ignored; a killed daemon's page kept the port for itself."""
    ports = free_port(), free_port()
    # what the command line demands stays demanded
    daemon.configure(**measured, dashboard={"port": ports[0]}, store={"path": "other.db"})
    daemon.start("--dashboard", "--store", str(daemon.store), INVOCATION_ID="")
    daemon.until(lambda: serves(ports[0]))
    daemon.configure(**measured, dashboard={"port": ports[1]}, store={"path": "other.db"})
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: serves(ports[1]))
    assert not serves(ports[0])
    assert daemon.status()["dashboard"]["why"] == ""
    daemon.kill()
    daemon.until(lambda: not serves(ports[1]), alive=False)
    assert "takes effect after a restart" not in daemon.log()


def test_under_systemd_the_page_is_not_the_daemons_child(daemon, measured):
    daemon.configure(**measured, dashboard={"enabled": True, "port": free_port()})
    daemon.start(INVOCATION_ID="0" * 32)
    daemon.more(4)
    children = Path(f"/proc/{daemon.process.pid}/task/{daemon.process.pid}/children")
    assert children.read_text().split() == []
    assert daemon.stop() == 0


ROUTES = (
    "/", "/static/page.js", "/static/page.css", "/static/plotly.js", "/api/status", "/api/series",
    "/api/columns?camera=rpi&series=M1&points=1000", "/api/columns?camera=rpi&series=M1&last=3600",
    "/api/events", CSV, "/metrics",
)  # fmt: skip


@pytest.mark.slow
def test_the_page_keeps_to_80_mb_however_often_it_is_asked(tmp_path, page_of):
    """Every route in turn: 30 rounds are a month of one visit a day."""
    rounds = 30
    make_store(tmp_path / "s.db", 2000)
    page = page_of(tmp_path / "s.db")
    resident = []
    for _ in range(rounds):
        for route in ROUTES:
            page.get(route)
        resident.append(resident_mb(page.process.pid))
    print(f"{resident[0]:.1f} MB after one round, at most {max(resident):.1f} MB")
    assert max(resident) < 80.0
    assert np.mean(resident[-4:]) < np.mean(resident[rounds // 4 :][:4]) + 2.0
