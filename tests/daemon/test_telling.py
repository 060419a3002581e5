"""Reports to the outside: the journal's fields, and `thermocald status`."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import sys
import threading
from functools import partial

import pytest

from tests.commands import call
from thermocald.acquisition.device_loop import Link
from thermocald.cli import main
from thermocald.daemon import live_state
from thermocald.daemon.systemd import set_up_logging
from thermocald.errors import DeviceGone
from thermocald.hal import VirtualClock, open_device
from thermocald.output.dashboard.view import View


def entry(journal: socket.socket) -> dict[str, str]:
    """Return the fields of the journal's next entry."""
    data, fields = journal.recv(1 << 18), {}
    while data:
        line, _, data = data.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:  # systemd.journal: name, length as 64 bit, data
            size = int.from_bytes(data[:8], "little")
            value, data = data[8 : 8 + size], data[8 + size + 1 :]
        fields[name.decode()] = value.decode()
    return fields


def test_the_journal_is_told_what_a_device_did_and_no_message_forges_a_field(
    monkeypatch, tmp_path, capsys
):
    """With systemd's environment; without a journal, it goes to standard error."""
    monkeypatch.setattr("thermocald.daemon.systemd._SOCKET", str(tmp_path / "journal"))
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "journal"))
        journal.settimeout(5)
        set_up_logging("debug")
        log = logging.getLogger("thermocald.drivers")
        clock = VirtualClock()
        Link("camera", "one", open_device("camera", "mock", {}, clock), clock).do(fail)
        out = entry(journal)
        assert out["MESSAGE"] == "camera one is out: gone\nPRIORITY=0"
        assert (out["PRIORITY"], out["SYSLOG_IDENTIFIER"]) == ("4", "thermocald")
        assert (out["THERMOCALD_DEVICE"], out["THERMOCALD_EVENT"]) == ("one", "device_out")
        assert out["THERMOCALD_THREAD"] == threading.current_thread().name
        assert out["THERMOCALD_LOGGER"] == "thermocald.acquisition.device_loop"
        assert out["CODE_FILE"].endswith("device_loop.py")
        assert int(out["CODE_LINE"]) > 0
        for level, priority in ((logging.ERROR, "3"), (logging.INFO, "6"), (logging.DEBUG, "7")):
            log.log(level, "x", extra={"device": "a\nTHERMOCALD_EVENT=forged"})
            told = entry(journal)
            assert told["PRIORITY"] == priority
            assert told["THERMOCALD_DEVICE"] == "a\nTHERMOCALD_EVENT=forged"
            assert "THERMOCALD_EVENT" not in told
    log.error("nobody listens")
    assert "nobody listens" in capsys.readouterr().err
    logging.root.handlers[0].close()


def fail() -> None:
    raise DeviceGone("gone\nPRIORITY=0")


def test_status_says_how_it_is_in_json_and_fails_where_nothing_runs(daemon, measured):
    status = partial(call, "status", "--store", daemon.store)
    gone = status()
    assert (gone.returncode, gone.stderr.count("\n")) == (1, 1)
    daemon.run(**measured)
    daemon.until(lambda: daemon.status() and daemon.status()["cameras"]["rpi"]["last"])
    document = json.loads(status("--json", "-").stdout)
    assert document["pid"] == daemon.process.pid
    assert document["cameras"]["rpi"]["device"] == "open"
    assert document["thermometers"]["recorded"]["last"]["temperature"] == pytest.approx(25, abs=3)
    daemon.signal(signal.SIGSTOP)  # or a card that has become read-only
    os.utime(daemon.live / "status.json", (0, 0))
    silent = status()
    assert (silent.returncode, "the daemon hangs, or" in silent.stderr) == (1, True)
    daemon.kill()
    # its number belongs to another process, at the latest after booting: it counted as running
    live_state.LiveState(daemon.live)._write(
        "status.json", json.dumps({**document, "pid": os.getpid()}).encode()
    )
    killed = status()
    assert (killed.returncode, "was killed" in killed.stderr) == (1, True)


def test_a_page_that_is_started_before_its_daemon_finds_it(tmp_path, monkeypatch):
    """Systemd starts both at once: at every boot, the page said for ever that no daemon ran."""
    (tmp_path / "c.yaml").write_text(
        "{store: {path: t.db}, dashboard: {enabled: true}, thermometers: [{name: t, driver: mock}]}"
    )
    views, serve = [], "thermocald.output.dashboard.serve"
    monkeypatch.setattr(live_state, "_RUN", tmp_path / "run")
    monkeypatch.setattr(serve, lambda store, live, *_: views.append(View(store, live)))
    monkeypatch.setattr(sys, "argv", ["thermocald", "dashboard", "-c", str(tmp_path / "c.yaml")])
    with pytest.raises(SystemExit, match="0"):
        main()
    assert views[0].status() == {}
    started = live_state.LiveState(tmp_path / "run" / "thermocald")
    started.write_status({"store": {"path": str(tmp_path / "t.db")}})
    assert views[0].status()


def test_the_daemon_of_a_store_is_found_also_as_one_of_several(tmp_path, monkeypatch):
    monkeypatch.setattr(live_state, "_RUN", tmp_path / "run")
    for name in ("thermocald", "thermocald-roof", "other"):
        store, folder = tmp_path / f"{name}.db", tmp_path / "run" / name
        beside = tmp_path / f"{name}.db.live"
        for place in (folder, beside):  # one beside the store may be that of a killed daemon
            live_state.LiveState(place).write_status({"store": {"path": str(store)}})
        (tmp_path / f"link-{name}.db").symlink_to(store)
        for same in (store, folder / "../.." / store.name, tmp_path / f"link-{name}.db"):
            found = live_state.find_state(same).resolve()
            assert found == (beside if name == "other" else folder)
