"""The adb server on loopback for several modules, which add its phones."""

from __future__ import annotations

import pytest

from tests.drivers.fakes.adb_server import AdbServer, wait_little


@pytest.fixture(scope="module")
def server():
    running = AdbServer()
    with pytest.MonkeyPatch.context() as monkeypatch:
        wait_little(monkeypatch)
        yield running
    running.close()
