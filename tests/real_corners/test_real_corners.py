"""Effects hidden in real image points (`python -m tests.real_corners.score`)."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.real_corners import generator
from tests.real_corners.generator import SHARED, RealCase
from tests.real_corners.score import input_of, judge
from thermocald.discovery.result import discover_series
from thermocald.thermal.reduce import reduce_together

pytestmark = pytest.mark.skipif(
    not (SHARED / "aviary-cam0").exists(), reason="shared/data/aviary-* is absent"
)


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
