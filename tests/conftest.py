"""Fixtures for all tests: the reference data beside the checkout, and no leaked thread."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data beside the checkout; skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "data").is_dir():
        pytest.skip(f"the reference data are absent: {folder / 'data'} does not exist")
    return folder


@pytest.fixture(autouse=True)
def no_leaked_threads():
    """A thread that outlives its test fails it."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 2.0
    while leaked := [t for t in threading.enumerate() if t not in before and t.is_alive()]:
        if time.monotonic() > deadline:
            pytest.fail(f"threads outlive the test: {[t.name for t in leaked]}")
        time.sleep(0.01)
