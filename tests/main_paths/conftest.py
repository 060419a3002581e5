"""The program as it is installed."""

import sys

import pytest


@pytest.fixture(scope="session")
def program() -> list[str]:
    """What a user types for `thermocald`."""
    return [sys.executable, "-m", "thermocald"]
