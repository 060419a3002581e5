"""The effects of the reference study's simulated cameras are named.

Those of rpi-v2.1-heating, of the same seeds, are the golden `discover`.
"""

from __future__ import annotations

import pytest

import thermocald as tc

DISTORTION = [{"decentering_drift"}, {"radial_distortion_drift"}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        # a bending mount, with six coefficients, explains nearly as much as the two drifts
        ("nexus5-cold", DISTORTION),
        ("galaxy-s8-cold", [{"defocus"}, *DISTORTION[1:]]),
    ],
)
def test_effects_of_a_preset_are_named(preset, expected, tmp_path):
    m1, m2 = (tc.simulate(preset, seed=k, series=f"M{k}", out=tmp_path / f"M{k}") for k in (1, 2))

    found = tc.discover(m1, verify=[m2])

    assert [{e.effect, *e.alternative_names} for e in found.effects] == expected
    assert found.stages[-1].fit.chi2_reduced == pytest.approx(1.0, abs=0.02)
