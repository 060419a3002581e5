"""The free network from simulated photographs: coordinates, covariance, gross errors, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.photogrammetry import network_cases as cases
from tests.photogrammetry.exact_rendering import rms
from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import CameraModel
from thermocald.photogrammetry.network.adjustment import adjust_network, advice

SIGMA = 0.05
KNOWN = {"interior": cases.INTERIOR}


def _adjust(photos, field, distances=None, **options):
    """Adjust photographs with one long distance, or others."""
    if distances is None:
        last = int(np.argmax(np.linalg.norm(field - field[0], axis=1)))
        distances = [cases.distance(field, 0, last, 0.01)]
    names = [f"t{i}" for i in range(len(field))]
    return adjust_network(cases.SENSOR, photos, names, distances, **options)


def _survey(field, stations, seed, distances=None, loss=0.03, **options):
    """Survey a simulated field."""
    rng = np.random.default_rng(seed)
    photos, _ = cases.photographs(field, stations, SIGMA, rng, loss=loss)
    return _adjust(photos, field, distances, **options)


@pytest.mark.slow
def test_standard_deviations_and_correlations_are_true():
    """Scatter over stated sd of targets, interior orientation and distances in 100 repetitions.

    Distances between neighbouring targets are far better than the sigmas alone imply. The
    repetitions give the mean over 90 coordinates to 1 % (or a little worse, because neighbouring
    coordinates correlate) and an interior parameter's to 7 %; the bounds are three of those. The
    observations are normal; errors outside the model are not tested.
    """
    field = cases.bent_sheet(6, 5)
    stations = cases.convergent_stations(field, 8)
    rng = np.random.default_rng(7)
    a, b = np.array([rng.choice(30, 2, replace=False) for _ in range(25)]).T
    length = np.linalg.norm(field[b] - field[a], axis=1)
    e = (field[b] - field[a]) / length[:, None]
    errors, variances, interiors, interior_variances, sigma0, ratios = [], [], [], [], [], []
    along = (field - field.mean(axis=0)) / np.linalg.norm(field - field.mean(axis=0))
    shapes, shares = [], []
    for seed in range(100):
        taped = [cases.distance(field, 0, 29, 0.01, rng.normal(0, 0.01))]
        network = _survey(field, stations, seed, taped, 0.0, nominal=field, **KNOWN)
        errors.append(network.points - field)
        variances.append(network.sigmas**2)
        shape, scale = network.shape_and_scale()
        of_scale = np.sum(errors[-1] * along)
        shapes.append((errors[-1] - of_scale * along) / shape)
        shares.append(of_scale / np.linalg.norm(scale))
        interiors.append(network.camera.interior.as_array() - cases.INTERIOR.as_array())
        interior_variances.append(np.diag(network.interior_covariance))
        sigma0.append(network.sigma0)
        C = network.covariance.reshape(30, 3, 30, 3)
        V = C[a, :, a] + C[b, :, b] - C[a, :, b] - C[b, :, a]
        error = np.linalg.norm(network.points[b] - network.points[a], axis=1) - length
        ratios.append(error / np.sqrt(np.einsum("ni,nij,nj->n", e, V, e)))
    per_axis = rms(errors, axis=(0, 1)) / np.sqrt(np.mean(variances, axis=(0, 1)))
    assert np.all((per_axis > 0.9) & (per_axis < 1.1))
    # what is left without the error of the scale, and this error
    assert 0.97 < rms(shapes) < 1.03
    assert 0.79 < rms(shares) < 1.21
    per_parameter = rms(interiors, axis=0) / np.sqrt(np.mean(interior_variances, axis=0))
    assert np.all((per_parameter > 0.79) & (per_parameter < 1.21))
    assert abs(np.mean(sigma0) - 1) < 0.01
    assert 0.8 < rms(ratios) < 1.2


def test_two_distances_are_weighted_and_lower_the_scale_uncertainty():
    """The datum is that of inner constraints (Granshaw 1980): no part of it moves or turns."""
    field = cases.bent_sheet(6, 5)
    stations = cases.convergent_stations(field, 8)
    first = cases.distance(field, 0, 29, 0.1)
    one = _survey(field, stations, 3, [first], **KNOWN)
    # the second is 1 mm too long, but has ten times the sd: a hundredth of 1 mm remains at most
    two = _survey(field, stations, 3, [first, cases.distance(field, 5, 24, 1.0, 1.0)], **KNOWN)
    assert two.sd_scale < one.sd_scale
    assert two.extent == pytest.approx(one.extent, rel=0.02 / 900)
    assert two.extent > one.extent
    # mostly the distance's own sd, which is that of the adjusted distance
    assert 1.0 < one.sd_scale / (0.1 / first.length) < 1.1
    J = np.zeros((30, 3))
    J[29] = (one.points[29] - one.points[0]) / first.length
    J[0] = -J[29]
    assert np.sqrt(J.ravel() @ one.covariance @ J.ravel()) == pytest.approx(0.1, rel=1e-3)
    about = one.points - one.points.mean(axis=0)
    turns = [np.cross(axis, about).ravel() for axis in np.eye(3)]
    G = np.column_stack([np.tile(np.eye(3), (30, 1)), *turns])
    assert np.abs(G.T @ one.covariance).max() < 3e-3 * np.abs(one.covariance).max()


def _parallel(field, steps_x, steps_y):
    centre = field.mean(axis=0)
    return [
        cases.looking_at(np.add(centre, (x, y, 900)), np.add(centre, (x, y, 0)), 0.0)
        for x in steps_x
        for y in steps_y
    ]


_FLAT = cases.bent_sheet(8, 6, sag=0.0)
_BENT = cases.bent_sheet(8, 6)
_ROUND = cases.convergent_stations(_BENT, 8)
_SPOT = _BENT.mean(axis=0)
_TURNING = [
    cases.looking_at(np.add(_SPOT, (0, 0, 900)), np.add(_SPOT, (10 * i, 0, 0)), i) for i in range(6)
]


@pytest.mark.parametrize(
    ("field", "stations", "distances", "reason"),
    [
        pytest.param(_FLAT, _parallel(_FLAT, (-180, 0, 180), (-130, 0, 130)), None,
                     "principal distance is uncertain", id="flat and parallel"),
        pytest.param(_BENT, _TURNING, None, "rays meet at|oriented to each other", id="one place"),
        pytest.param(_BENT[:6], cases.convergent_stations(_BENT[:6]), None, "6 targets",
                     id="six targets"),
        pytest.param(_BENT, cases.convergent_stations(_BENT), [], "--scale", id="no scale"),
    ],
)  # fmt: skip
def test_weak_networks_and_those_without_a_scale_are_refused(field, stations, distances, reason):
    with pytest.raises(GeometryError, match=reason):
        _survey(field, stations, 0, distances)


def test_sigmas_twice_too_small_show_in_sigma0_and_twenty_times_are_refused():
    photos, _ = cases.photographs(_BENT, _ROUND, SIGMA, np.random.default_rng(0))
    for seen in photos.values():
        seen.sigmas[:] = SIGMA / 20
    with pytest.raises(GeometryError, match="times their stated sigmas"):
        _adjust(photos, _BENT, **KNOWN)
    for seen in photos.values():
        seen.sigmas[:] = SIGMA / 2
    assert _adjust(photos, _BENT, **KNOWN).sigma0 == pytest.approx(2.0, rel=0.1)


def test_coordinates_are_as_accurate_as_stated_if_the_focus_moves_between_photographs():
    """As if image points were independent, the errors are 2.3 standard deviations."""
    field = cases.bent_sheet(6, 5)
    stations = cases.convergent_stations(field, 8)
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng([2, seed])
        photos = {}
        for i, station in enumerate(stations):
            c = cases.INTERIOR.c * (1 + rng.normal(0, 2e-3))
            camera = CameraModel(cases.SENSOR, replace(cases.INTERIOR, c=c))
            one = cases.photographs(field, [station], SIGMA, rng, camera, loss=0.0)[0]
            photos[f"photo{i}"] = one["photo0"]
        distances = [cases.distance(field, 0, 29, 0.05)]
        network = _adjust(photos, field, distances, nominal=field, **KNOWN)
        assert network.disagreement > 1.5
        assert any("photographs disagree" in note for note in advice(network))
        rows = [int(name[1:]) for name in network.names]
        ratios.append(rms(cases.normalised_errors(network, field[rows])[1]))
    assert rms(ratios) == pytest.approx(1.0, abs=0.4)


def test_advice_names_the_missing_roll():
    network = _survey(_BENT, cases.convergent_stations(_BENT, 8, rolled=False), 0, **KNOWN)
    assert any("turned about its axis" in note for note in advice(network))
    assert network.disagreement == 1
    rolled = _survey(_BENT, _ROUND, 0)
    assert not any("turned about its axis" in note for note in advice(rolled))
    sd = [float(np.sqrt(n.interior_covariance[1, 1])) for n in (network, rolled)]
    assert sd[0] > 3 * sd[1]


@pytest.mark.parametrize("zoom", [None, 1.03])
def test_a_foreign_photograph_and_one_of_another_focus_are_left_out_and_named(zoom):
    """With a principal distance 3 % longer, it can be oriented alone but not with the others."""
    rng = np.random.default_rng(6)
    photos, wrong = cases.photographs(_BENT, _ROUND, SIGMA, rng, gross=0.02)
    if zoom is None:
        photos["photo7"].points[:] = rng.uniform(0, 2400, photos["photo7"].points.shape)
    else:
        zoomed = CameraModel(cases.SENSOR, replace(cases.INTERIOR, c=cases.INTERIOR.c * zoom))
        other, _ = cases.photographs(_BENT, _ROUND[7:], SIGMA, rng, camera=zoomed)
        photos["photo7"] = other["photo0"]
    network = _adjust(photos, _BENT, **KNOWN)
    assert "photo7" in network.unused
    assert "photo7" not in {s.photo for s in network.stations}
    assert 0.9 < network.sigma0 < 1.1
    rejected = {(r.photo, int(r.target[1:])) for r in network.rejected if r.photo != "photo7"}
    assert rejected == {each for each in wrong if each[0] != "photo7"} != set()
    assert np.abs(cases.normalised_errors(network, _BENT)[1]).max() < 4.5


@pytest.mark.slow
def test_bad_photographs_in_a_small_network_are_refused():
    """Regression: a target with one ray in front of a camera stopped the iteration unexplained."""
    field = cases.bent_sheet(5, 4)
    for seed in (0, 4):
        rng = np.random.default_rng(seed)
        stations = cases.convergent_stations(field, 5)
        photos, _ = cases.photographs(field, stations, 0.1, rng, loss=0.3)
        for shown in photos.values():
            wrong = rng.random(len(shown)) < 0.08
            shown.points[wrong] += rng.normal(size=(wrong.sum(), 2)) * 200
        with pytest.raises(GeometryError, match="contradict each other"):
            _adjust(photos, field, [cases.distance(field, 0, 19, 0.01)], **KNOWN)
