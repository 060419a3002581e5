"""The check of a planned test field, compared with adjustments of simulated images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.analysis.field import check_field, precision, station_at, usual_station
from thermocald.errors import GeometryError
from thermocald.output.testfield.sheets import Design, field_of, lay_out, paper_size
from thermocald.photogrammetry.camera.camera_model import (
    DEFAULT_FREE,
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.physics.testfields import corner_field

CAMERA = CameraModel(
    Sensor(3280, 2464, 0.00112), InteriorOrientation(c=3.04, x0=0.01, y0=-0.02, A1=-2e-3)
)
_COLUMNS = [IOP_NAMES.index(name) for name in DEFAULT_FREE]


def _printed(paper, sheets=1, diameter=12.0):
    return field_of(lay_out(Design(paper_size(paper, landscape=True), diameter, sheets=sheets)))


@pytest.mark.parametrize("exact", [True, False], ids=["image noise alone", "field uncertain too"])
def test_predicted_standard_deviations_are_those_of_an_adjustment(exact):
    """Compares with the a-priori covariance of `adjust` for one simulated image."""
    field = replace(corner_field(), sigmas=np.full((147, 3), 1e-9 if exact else 0.05))
    station = usual_station(CAMERA, field)
    check = check_field(CAMERA, field, station, 0.04)
    rng = np.random.default_rng(0)
    image = CAMERA.project(station, field.points)
    seen = Observations(
        np.arange(len(field)), image + rng.normal(0, 0.04, image.shape), np.full(image.shape, 0.04)
    )
    result = adjust(
        CAMERA.sensor, field, seen, CAMERA.interior, station,
        AdjustmentSettings(free=DEFAULT_FREE, snooping_alpha=0.0),
    )  # fmt: skip
    assert result.status == "ok"
    stated = np.sqrt(np.diag(result.covariance))[_COLUMNS] / result.sigma0
    predicted = check.precision["epoch" if exact else "level"]
    # DESIGN idea 3: sd(x0) with 147 targets is 0.3 px per image, 0.005 px in a series
    epoch, series, _ = check.sds_px["x0"]
    assert 0.2 < epoch < 0.6
    assert 0.003 < series < 0.007
    # the adjustment linearises at its own estimate, the check at the plan
    assert predicted == pytest.approx(stated, rel=0.03)


def test_the_usual_station_fills_the_image_and_is_inside_the_corner():
    """In front of a sheet, it looks along its normal."""
    field = corner_field()
    station = usual_station(CAMERA, field)
    image = CAMERA.project(station, field.points)
    assert CAMERA.sensor.contains(image).all()
    reach = np.abs(image - CAMERA.sensor.centre).max(axis=0) / CAMERA.sensor.centre
    assert 0.85 < reach.max() < 0.95
    assert station.centre.min() > field.points.max()
    station = usual_station(CAMERA, _printed("A2"))
    assert station.centre[2] > 0
    assert station.rotation[:, 2] == pytest.approx([0, 0, 1], abs=1e-6)


def test_hidden_targets_have_reasons():
    names = ["seen1", "seen2", "seen3", "seen4", "aside", "behind", "tiny", "coin"]
    points = [[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0], [2000, 0, 0], [0, 0, 900],
              [0, 20, 0], [0, -20, 0]]  # fmt: skip
    field = TestField.build(names, points, 0.1, [8] * 6 + [0.5, 8])
    station = station_at(np.array([0, 0, 500.0]), np.zeros(3))
    check = check_field(CAMERA, field, station)
    assert [field.names[i] for i in check.visible] == ["seen1", "seen2", "seen3", "seen4", "coin"]
    assert check.hidden == {
        "aside": "outside of the image", "behind": "behind the camera", "tiny": "smaller than 8 px",
    }  # fmt: skip
    assert check.sizes == pytest.approx(np.full(5, 8 * 3.04 / 500 / 0.00112), rel=0.03)


@pytest.mark.parametrize("aside_deg", [0, 40])
def test_one_image_of_a_plane_field_is_insufficient_and_needs_depth(aside_deg):
    """Eight numbers of a homography cannot determine nine unknowns, from any station."""
    field, angle = _printed("A2"), np.radians(aside_deg)
    centre = field.points.mean(axis=0)
    place = centre + 700 * np.array([np.sin(angle), 0.1, np.cos(angle)])
    check = check_field(CAMERA, field, station_at(place, centre, 0.3))
    assert np.isinf(check.precision["epoch"][0])
    assert np.isfinite(check.precision["series"][:3]).all()
    first, second = check.advice[:2]
    assert "one plane" in first
    assert "in front of the field" in second
    assert "not determined" in second


def test_proposed_targets_give_the_promised_precision():
    """The promised standard deviation is that of the field with the proposed targets."""
    field = corner_field()
    station = usual_station(CAMERA, field)
    check = check_field(CAMERA, field, station)
    (note,) = [n for n in check.advice if "in front of the field" in n]
    which = ("c", "x₀", "y₀").index(note.split("sd(")[1].split(")")[0])
    promised = float(note.split("→ ")[1].split(" px")[0])
    u, v = np.meshgrid(3280 * np.arange(0.125, 1, 0.25) - 0.5, 2464 * np.array([0.25, 0.75]) - 0.5)
    rays = CAMERA.rays(np.column_stack([u.ravel(), v.ravel()]))
    added = station.centre - (0.75 * check.distance * rays / rays[:, 2:]) @ station.rotation.T
    points = np.concatenate([field.points, added])
    then = precision(CAMERA, station, points, np.full(points.shape, 0.02), 0.03)
    assert then["epoch"][which] / 0.00112 == pytest.approx(promised, rel=0.05)
    assert promised < 0.85 * check.precision["epoch"][which] / 0.00112


def test_empty_parts_an_unsurveyed_print_and_small_targets_are_reported():
    printed = _printed("A3", sheets=3)
    surveyed = replace(printed, sigmas=np.full(printed.points.shape, 0.002))
    small = replace(corner_field(), diameters=np.full(147, 6.0))
    notes = [
        " ".join(check_field(CAMERA, field, usual_station(CAMERA, field)).advice)
        for field in (printed, surveyed, small)
    ]
    assert ["testfield survey" in note for note in notes[:2]] == [True, False]
    assert "empty parts of the image" in notes[0]
    assert "come nearer or print larger" in notes[2]


def test_roll_turns_the_image_about_the_axis():
    """A place that is the point it looks at is refused, and one from where the field is edge-on."""
    place, target = np.array([0, 0, 500.0]), np.zeros(3)
    upright, rolled = (station_at(place, target, roll).rotation for roll in (0.0, np.pi / 2))
    assert rolled[:, 2] == pytest.approx(upright[:, 2])
    assert rolled[:, 0] == pytest.approx(upright[:, 1])
    with pytest.raises(GeometryError, match="is the point it looks at"):
        station_at(target, target)
    aside = station_at(np.array([900.0, 150.0, 60.0]), np.array([200.0, 140.0, 0.0]))
    with pytest.raises(GeometryError, match=r"targets are visible from there: .*edge-on"):
        check_field(CAMERA, _printed("A3"), aside)
