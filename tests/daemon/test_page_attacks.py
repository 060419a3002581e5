"""The page beside a real daemon: its process, hostile clients, and what a browser shows."""

from __future__ import annotations

import os
import signal
import socket
import time
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from tests.output.test_dashboard import add_series, start_page


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


CSV = "/api/series.csv?camera=rpi&series=M1"
COLUMNS = "/api/columns?camera=rpi&series=M1"
ROUTES = (
    "/", "/static/page.js", "/static/page.css", "/static/plotly.js", "/api/status", "/api/series",
    f"{COLUMNS}&points=1000", f"{COLUMNS}&last=3600", "/api/events", CSV, "/metrics",
)  # fmt: skip


@pytest.mark.slow
def test_the_page_keeps_to_its_memory_and_slow_clients_hold_nobody_up(daemon, measured):
    """Every route in turn: 30 rounds are a month of one visit a day. Then clients that read
    slowly, or send nothing.
    """
    numbers = np.arange(1.0, 6001.0)
    add_series(daemon.store, "rpi", (1e9 + 10 * numbers).tolist(), numbers / 7)
    daemon.run(**measured)
    daemon.more(2)
    process, port = start_page(daemon.store, daemon.live)

    def get(path: str) -> bytes:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=60) as answer:
            return answer.read()

    with process, ExitStack() as ends:
        ends.callback(process.kill)  # also after a failure
        assert len(get(CSV).splitlines()) == 6001
        resident = []
        for _ in range(30):
            for route in ROUTES:
                get(route)
            resident.append(resident_mb(process.pid))
        print(f"{resident[0]:.1f} MB after one round, at most {max(resident):.1f} MB")
        assert max(resident) < 80.0
        # malloc gives a second thread an arena, which costs 2 MB once
        assert np.mean(resident[-4:]) < np.mean(resident[7:11]) + 4.0
        begin, count = time.monotonic(), len(daemon.results())
        slow, silent = (
            [socket.create_connection(("127.0.0.1", port)) for _ in range(n)] for n in (50, 30)
        )
        for channel in slow:  # they ask, and read nothing for a while
            channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            channel.sendall(f"GET {CSV} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        time.sleep(1.0)
        refused = 0
        for channel in slow:
            with suppress(BlockingIOError):
                refused += b" 503 " in channel.recv(60, socket.MSG_DONTWAIT)
        assert refused == 46  # four are served at once
        for _ in range(10):
            get("/api/status")
            get(f"{COLUMNS}&points=500")
        assert time.monotonic() - begin < 60.0  # on a busy machine
        assert resident_mb(process.pid) < resident[-1] + 25.0
        # a silent client is disconnected
        for channel in silent:
            channel.settimeout(25.0)
            assert channel.recv(1) == b""
        for channel in (*slow, *silent):
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


_UNLABELLED = """() => [...document.querySelectorAll('a, button, select, input, [tabindex="0"]')]
  .filter(e => e.offsetParent !== null && !e.closest('.js-plotly-plot'))
  .filter(e => !(e.textContent.trim() || e.getAttribute('aria-label')
    || e.getAttribute('aria-labelledby') || (e.labels && e.labels.length)))
  .map(e => e.outerHTML)"""
_WIDER = "() => document.documentElement.scrollWidth > document.documentElement.clientWidth + 1"
_DRAWN = """() => [...document.querySelectorAll('#course .scatterlayer path.js-line')]
  .filter(p => (p.getAttribute('d') || '').length > 20 && p.getBBox().width > 0).length >= 5"""
_FIGURES = "() => document.querySelector('#figures dd') !== null"


@pytest.fixture
def page(daemon):
    """Return a call for the address of the page of a daemon with some sections."""

    def start(**sections) -> str:
        port = free_port()
        daemon.run(**sections, dashboard={"enabled": True, "port": port})
        daemon.until(lambda: serves(port))
        return f"http://127.0.0.1:{port}/"

    yield start
    if daemon.process.poll() is None:
        daemon.stop()
    assert "Traceback" not in daemon.log()  # a page was open when the daemon stopped


@pytest.mark.slow
def test_it_is_live_on_desk_and_phone_light_and_dark_until_the_daemon_stops(
    daemon, devices, page, page_of
):
    # slow enough for a busy machine: a deferred epoch is calibrated later and not drawn
    address = page(**devices(period_s=1.5))
    daemon.more(3)
    desk = page_of(address)
    desk.wait_for_function(_FIGURES)
    epoch = int(desk.text_content("#figures dd").split()[0])
    desk.wait_for_function(
        f"() => parseInt(document.querySelector('#figures dd').textContent) > {epoch + 2}"
    )
    assert desk.text_content("#connection") == "live"
    for what in ("circle", "line"):
        desk.wait_for_function(f"() => document.querySelectorAll('#overlay {what}').length > 40")
    desk.wait_for_function("() => document.querySelector('#frame').naturalWidth > 300")
    for span in ("3600", "86400", ""):
        desk.check(f'input[name=span][value="{span}"]')
        desk.wait_for_function(_DRAWN)
    assert "started" in desk.text_content("#events")
    assert "housing" in desk.text_content("#devices")
    assert desk.evaluate(_UNLABELLED) == []
    assert desk.get_attribute("html", "lang") == "en"
    phone = page_of(address, width=390, color_scheme="dark")
    phone.wait_for_function(_FIGURES)
    phone.wait_for_function(_DRAWN)
    assert not phone.evaluate(_WIDER)
    colour = "getComputedStyle(document.body).backgroundColor"
    assert phone.evaluate(colour) != desk.evaluate(colour)
    reached = []
    for _ in range(12):
        phone.keyboard.press("Tab")
        focus = "document.activeElement.id || document.activeElement.className"
        reached.append(phone.evaluate(focus))
    assert reached[:2] == ["skip", "camera"]
    assert {"series", "download"} <= set(reached)
    assert desk.problems == phone.problems == []
    # a page that dies is started again
    children = Path(f"/proc/{daemon.process.pid}/task/{daemon.process.pid}/children")
    os.kill(int(children.read_text()), signal.SIGKILL)
    daemon.until(lambda: "it is started again" in daemon.log())
    daemon.until(lambda: serves(int(address.split(":")[2][:-1])))
    desk = page_of(address)
    desk.wait_for_function(_FIGURES)
    daemon.stop()
    desk.wait_for_function(
        "() => document.querySelector('#connection').textContent"
        ".startsWith('acquisition has stopped: no daemon has run since 20')"
    )
    assert "stored data are shown below" in desk.text_content("#state")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "state", "note"),
    [(1, "idle until a session begins", "no epoch of camera one is stored yet"),
     (0, "this daemon has no camera; its thermometers are listed under Devices",
      "there is no series yet")],
)  # fmt: skip
def test_without_an_epoch_it_says_why(devices, page, page_of, cameras, state, note):
    sections = devices(period_s=1.0, series=None)
    sections["cameras"] = sections["cameras"][:cameras]
    shown = page_of(page(**sections))
    shown.wait_for_function("() => document.querySelector('#course-note').textContent !== ''")
    assert shown.text_content("#state") == state
    assert shown.text_content("#course-note") == note
    assert "housing" in shown.text_content("#devices")
