"""The mocks are unplugged by their own faults: by time, since they are not yet constructed."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

from tests.drivers.laboratory.bench import Bench
from tests.drivers.small_camera import write_small_camera
from thermocald.hal import VirtualClock


@contextmanager
def _mock(tmp_path, monkeypatch):
    clock = VirtualClock()
    fault: dict[str, Any] = {"kind": "unplugged", "at_s": 1000.0, "for_s": 1000.0}
    yield Bench(
        {"faults": [fault]},
        unplug=lambda: clock.sleep_until(1500.0),
        plug=lambda: clock.sleep_until(2500.0),
        clock=clock,
    )


@contextmanager
def camera(tmp_path, monkeypatch):
    with _mock(tmp_path, monkeypatch) as bench:
        bench.options["model"] = str(write_small_camera(tmp_path / "small.thermal.yaml"))
        yield bench


thermometer = output = _mock
