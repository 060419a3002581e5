"""Small studies for the reports, made in the tests."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.analysis.conftest import WarmUp
from thermocald.analysis.study.measured import Clip
from thermocald.analysis.study.study import StudySettings, study


@pytest.fixture(scope="session")
def warm_up():
    """A builder of series of a camera that warms up, set by its fields."""
    return WarmUp


@pytest.fixture(scope="session")
def warm_study(warm_up, tmp_path_factory):
    """The first series has a clip; camera and second series have names with HTML in them."""
    folder = tmp_path_factory.mktemp("clip")
    frame = np.full((30, 40), 50, np.uint8)
    frame[10, 5] = 250
    for name in ("first.png", "last.png"):
        cv2.imwrite(str(folder / name), frame)
    clip = Clip("17", folder / "first.png", folder / "last.png", 0, 149, (5.0, 10.0))
    series = [
        replace(warm_up(seed=1)("M1", label="a & <b>"), clip=clip),
        warm_up(seed=2)("<script>M2", label="a & <b>"),
    ]
    return study(series, StudySettings(sets=5000))


@pytest.fixture(scope="session")
def empty_study(warm_up):
    """A series of a single epoch, which allows almost no statement."""
    return study([warm_up(epochs=1)()], StudySettings(sets=500))
