"""Whether a recording separates a shift of the principal point from a tilt of the camera."""

from __future__ import annotations

import pytest

from thermocald.discovery.result import discover_series


@pytest.mark.slow
@pytest.mark.parametrize(("px", "separable"), [(0.1, True), (0.006, False)])
def test_the_recording_decides_whether_shift_and_tilt_are_separable(evidence_of, px, separable):
    evidence, _ = evidence_of("creep", px=px, seed=1)

    (found,) = discover_series(evidence).effects

    assert found.effect == "creep"  # the cause in time, either way
    part = found.evidence["shift_and_tilt"]
    assert part["separable"] is separable
    assert 0.99 < part["correlation"] < 1.0
    assert ("not separable" in found.statement) is not separable


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "late"), [(3, True), (1, False)])
def test_a_mount_that_bends_late_or_at_once_is_named(evidence_of, seed, late):
    evidence, truth = evidence_of("mount_motion", px=0.1, seed=seed)

    (found,) = discover_series(evidence).effects

    assert (found.effect, "tau" in found.estimates) == ("mount_motion", late)
    if not late:
        assert "at once" in found.statement
        return
    tau = found.estimates["tau"]
    assert tau["value"] == pytest.approx(truth["effects"][0][0]["tau"], abs=3 * tau["sd"])
    assert found.evidence["shift_and_tilt"]["chi2_difference"] < -100  # a tilt, not a shift
