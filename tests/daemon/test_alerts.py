"""Alerts of a running daemon: one out and one in, by four drivers, as a camera warms and cools."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.daemon.conftest import make_recording
from tests.drivers.fakes.alert_servers import MailServer, WebServer
from tests.drivers.fakes.mqtt_broker import Broker

WHEN = [
    {"temperature": "temperature", "above_c": 45.0},
    {"drift": "x0", "px": 5.0},
    {"no_result": 30},
]


def up_and_down(k):
    """Return a temperature that stays, rises to 60 °C and falls again."""
    return float(np.interp(k, [0, 12, 30, 42, 60], [25.0, 25.0, 60.0, 60.0, 25.0]))


@pytest.fixture
def servers():
    started = WebServer(), MailServer(), Broker()
    yield started
    for server in started:
        server.close()


@pytest.mark.slow
def test_a_daemon_alerts_once_out_and_once_in(daemon, replayed, servers):
    web, mail, broker = servers
    hook, log = daemon.folder / "hook", daemon.folder / "hook.log"
    hook.write_text(f'#!/bin/sh\necho "$THERMOCALD_CONDITION $THERMOCALD_STATE" >> {log}\n')
    hook.chmod(0o755)
    here = {"host": "127.0.0.1", "when": WHEN}
    path = make_recording(
        daemon.folder / "day", 80, per_side=4, interval=0.25, temperature_of=up_and_down
    )
    sections = replayed(path, period_s=0.25, loop=False)
    sections["outputs"] += [
        {"name": "program", "driver": "alert_exec", "command": [str(hook)], "when": WHEN},
        {"name": "web", "driver": "alert_webhook", "url": f"http://127.0.0.1:{web.port}/a",
         "when": WHEN},
        {"name": "letter", "driver": "alert_mail", "port": mail.port, "security": "none",
         "sender": "pi@example.org", "recipients": ["me@example.org"], **here},
        {"name": "home", "driver": "alert_mqtt", "port": broker.port, **here},
    ]  # fmt: skip
    daemon.run(**sections)
    daemon.until(lambda: [p[2]["state"] for p in web.posts].count("in") == 2, 120.0)
    daemon.until(lambda: len(mail.letters) == 4 and len(log.read_text().split("\n")) == 5)
    daemon.until(lambda: sum("/alert/" in m[0] for m in broker.messages) == 4)
    assert daemon.stop() == 0

    expected = {"temperature", "drift_x0_px"}
    told = [(p[2]["condition"], p[2]["state"]) for p in web.posts]
    for condition in expected:
        assert [state for name, state in told if name == condition] == ["out", "in"]
    assert {name for name, _ in told} == expected
    hooked = [tuple(line.split()) for line in log.read_text().splitlines()]
    assert sorted(hooked) == sorted(told)
    states = [json.loads(m[1]) for m in broker.messages if "/alert/" in m[0]]
    assert sorted((s["condition"], s["state"]) for s in states) == sorted(told)
    assert sum("rpi: x0 is" in letter for letter in mail.letters) >= 1
    out = next(p[2] for p in web.posts if p[2]["condition"] == "temperature")
    assert out["value"] > 45.0
    assert out["device"] == "rpi"
