"""Reduction of a series: offsets, gross errors, weak input; corners of real cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.errors import DataError
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.reduce import find_spikes, reduce_series
from thermocald.thermal.source import series_input


@pytest.fixture(scope="module")
def e(evidence_of):
    return evidence_of("creep", seed=4, with_m2=False)[0][0]


def test_noise_is_found_and_gross_errors_are_taken_out(e):
    assert np.sqrt(e.variance) * 0.04 == pytest.approx(0.04, rel=0.02)
    assert np.median(e.sigma0) == pytest.approx(1.0, abs=0.02)
    share = 1.0 - (e.weights[..., 0] > 0).sum() / e.source.grid.observed.sum()
    assert 0.001 < share < 0.004  # 0.2 % were added, some too small to be seen
    normal = e.residuals * np.sqrt(e.weights[..., :2])
    assert np.nanmax(np.abs(normal)) < 6.0


def test_turning_points_of_a_drift_are_no_gross_errors_and_jumps_are():
    """At turning points only, an epoch differs from the median of its neighbours."""
    rng, every = np.random.default_rng(3), np.ones((300, 20), dtype=bool)
    arm = rng.uniform(0.5, 1.5, (20, 2))  # a drift of a pixel, noise of 0.004 px
    way = np.sin(2 * np.pi * np.arange(300) / 40.0)
    misclosure = way[:, None, None] * arm + rng.normal(0, 0.004, (300, 20, 2))
    assert find_spikes(misclosure, every).sum() == 0
    jumps = [50, 121, 250], [3, 7, 3]
    misclosure[jumps] += 0.5
    found = find_spikes(misclosure, every)
    assert found[jumps].all()
    # neighbouring epochs may also be suspected before an adjustment
    near = (np.argwhere(found)[:, None] - np.transpose(jumps)) * [1, 3]  # of the same target
    assert (np.abs(near).max(axis=2).min(axis=1) <= 2).all()


def test_wrong_field_coordinates_do_not_matter(e):
    """A constant error of each target's coordinates leaves the trajectories as they were."""
    field = e.source.field
    moved = field.points + np.random.default_rng(0).normal(0, 0.1, field.points.shape)
    other = reduce_series(replace(e.source, field=replace(field, points=moved)))

    fits = [HypothesisFitter([x]).fit((Term("creep"),)) for x in (e, other)]

    creep = [f.coefficients[3:] for f in fits]
    # 0.1 mm in 1 m changes the partial derivatives by 1e-4, the linearisation slightly more
    assert np.linalg.norm(creep[0] - creep[1]) < 0.005 * np.linalg.norm(creep[0])
    # 18 combinations of parameters per epoch, their levels, 6 coefficients; three sigma of χ²
    free = 18 * (len(e.times) - 1) - 6
    for fit in fits:
        assert abs(fit.chi2 - free) < 3 * np.sqrt(2 * free)


def weakened(source, case):
    n, field = len(source.frame_times), source.field
    ten = slice(0, 10)
    return replace(source, **{
        "no temperature": {"readings": {}},
        "holds fewer": {"readings": {"temperature": np.full(n, np.nan)}},
        "constant": {"readings": {"temperature": np.full(n, 21.0)}},
        "one plane": {"field": replace(field, points=field.points * [1, 1, 0])},
        "lasts 50 s": {"frame_times": np.linspace(0, 50, n),
                       "reading_times": np.linspace(0, 50, n)},
        "of 10 epochs": {
            "frame_times": source.frame_times[ten], "reading_times": source.reading_times[ten],
            "readings": {k: v[ten] for k, v in source.readings.items()},
            "grid": type(source.grid)(source.grid.points[ten], source.grid.weights[ten]),
            "numbers": source.numbers[ten],
        },
    }[case])  # fmt: skip


@pytest.mark.parametrize(
    "case",
    ["no temperature", "holds fewer", "constant", "one plane", "lasts 50 s", "of 10 epochs"],
)
def test_weak_input_is_refused(e, case):
    with pytest.raises(DataError, match=case):
        reduce_series(weakened(e.source, case))


def test_the_place_of_linearisation_has_all_parameters(evidence_of):
    """If C1 = 4e-3 were held at 0, y0 and B2 would absorb it, and the drifts would be biased."""
    at = evidence_of("affinity_drift", seed=210, with_m2=False)[0][0].at

    assert at.iop[8] == pytest.approx(1.6e-3, abs=4e-4)  # C1 of the base and of the mean T
    assert abs(at.iop[7]) < 2e-4  # B2, drawn with 1e-4


def test_a_hidden_board_does_not_pull_at_the_cameras(shared):
    """Offsets and cameras are solved together: each target's residuals have no mean."""
    source = series_input(read_recording(shared / "data" / "aviary-cam2"))
    t = source.frame_times - source.frame_times[0]
    warm = {"temperature": np.round(20 + 15 * t / t[-1], 1)}
    times = source.frame_times[0] + 20.0 * t  # fifty seconds become a quarter of an hour
    e = reduce_series(replace(source, frame_times=times, reading_times=times, readings=warm))
    often = (e.weights[..., 0] > 0).sum(axis=0) > 50

    mean = np.nanmean(e.residuals[:, often], axis=0)

    assert np.max(np.abs(mean)) < 1e-3
