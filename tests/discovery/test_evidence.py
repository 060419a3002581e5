"""Reduction of a series: offsets, gross errors, weak input; corners of real cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.bridge import generated
from tests.blind.case import Case
from tests.real_corners.generator import CAMERAS
from thermocald.discovery.result import discover_series
from thermocald.errors import DataError
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.reduce import find_spikes, reduce_series
from thermocald.thermal.series import in_blocks
from thermocald.thermal.source import series_input


@pytest.fixture(scope="module")
def source():
    return generated(Case(("creep",), 0.3, 4, with_m2=False))[0][0]


@pytest.fixture(scope="module")
def e(source):
    return reduce_series(source)


def test_noise_is_found(e):
    assert np.sqrt(e.variance) * 0.04 == pytest.approx(0.04, rel=0.02)
    assert np.median(e.sigma0) == pytest.approx(1.0, abs=0.02)


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


def test_gross_errors_are_taken_out(e):
    share = 1.0 - (e.weights[..., 0] > 0).sum() / e.source.grid.observed.sum()
    assert 0.001 < share < 0.004  # 0.2 % were added, some too small to be seen
    normal = e.residuals * np.sqrt(e.weights[..., :2])
    assert np.nanmax(np.abs(normal)) < 6.0


def test_wrong_field_coordinates_do_not_matter(source, e):
    """A constant error of each target's coordinates leaves the trajectories as they were."""
    rng = np.random.default_rng(0)
    moved = source.field.points + rng.normal(0, 0.1, source.field.points.shape)
    other = replace(source, field=replace(source.field, points=moved))

    fits = [HypothesisFitter([x]).fit((Term("creep"),)) for x in (e, reduce_series(other))]

    creep = [f.coefficients[3:] for f in fits]
    # 0.1 mm in 1 m changes the partial derivatives by 1e-4, the linearisation slightly more
    assert np.linalg.norm(creep[0] - creep[1]) < 0.005 * np.linalg.norm(creep[0])
    # 18 combinations of parameters per epoch, their levels, 6 coefficients; three sigma of χ²
    free = 18 * (len(source.frame_times) - 1) - 6
    for fit in fits:
        assert abs(fit.chi2 - free) < 3 * np.sqrt(2 * free)


def test_weak_input_is_refused(source):
    none = {"temperature": np.full(len(source.frame_times), np.nan)}
    constant = {"temperature": np.full(len(source.frame_times), 21.0)}
    flat = source.field.points.copy()
    flat[:, 2] = 0.0
    ten = slice(0, 10)
    cases = {
        "no temperature": replace(source, readings={}),
        "holds fewer": replace(source, readings=none),
        "constant": replace(source, readings=constant),
        "one plane": replace(source, field=replace(source.field, points=flat)),
        "of 10 epochs": replace(
            source,
            frame_times=source.frame_times[ten],
            reading_times=source.reading_times[ten],
            readings={k: v[ten] for k, v in source.readings.items()},
            grid=type(source.grid)(source.grid.points[ten], source.grid.weights[ten]),
            numbers=source.numbers[ten],
        ),
    }
    for words, weak in cases.items():
        with pytest.raises(DataError, match=words):
            reduce_series(weak)


def test_blocks_keep_the_slow_courses(e):
    short = in_blocks(e, rows=60)

    assert len(short.times) == 60
    assert short.N.sum(axis=0) == pytest.approx(e.N.sum(axis=0))
    assert short.b.sum(axis=0) == pytest.approx(e.b.sum(axis=0))
    assert short.averaged(e.times) == pytest.approx(short.times)


def test_the_place_of_linearisation_has_all_parameters():
    """If C1 = 4e-3 were held at 0, y0 and B2 would absorb it, and the drifts would be biased."""
    (series,), _ = generated(Case(("affinity_drift",), 0.3, 210, with_m2=False))

    at = reduce_series(series).at

    assert at.iop[8] == pytest.approx(1.6e-3, abs=4e-4)  # C1 of the base and of the mean T
    assert abs(at.iop[7]) < 2e-4  # B2, drawn with 1e-4


def with_a_ramp(shared, camera, stretched=1.0):
    """A recording without thermal effects, with an invented temperature that rises.

    stretched: factor of all times, so that fifty seconds become a quarter of an hour. Other courses
    are the part `none` of tests/real_corners.
    """
    source = series_input(read_recording(shared / "data" / camera))
    t = source.frame_times - source.frame_times[0]
    T = 20 + 15 * t / t[-1] + np.random.default_rng(7).normal(0, 0.04, len(t))
    times = source.frame_times[0] + t * stretched
    return replace(
        source, frame_times=times, reading_times=times, resolutions={"temperature": 0.0625},
        readings={"temperature": np.round(T / 0.0625) * 0.0625},
    )  # fmt: skip


def test_fifty_seconds_are_too_short(shared):
    with pytest.raises(DataError, match="lasts 50 s"):
        reduce_series(with_a_ramp(shared, "aviary-cam2"))


@pytest.mark.slow
@pytest.mark.parametrize("camera", CAMERAS)
def test_an_invented_temperature_names_no_effect(shared, camera):
    """Tag 22 of cam2 and camera 6 as a whole do move slightly, which may be `unnamed`."""
    found = discover_series([reduce_series(with_a_ramp(shared, camera, 20.0))])

    assert {e.effect for e in found.effects} <= {"unnamed"}


def test_a_hidden_board_does_not_pull_at_the_cameras(shared):
    """Offsets and cameras are solved together: each target's residuals have no mean."""
    e = reduce_series(with_a_ramp(shared, "aviary-cam2", 20.0))
    seen = e.weights[..., 0] > 0
    often = seen.sum(axis=0) > 50

    mean = np.nanmean(e.residuals[:, often], axis=0)

    assert np.max(np.abs(mean)) < 1e-3
