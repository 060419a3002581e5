"""Surveys of rendered test fields on bent paper."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.photogrammetry import network_cases as cases
from tests.photogrammetry.exact_rendering import look_at, noisy, rms
from tests.photogrammetry.fields import SMALL_CAMERA, corner_field
from tests.photogrammetry.test_markers import FIELD, SCENE, VIEWS
from thermocald.errors import GeometryError, ImageError
from thermocald.output.testfield.sheets import Design, field_of, lay_out, paper_size
from thermocald.photogrammetry.camera.camera_model import CameraModel, Sensor
from thermocald.photogrammetry.field.testfield import Distance, TestField
from thermocald.photogrammetry.frame.measurement import REPEATED
from thermocald.photogrammetry.survey import _measure_again, survey
from thermocald.physics.scene import Scene

# The binned mode of a Raspberry Pi camera v2.1.
CAMERA = CameraModel(Sensor(1640, 1232, 0.00224), cases.INTERIOR)


def bent(field, size, sag=5.0):
    """Return the true field of a nominal sheet: bent, twisted, and stretched by the printer."""
    points = field.points * [1.002, 0.999, 1.0]
    u, v = field.points[:, 0] / size[0] - 0.5, field.points[:, 1] / size[1] - 0.5
    points[:, 2] = sag * (1 - 4 * u * u) + 0.6 * sag * u * v
    return TestField.build(field.names, points, 0.0, field.diameters, field.kinds, field.codes)


def photograph(truth, stations):
    """Render photographs of a field with the program's own renderer."""
    scene = Scene(CAMERA.sensor, truth)
    pictures = {}
    for i, station in enumerate(stations):
        frame = scene.render(CAMERA.interior.as_array(), station.as_array(), seed=i)
        pictures[f"photo{i}.png"] = lambda frame=frame: frame
    return pictures


def assert_true(result, truth, least_accuracy=1 / 20_000):
    """Check coordinates against their standard deviations, and the relative accuracy."""
    known = truth.points[[truth.index[name] for name in result.network.names]]
    errors, normalised = cases.normalised_errors(result.network, known)
    assert np.mean(np.abs(normalised) < 3.0) > 0.99
    assert np.abs(normalised).max() < 4.5
    assert rms(errors) / result.network.extent < least_accuracy
    assert result.network.relative_accuracy < least_accuracy


@pytest.fixture(scope="module")
def sheet():
    (sheet,) = lay_out(Design(paper_size("A2", landscape=True), 16.0))
    nominal = field_of((sheet,))
    truth = bent(nominal, sheet.size)
    stations = cases.convergent_stations(truth.points, 12, distance=620.0)
    a, b = (nominal.index[sheet.scale_bar[end]] for end in "ab")
    length = np.linalg.norm(truth.points[a] - truth.points[b]) + 0.0025
    distance = Distance(nominal.names[a], nominal.names[b], float(length), 0.02)
    return nominal, truth, photograph(truth, stations), distance


@pytest.mark.parametrize("given", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_bent_sheet_with_and_without_its_nominal_field(sheet, given):
    """Without it, codes give the names, photographs the diameters. A black, a foreign and a copied
    photograph are named and do no harm."""
    nominal, truth, pictures, distance = sheet
    shape = pictures["photo0.png"]().shape
    noise = np.random.default_rng(0).integers(60, 180, (77, 103), dtype=np.uint8)
    clutter = cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)
    others = {"black.png": lambda: np.zeros(shape, dtype=np.uint8), "wall.png": lambda: clutter}
    jpeg = cv2.imencode(".jpg", pictures["photo0.png"](), [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    others["same.jpg"] = lambda: cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    result = survey(pictures | others, [distance], 0.00224, nominal=nominal if given else None)
    assert not {s.photo for s in result.network.stations} & set(others)
    assert result.measured["wall.png"] == "0 coded targets"
    assert "coded targets" not in result.measured["black.png"]
    assert result.measured["same.jpg"] == REPEATED.format("photo0.png")
    codes = dict(zip(truth.names, truth.codes, strict=True))
    expected = {name: code for name, code in codes.items() if code or given}
    assert dict(zip(result.field.names, result.field.codes, strict=True)) == expected
    assert set(result.network.names) == set(expected)
    assert result.field.diameters == pytest.approx(np.full(len(expected), 16.0), rel=0.01)
    rows = [result.field.index[name] for name in result.network.names]
    assert np.allclose(result.field.points[rows], result.network.points)
    assert_true(result, truth)
    interior = result.network.camera.interior.as_array() - CAMERA.interior.as_array()
    sd = np.sqrt(np.diag(result.network.interior_covariance))
    assert np.abs(interior / sd).max() < 3.7
    assert 0.8 < result.network.sigma0 < 1.25


def test_a_corner_with_four_targets_on_each_wall():
    """Regression: their normals were not known, and their discs not measured."""
    truth, _ = corner_field(2, 150.0, 20.0, bits=12, coded_every=1, inset=60.0)
    rng, middle = np.random.default_rng(5), truth.points.mean(axis=0)
    away = [900 * d / np.linalg.norm(d) for d in 1 + rng.uniform(-0.48, 0.48, (14, 3))]
    pictures = photograph(truth, [look_at(middle + d, middle, i) for i, d in enumerate(away)])
    nominal = replace(truth, points=truth.points + rng.normal(0, 0.3, truth.points.shape))
    length = float(np.linalg.norm(truth.points[0] - truth.points[-1]))
    distance = Distance(truth.names[0], truth.names[-1], length, 0.02)
    result = survey(pictures, [distance], 0.00224, nominal=nominal, interior=CAMERA.interior)
    assert len(result.network.names) == 12
    assert_true(result, truth, 1 / 10_000)


def test_a_marker_whose_code_is_not_read_is_measured_at_its_predicted_place():
    view = VIEWS["frontal"]
    frame = noisy(SCENE.render(SMALL_CAMERA, view), np.random.default_rng(1))
    x, y = SMALL_CAMERA.project(view, FIELD.points[:4]).mean(axis=0)
    cv2.circle(frame, (round(x), round(y)), 45, 120, -1)
    station = SimpleNamespace(photo="a", exterior=view)
    network = SimpleNamespace(camera=SMALL_CAMERA, stations=[station])
    normals = np.full((len(FIELD), 3), np.nan)
    seen = _measure_again({"a": lambda: frame}, network, FIELD, normals, {}, str)["a"]
    assert seen.targets.tolist() == list(range(48))


def test_photographs_that_do_not_fit_together_are_refused(sheet):
    nominal, _, pictures, distance = sheet
    portrait = {"portrait.png": lambda: np.ascontiguousarray(pictures["photo1.png"]().T)}
    black = {"night.png": lambda: np.zeros((1232, 1640), dtype=np.uint8)}
    nowhere = Distance("R65", "P9999", 100.0, 0.1)
    for given, scale, error, reason in (
        (pictures | portrait, distance, ImageError, r"portrait\.png.*1232×1640"),
        (black, distance, ImageError, "no photograph shows a coded target"),
        (dict([*pictures.items()][:2]), distance, GeometryError, "2 photographs"),
        (pictures, nowhere, GeometryError, "P9999"),
    ):
        with pytest.raises(error, match=reason):
            survey(given, [scale], 0.00224, nominal=nominal)
