"""The bench of a test's driver, and an adb server for several modules, which add its phones."""

from __future__ import annotations

import pytest
import smbus2

from tests.drivers.fakes.adb_server import AdbServer, wait_little
from tests.drivers.fakes.smbus import Bus
from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.laboratory import LABORATORY


@pytest.fixture
def driver(request):
    """The (kind, name) under test: the module's DRIVER, or a parameter."""
    return request.module.DRIVER


@pytest.fixture
def bench(driver, tmp_path, monkeypatch):
    """The bench of one driver; a driver without one fails."""
    with LABORATORY[driver](tmp_path, monkeypatch) as one:
        one.driver = driver
        yield one


@pytest.fixture
def fake(bench):
    """What stands below the driver."""
    return bench.fake


@pytest.fixture
def bus(monkeypatch):
    """An SMBus adapter, which every driver releases."""
    adapter = Bus()
    monkeypatch.setattr(smbus2, "SMBus", adapter)
    yield adapter
    assert adapter.opened == 0


@pytest.fixture
def sysfs(tmp_path):
    return Sysfs(tmp_path)


@pytest.fixture(scope="module")
def server():
    running = AdbServer()
    with pytest.MonkeyPatch.context() as monkeypatch:
        wait_little(monkeypatch)
        yield running
    running.close()
