"""Small studies for the reports, made in the tests."""

from __future__ import annotations

import pytest

from tests.analysis.conftest import WarmUp
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.study import study


@pytest.fixture(scope="session")
def warm_up():
    """A builder of series of a camera that warms up, set by its fields."""
    return WarmUp


@pytest.fixture(scope="session")
def warm_study(warm_up):
    """The camera and its second series have names with HTML in them."""
    series = [warm_up(seed=k)(n, label="a & <b>") for k, n in ((1, "M1"), (2, "<script>M2"))]
    return study(series, StudySettings(sets=5000))


@pytest.fixture(scope="session")
def empty_study(warm_up):
    """A series of a single epoch, which allows almost no statement."""
    return study([warm_up(epochs=1)()], StudySettings(sets=500))
