"""Reports to the outside: the journal's fields, and `thermocald status`."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import time
from functools import partial

import pytest

from tests.commands import call
from thermocald.daemon.systemd import JournalHandler


class Journal:
    """A journal's socket; its entries as dictionaries."""

    def __init__(self, path) -> None:
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self._socket.settimeout(5)

    def entry(self) -> dict[str, str]:
        data, fields = self._socket.recv(1 << 18), {}
        while data:
            line, _, data = data.partition(b"\n")
            name, equals, value = line.partition(b"=")
            if not equals:  # systemd.journal: name, length as 64 bit, data
                size = int.from_bytes(data[:8], "little")
                value, data = data[8 : 8 + size], data[8 + size + 1 :]
            fields[name.decode()] = value.decode()
        return fields

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path / "journal")
    yield journal
    journal.close()


@pytest.fixture
def log(journal, monkeypatch):
    monkeypatch.setattr("thermocald.daemon.systemd._SOCKET", journal.path)
    handler = JournalHandler()
    log = logging.Logger("thermocald.acquisition.device_loop")  # noqa: LOG001 - apart from pytest's
    log.addHandler(handler)
    yield log
    handler.close()


def test_lines_and_forged_fields_in_a_message_stay_in_the_message(log, journal):
    """A device's answer must not write fields."""
    message = "first\nPRIORITY=0\nMESSAGE=forged = yes\nlast"
    log.error("%s", message, extra={"device": "a\nTHERMOCALD_EVENT=forged"})
    entry = journal.entry()
    assert entry["MESSAGE"] == message
    assert entry["PRIORITY"] == "3"
    assert entry["THERMOCALD_DEVICE"] == "a\nTHERMOCALD_EVENT=forged"
    assert "THERMOCALD_EVENT" not in entry
    log.debug("x")
    assert journal.entry()["PRIORITY"] == "7"


def test_without_a_journal_it_goes_to_standard_error(log, journal, capsys):
    journal.close()
    log.error("nobody listens")
    assert "nobody listens" in capsys.readouterr().err


def test_the_daemon_tells_the_journal_what_a_device_did(daemon, devices, journal):
    """With systemd's environment; only the socket's path is not systemd's."""
    daemon.configure(**devices(camera=[{"kind": "unplugged", "at": 3}]))
    script = (
        "import sys, thermocald.daemon.systemd as j; "
        f"j._SOCKET = {journal.path!r}; "
        f"sys.argv = ['thermocald', 'run', '--config', {str(daemon.config)!r}]; "
        "from thermocald.cli import main; main()"
    )
    daemon.process = daemon.forker.start(daemon.folder, script=script, JOURNAL_STREAM="8:1")
    found: dict[str, dict[str, str]] = {}
    deadline = time.monotonic() + 60
    while "device_back" not in found:
        assert time.monotonic() < deadline
        try:
            entry = journal.entry()
        except TimeoutError:
            continue
        found[entry.get("THERMOCALD_EVENT", "")] = entry
    daemon.stop()
    assert found["started"]["PRIORITY"] == "6"
    out = found["device_out"]
    assert out["MESSAGE"].startswith("camera one is out: ")
    assert (out["PRIORITY"], out["SYSLOG_IDENTIFIER"]) == ("4", "thermocald")
    assert (out["THERMOCALD_DEVICE"], out["THERMOCALD_THREAD"]) == ("one", "camera one")
    assert out["THERMOCALD_LOGGER"] == "thermocald.acquisition.device_loop"
    assert out["CODE_FILE"].endswith("device_loop.py")
    assert int(out["CODE_LINE"]) > 0


def test_status_says_how_it_is_in_json_and_fails_where_nothing_runs(daemon, measured):
    status = partial(call, "status", "--store", daemon.store)
    gone = status()
    assert (gone.returncode, gone.stderr.count("\n")) == (1, 1)
    daemon.run(**measured)
    daemon.until(lambda: daemon.status() and daemon.status()["cameras"]["rpi"]["last"])
    told = status("--json", "-")
    document = json.loads(told.stdout)
    assert document["pid"] == daemon.process.pid
    assert document["cameras"]["rpi"]["device"] == "open"
    assert document["thermometers"]["recorded"]["last"]["temperature"] == pytest.approx(25, abs=3)
    daemon.signal(signal.SIGSTOP)  # or a card that has become read-only
    os.utime(daemon.store.with_name(f"{daemon.store.name}.live") / "status.json", (0, 0))
    silent = status()
    assert (silent.returncode, "the daemon hangs, or" in silent.stderr) == (1, True)
    daemon.kill()
    killed = status()
    assert killed.returncode == 1
    assert "was killed" in killed.stderr


def test_the_daemon_of_a_store_is_found_also_as_one_of_several(tmp_path, monkeypatch):
    from thermocald.daemon import live_state

    monkeypatch.setattr(live_state, "_RUN", tmp_path / "run")
    for name in ("thermocald", "thermocald-roof", "other"):
        folder = tmp_path / "run" / name
        store = {"store": {"path": str(tmp_path / f"{name}.db")}}
        live_state.LiveState(folder).write_status(store)
    for name in ("thermocald", "thermocald-roof"):
        assert live_state.find_state(tmp_path / f"{name}.db") == tmp_path / "run" / name
    assert live_state.find_state(tmp_path / "other.db") == tmp_path / "other.db.live"
