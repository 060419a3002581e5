"""The cameras of the reference study as they are simulated: what was put in is what is named."""

from __future__ import annotations

import pytest

from thermocald.discovery.evidence import load_together
from thermocald.discovery.result import discover_series
from thermocald.physics.presets import preset_simulation
from thermocald.thermal.reduce import reduce_together

DISTORTION = [{"decentering_drift"}, {"radial_distortion_drift"}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        # a mount that bends, with six coefficients, explains nearly as much as the two drifts
        ("nexus5-cold", DISTORTION),
        ("galaxy-s8-cold", [{"defocus"}, *DISTORTION[1:]]),
        ("rpi-v2.1-heating", [{"defocus"}, {"self_heating", "permanent_set"}, *DISTORTION]),
    ],
)
def test_effects_of_a_preset_are_named(preset, expected, tmp_path):
    m1, m2 = tmp_path / "M1", tmp_path / "M2"
    for path, seed in ((m1, 1), (m2, 2)):
        preset_simulation(preset, seed, path.name).write(path)

    found = discover_series(reduce_together(load_together(m1, [m2], lambda _: None)))

    assert [{e.effect, *e.alternative_names} for e in found.effects] == expected
    assert found.stages[-1].fit.chi2_reduced == pytest.approx(1.0, abs=0.02)
