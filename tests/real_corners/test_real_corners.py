"""Effects hidden in real image points (`python -m tests.real_corners.score`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.real_corners import generator
from tests.real_corners.generator import SHARED, RealCase
from tests.real_corners.score import input_of, judge
from thermocald.discovery.result import discover_series
from thermocald.thermal.reduce import reduce_together

pytestmark = pytest.mark.skipif(
    not (SHARED / "aviary-cam0").exists(), reason="shared/data/aviary-* is absent"
)


@pytest.fixture
def still(monkeypatch):
    """Keep the boards' visibility, but replace the corners by means with white noise."""
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
def test_boards_hidden_at_times_do_not_bias_the_camera(still):
    found = judge(RealCase("aviary-cam1", ("creep",), 0))

    assert found.right
    assert found.gap_closed == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_a_wandering_mount_is_no_effect():
    found = [judge(RealCase("aviary-cam0", (), seed)) for seed in (52, 58, 61)]

    assert all(o.right for o in found)


@pytest.mark.slow
def test_a_moving_mount_does_not_hide_that_recordings_contradict_each_other():
    """The rates of M2 have the opposite sign: its readings are reflected at their mean."""
    first, second = generator.generate(RealCase("aviary-cam1", (), 0))[0]
    T = second.temperatures["temperature"]
    cooled = replace(second, temperatures=second.temperatures | {"temperature": 2 * T.mean() - T})

    found = discover_series(reduce_together([input_of(s, "aviary-cam1") for s in (first, cooled)]))

    assert found.verdict == "unexplained"
    assert "recordings contradict each other" in found.effects[0].statement
