"""The adb server on loopback that several modules ask; its phones are theirs to give."""

from __future__ import annotations

import pytest

from tests.drivers.fakes.adb_server import AdbServer


@pytest.fixture(scope="module")
def server():
    running = AdbServer()
    yield running
    running.close()
