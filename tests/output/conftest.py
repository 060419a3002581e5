"""Small studies for the reports, made in the tests."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from thermocald.analysis.study.study import StudySettings, study

_SPEC = importlib.util.spec_from_file_location(
    "warm_up_series", Path(__file__).parents[1] / "analysis" / "conftest.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
_WARM_UP = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = _WARM_UP  # dataclasses look their module up
_SPEC.loader.exec_module(_WARM_UP)


@pytest.fixture(scope="session")
def warm_up():
    """A builder of series of a camera that warms up, set by its fields."""
    return _WARM_UP.WarmUp


@pytest.fixture(scope="session")
def warm_study(warm_up):
    """Two series of a camera that warms up."""
    return study([warm_up(seed=1)("M1"), warm_up(seed=2)("M2")], StudySettings(sets=5000))


@pytest.fixture(scope="session")
def empty_study(warm_up):
    """A series of a single epoch, which allows almost no statement."""
    return study([warm_up(epochs=1)()], StudySettings(sets=500))
