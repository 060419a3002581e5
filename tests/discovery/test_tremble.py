"""A camera that trembles from epoch to epoch while its targets' noise is white."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from thermocald.discovery.result import discover_series
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import detect_tremble, measure_jumps, weight_jumps_down
from thermocald.thermal.reduce import reduce_together


def trembling(effects, px, seed, epochs=180):
    """Both series of a blind case, with each epoch's image shifted independently by px."""
    rng = np.random.default_rng([seed, 5])
    out = []
    for series in generate(Case(effects, 0.3, seed, epochs=epochs))[0]:
        found = series_input(series)
        grid = found.grid
        shift = px * rng.normal(size=(len(grid.points), 1, 2))
        out.append(replace(found, grid=ObservationGrid(grid.points + shift, grid.weights)))
    return reduce_together(out)


@pytest.mark.parametrize(("px", "directions"), [(0.0, 0), (0.08, 2)])
def test_a_tremble_is_found_along_its_own_directions(px, directions):
    series = trembling((), px, 3)
    fitter = HypothesisFitter(series)

    factors, W = measure_jumps(fitter, fitter.fit(()), 0)

    clear = factors > 1.7
    assert clear.sum() == directions
    # a shift of 147 points in units of the estimated noise, 0.04 px; known to 15 % from 178 epochs
    expected = 1.0 + 147 * px**2 / 0.04**2 if directions else np.nan
    assert factors[clear] == pytest.approx([expected] * directions, rel=0.4)
    again = weight_jumps_down(series[0], factors, W)
    assert (again is None) is not bool(directions)


@pytest.mark.parametrize(
    ("effects", "px", "expected"),
    [((), 0.0, False), (("thermal_lag",), 0.0, False), (("thermal_lag",), 0.01, True)],
)
def test_a_tremble_is_no_drift(effects, px, expected):
    assert [detect_tremble(e) for e in trembling(effects, px, 3)] == [expected] * 2


@pytest.mark.parametrize(
    ("effects", "px", "seed", "epochs"),
    [
        ((), 0.05, 2, 90),
        pytest.param(("softening",), 0.02, 3, 180, marks=pytest.mark.slow),
        pytest.param(("softening",), 0.05, 2, 180, marks=pytest.mark.slow),
        pytest.param(("thermal_lag",), 0.02, 3, 180, marks=pytest.mark.slow),
        pytest.param(("thermal_lag",), 0.05, 2, 180, marks=pytest.mark.slow),
        pytest.param(("cyclic_interference",), 0.02, 3, 180, marks=pytest.mark.slow),
    ],
)
def test_what_trembles_is_noise_and_the_cause_is_named(effects, px, seed, epochs):
    found = discover_series(trembling(effects, px, seed, epochs))

    assert tuple(e.effect for e in found.effects) == effects
    assert all(a.significance < 6.0 for a in found.examination.adequacy)
