"""A broker on loopback; unplugging breaks its lines and stops it."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.mqtt_broker import Broker
from tests.drivers.laboratory.bench import Bench
from thermocald.hal import SystemClock


@contextmanager
def output(tmp_path, monkeypatch):
    brokers = [Broker()]
    port = brokers[0].port
    yield Bench(
        {"host": "127.0.0.1", "port": port, "when": [{"no_result": 2}], "timeout_s": 1.0},
        unplug=brokers[-1].close,
        plug=lambda: brokers.append(Broker(port)),
        clock=SystemClock(),
    )
    brokers[-1].close()
