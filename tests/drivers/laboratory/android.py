"""A phone behind an adb server on loopback; unplugging takes it off the server's list."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.adb_server import AdbServer, FakePhone, photograph
from tests.drivers.laboratory.bench import Bench
from thermocald.hal import SystemClock

SERIAL = "0A1B2C3D4E"


def shoot(phone):
    when = phone.now()
    phone.add(
        f"IMG_{len(phone.files):04d}.jpg",
        photograph(when, subsecond=f"{int(when % 1 * 1000):03d}"),
    )


@contextmanager
def _phone(tmp_path, monkeypatch, **options):
    server = AdbServer()
    phone = FakePhone(shoot=shoot)
    server.phones[SERIAL] = phone
    common = {"serial": SERIAL, "port": server.port, "start_server": False, "timeout_s": 2.0}
    yield Bench(
        {**common, **options},
        unplug=server.phones.clear,
        plug=lambda: server.phones.update({SERIAL: phone}),
        clock=SystemClock(),
    )
    server.close()


def camera(tmp_path, monkeypatch):
    return _phone(tmp_path, monkeypatch, width=96, height=64)


thermometer = _phone
