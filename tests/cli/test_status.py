"""`status` and `top` at 80 columns and in a pipe, and other texts; `q` leaves `top`."""

from __future__ import annotations

import io
import os
import pty
import sys
import termios

import pytest

from tests.commands import succeed
from thermocald.analysis.online.observer import Equilibrium
from thermocald.cli import common, run
from thermocald.cli.run import WIDTH, status_lines
from thermocald.daemon.desk import Follower
from thermocald.daemon.live_state import status_warnings
from thermocald.daemon.session import Session
from thermocald.errors import ThermocaldError, UsageError
from thermocald.numbers import duration

LONG = "/srv/recordings/2026/under-the-old-bridge/second-arch/thermocald-left-bank.db"
PROBE = "/sys/bus/w1/devices/28-000000bfe244/temperature"
DRIFTING = Equilibrium("drifting", 1.1085, 0.0014757, 754.0, 0.4).sentence
LAST = {
    "epoch": 12345, "temperature": 27.4375, "status": "ok", "sigma0": 1.179,
    "c": 3.040494087, "x0": 0.010896880, "y0": -0.0187439, "sd_c": 0.0003011,
    "sd_x0": 0.00050576, "sd_y0": 0.00049938, "drift_c_px": 0.3755, "sd_drift_c_px": 0.325,
    "online": {"sentence": DRIFTING,
               "orientation": "the mount moves by 0.032 px about one orientation (101 epochs)"},
}  # fmt: skip
FEW = {"status": "too_few", "reason": f"only 3 targets are found in the frame {LONG}/17.jpg"}
CAMERA = {
    "series": "watch", "device": "open", "lost": 0, "skipped": 2, "late_p99_s": 0.0431, "why": "",
    "deferred": 0, "caught_up": 0,
}  # fmt: skip
FULL = {"state": "waiting", "why": f"{LONG}: disk is full", "waiting": 3, "lost": 0}


def document(store=FULL):
    gone = {"device": "waiting", "last": {}, "faults": 1, "why": f"{PROBE} is gone since 12:04"}
    status = {
        "version": "0.1.0", "pid": 30190, "utc": 1e9 + 95.0, "started": 1e9, "age_s": 0.4,
        "stalled": [], "sessions": {}, "clock": {"trusted": False}, "frames": {"paused": ""},
        "cameras": {"pi-under-the-bridge": CAMERA | {"last": LAST},
                    "a-phone-with-a-long-name": CAMERA | {"last": LAST | FEW}},
        "thermometers": {
            "housing": {"device": "open", "last": {"temperature": 27.5}, "faults": 0, "why": ""},
            "second-arch-downstream": gone,
        },
        "store": store, "outputs": {},
    }  # fmt: skip
    return status | {"warnings": status_warnings(status)}


def test_status_fits_into_80_columns_and_breaks_no_path():
    lines = status_lines(document())
    assert all(len(line) <= WIDTH for line in lines if "/" not in line)
    text = "\n".join(lines)
    assert LONG in text
    assert PROBE in text
    assert "…" not in text
    assert "pi-under-the-bridge/watch: open, epoch 12345 at 27.44 °C" in lines
    assert "  c  3.04049 ± 0.00030 mm         moved 0.38 ± 0.33 px since the start" in lines
    assert "  the mount moves by 0.032 px about one orientation (101 epochs)" in lines
    assert "for 2 minutes" in lines[0]
    assert "1 fault\n" in text
    # a drift has the digits of its sd: it was `1.11 ± 0.00 px/min`, `ready in about 13 ± 0 min`
    assert "drifting 1.1085 ± 0.0015 px/min, ready in about 12.5667 ± 0.0067 min" in text
    assert Equilibrium("ready", 0.0123, 0.0041).sentence == "ready: 0.0123 ± 0.0041 px/min"
    little = document({"state": "results_only", "why": "", "waiting": 0, "lost": 0})
    assert "! store: its disk is nearly full: results are stored" in "\n".join(status_lines(little))


@pytest.fixture
def terminal(monkeypatch):
    """A keyboard: what is written to it is typed."""
    master, slave = pty.openpty()
    with os.fdopen(slave, "rb", buffering=0) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield master, slave
    os.close(master)


def test_q_leaves_top_and_the_terminal_is_as_before(terminal, monkeypatch):
    master, slave = terminal
    before = termios.tcgetattr(slave)
    asked = []

    def read(*_):
        if not asked:  # the terminal is set up: what was typed before is lost
            os.write(master, b"xq")
        asked.append(1)
        return document()

    monkeypatch.setattr(run, "read_status", read)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    run.top(interval=30.0)
    assert len(asked) == 2  # the first picture, and one more after x
    assert termios.tcgetattr(slave) == before
    assert "pi-under-the-bridge" in sys.stdout.getvalue()


def test_top_in_a_pipe_writes_lines_until_it_ends(monkeypatch, capsys):
    left = [document(), document()]
    monkeypatch.setattr(run, "read_status", lambda *_: left.pop())
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    with pytest.raises(IndexError):
        run.top(interval=0.01)
    said = capsys.readouterr().out
    assert said.count("thermocald 0.1.0, pid 30190") == 2
    assert "\x1b" not in said


def test_durations_are_as_a_person_says_them():
    """Wrong forms were `in 1 minutes` and `for 0.0 h`."""
    said = [duration(seconds) for seconds in (0, 1, 42, 89, 1500, 7200, 12 * 86400)]
    assert said == [
        "0 seconds", "1 second", "42 seconds", "1 minute", "25 minutes", "2.0 hours", "12 days"
    ]  # fmt: skip


def test_the_line_of_a_session_stays_one_line(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "80")
    one = {"found": [], "last": LAST, "state": "running", "why": "", "taken": 1}
    Follower(Session(camera="a", series="M1", epochs=150), print).follow(one)
    line = terminal.getvalue().removeprefix("\r\x1b[K")
    assert len(line) == 79
    assert "c 3.04049 ± 0.00030 mm" in line


def test_the_configuration_is_looked_for_here_then_in_etc(monkeypatch, tmp_path):
    places = (tmp_path / "config.yaml", tmp_path / "etc.yaml")
    monkeypatch.setattr(common, "CONFIG_PLACES", places)
    for command, given in (
        ("status", ".* --store FILE"), ("run", "one of --config FILE, --mock"),
        ("session status", "--config FILE$"), ("session start", "--config FILE, or --mock$"),
    ):  # fmt: skip
        neither = rf"neither \./config\.yaml nor /etc/thermocald/config\.yaml; give {given}"
        with pytest.raises(UsageError, match=neither):
            succeed(*command.split())
    for place, store in ((places[1], "there.db"), (places[0], "here.db")):
        place.write_text(f"store: {{path: {store}}}\nthermometers: [{{name: h, driver: mock}}]\n")
        with pytest.raises(ThermocaldError, match=f"no daemon is running for .*/{store}"):
            succeed("status")
