"""A stand-in with picamera2's API; unplugging empties libcamera's list and hangs captures."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager

from tests.drivers.fakes import picamera2_stand_in
from tests.drivers.laboratory.bench import Bench
from thermocald.hal import SystemClock


@contextmanager
def camera(tmp_path, monkeypatch):
    there = picamera2_stand_in.StandIn.cameras
    pi = type("Camera", (picamera2_stand_in.StandIn,), {"instances": []})
    monkeypatch.setitem(sys.modules, "picamera2", picamera2_stand_in.module(pi))
    hung = threading.Event()

    def unplug():
        pi.cameras, pi.hang = (), hung

    def plug():
        hung.set()
        pi.cameras, pi.hang = there, None

    options = {"width": 96, "height": 64, "exposure_s": 0.002, "timeout_s": 0.3}
    yield Bench(options, unplug, plug, clock=SystemClock())
    hung.set()
