"""Effects hidden in real image points (`python -m tests.real_corners.score`)."""

from __future__ import annotations

import numpy as np
import pytest

from tests.real_corners import generator
from tests.real_corners.generator import SHARED, RealCase

pytestmark = pytest.mark.skipif(
    not (SHARED / "aviary-cam0").exists(), reason="shared/data/aviary-* is not there"
)


@pytest.fixture
def still(monkeypatch):
    """The boards come and go as they did; the corners stand still but for white noise."""
    real = generator.corners

    def quiet(camera):
        names, place, points = real(camera)
        rng = np.random.default_rng(5)
        seen = np.isfinite(points)
        count = np.maximum(seen.sum(axis=0), 1)
        mean = np.where(seen, points, 0.0).sum(axis=0) / count
        return names, place, np.where(seen, mean + rng.normal(0, 0.05, points.shape), np.nan)

    monkeypatch.setattr(generator, "corners", quiet)


@pytest.mark.slow
def test_boards_that_come_and_go_do_not_pull_at_the_camera(still):
    from tests.real_corners.score import judge

    found = judge(RealCase("aviary-cam1", ("creep",), 0))

    assert found.right
    assert found.gap_closed == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "effect", "seed"),
    [("aviary-cam6", "thermal_lag", 1), ("aviary-cam1", "softening", 1)],
)
def test_a_cause_is_named_beside_a_mount_that_moves(camera, effect, seed):
    from tests.real_corners.score import judge

    assert judge(RealCase(camera, (effect,), seed)).right_or_listed


@pytest.mark.slow
def test_a_wander_of_the_mount_is_no_effect():
    from tests.real_corners.score import judge

    found = [judge(RealCase("aviary-cam0", (), seed)) for seed in (52, 58, 61)]

    assert all(o.right for o in found)


def test_a_score_that_misses_its_goal_is_said():
    from tests.blind.outcome import Outcome
    from tests.real_corners.score import missed

    case = RealCase("aviary-cam0", ("creep",), 500)
    good = Outcome(case, ("creep",), "effects_found", (), True, True, {}, 0.95, 1.0)
    bad = Outcome(case, ("slip",), "effects_found", (), False, False, {}, None, 1.0)

    assert missed("nine", [good] * 19 + [bad]) == []
    assert "80% named" in missed("nine", [good] * 4 + [bad])[0]
    assert "100%" in missed("none", [good] * 99 + [bad])[0]
