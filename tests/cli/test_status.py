"""`status` and `top`: readable at 80 columns and in a pipe; `q` leaves `top`."""

from __future__ import annotations

import io
import os
import pty
import sys
import termios

import pytest

from thermocald.analysis.online.observer import Equilibrium
from thermocald.cli import run
from thermocald.cli.run import WIDTH, status_lines
from thermocald.daemon.live_state import status_warnings

LONG = "/srv/recordings/2026/under-the-old-bridge/second-arch/thermocald-left-bank.db"


def camera(**changes):
    last = {
        "epoch": 12345, "temperature": 27.4375, "status": "ok", "sigma0": 1.179,
        "c": 3.040494087, "x0": 0.010896880, "y0": -0.0187439, "sd_c": 0.0003011,
        "sd_x0": 0.00050576, "sd_y0": 0.00049938, "drift_c_px": 0.3755, "sd_drift_c_px": 0.325,
        "drift_x0_px": -0.8287, "sd_drift_x0_px": 0.5458,
        "online": {"sentence": Equilibrium("drifting", 1.1085, 0.0014757, 754.0, 0.4).sentence,
                   "orientation": "the mount moves by 0.032 px about one orientation (101 epochs)"},
        **changes,
    }  # fmt: skip
    return {
        "series": "watch", "device": "open", "last": last, "lost": 0, "skipped": 2,
        "late_p99_s": 0.0431, "why": "", "deferred": 0, "caught_up": 0,
    }  # fmt: skip


def document(**changes):
    gone = camera(status="too_few", reason=f"only 3 targets are found in the frame {LONG}/17.jpg")
    status = {
        "version": "0.1.0", "pid": 30190, "utc": 1e9 + 95.0, "started": 1e9, "age_s": 0.4,
        "stalled": [], "sessions": {}, "clock": {"trusted": False}, "frames": {"paused": ""},
        "store": {"state": "waiting", "why": f"{LONG}: database or disk is full", "waiting": 3,
                  "lost": 0},
        "cameras": {"pi-under-the-bridge": camera(), "a-phone-with-a-long-name": gone},
        "thermometers": {
            "housing": {"device": "open", "last": {"temperature": 27.5}, "faults": 0, "why": ""},
            "second-arch-downstream": {
                "device": "waiting", "last": {}, "faults": 1,
                "why": "/sys/bus/w1/devices/28-000000bfe244/temperature is gone since 12:04",
            },
        },
        "outputs": {}, **changes,
    }  # fmt: skip
    return status | {"warnings": status_warnings(status)}


def test_status_fits_into_80_columns_and_breaks_no_path():
    lines = status_lines(document())
    assert all(len(line) <= WIDTH for line in lines if "/" not in line)
    text = "\n".join(lines)
    assert LONG in text
    assert "/sys/bus/w1/devices/28-000000bfe244/temperature" in text
    assert "…" not in text
    assert "pi-under-the-bridge/watch: open, epoch 12345 at 27.44 °C" in lines
    assert "  c  3.04049 ± 0.00030 mm         moved 0.38 ± 0.33 px since the start" in lines
    assert "  the mount moves by 0.032 px about one orientation (101 epochs)" in lines
    assert "for 2 minutes" in lines[0]
    assert "1 fault\n" in text
    # a drift has the digits of its sd: it was `1.11 ± 0.00 px/min`, `ready in about 13 ± 0 min`
    assert "drifting 1.1085 ± 0.0015 px/min, ready in about 12.5667 ± 0.0067 min" in text
    assert Equilibrium("ready", 0.0123, 0.0041).sentence == "ready: 0.0123 ± 0.0041 px/min"


def test_a_disk_nearly_full_is_told_in_words():
    """It was `store: results_only:  (0 epochs wait)`."""
    little = document(store={"state": "results_only", "why": "", "waiting": 0, "lost": 0})
    assert "! store: its disk is nearly full: results are stored" in "\n".join(status_lines(little))


@pytest.fixture
def terminal(monkeypatch):
    """A keyboard: what is written to it is typed."""
    master, slave = pty.openpty()
    with os.fdopen(slave, "rb", buffering=0, closefd=False) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield master, slave
    os.close(master)
    os.close(slave)


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
    left = iter([document(), document()])

    def read(*_):
        try:
            return next(left)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(run, "read_status", read)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    with pytest.raises(KeyboardInterrupt):
        run.top(interval=0.01)
    said = capsys.readouterr().out
    assert said.count("thermocald 0.1.0, pid 30190") == 2
    assert "\x1b" not in said
