"""An alert of a running daemon: out and in again, once each, as a camera warms and cools."""

from __future__ import annotations

import numpy as np
import pytest

from tests.daemon.conftest import make_recording, replayed_camera
from thermocald.config import parse_config
from thermocald.daemon.service import Service

WHEN = [
    {"temperature": "temperature", "above_c": 45.0},
    {"drift": "x0", "px": 5.0},
    {"no_result": 30},
]


def up_and_down(k):
    """Return a temperature that stays, rises to 60 °C and falls again."""
    return float(np.interp(k, [0, 12, 20, 26, 34], [25.0, 25.0, 60.0, 60.0, 25.0]))


@pytest.mark.slow
def test_a_daemon_alerts_once_out_and_once_in(tmp_path):
    hook, log = tmp_path / "hook", tmp_path / "hook.log"
    hook.write_text(f'#!/bin/sh\necho "$THERMOCALD_CONDITION $THERMOCALD_STATE" >> {log}\n')
    hook.chmod(0o755)
    recording = make_recording(tmp_path / "day", 40, interval=10.0, temperature_of=up_and_down)
    document = {
        "cameras": [replayed_camera(recording, name="r", thermometers=["t"])],
        "thermometers": [{"name": "t", "driver": "replay", "recording": str(recording)}],
        "outputs": [{"name": "a", "driver": "alert_exec", "command": [str(hook)], "when": WHEN}],
        "frames": {"keep": "none"},
    }
    config = parse_config(document, tmp_path / "config.yaml")
    assert Service(config, fast=True, until_finished=True).run()
    told = [tuple(line.split()) for line in log.read_text().splitlines()]
    for condition in ("temperature", "drift_x0_px"):
        assert [state for name, state in told if name == condition] == ["out", "in"]
    assert len(told) == 4
