"""Normals of targets from their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from tests.photogrammetry.fields import corner_field
from thermocald.photogrammetry.field.planes import field_normals, target_normals
from thermocald.photogrammetry.field.testfield import TestField


@pytest.mark.parametrize(
    "layout",
    [{}, {"per_side": 3}, {"per_side": 6, "spacing": 75.0}, {"per_side": 4, "inset": 20.0}],
    ids=["7", "3", "6", "4 near the edge"],
)
def test_sheets_of_a_corner_are_told_apart(layout):
    field, normals = corner_field(**layout)
    found = field_normals(field)
    assert np.all(np.abs(np.sum(found * normals, axis=1)) > 0.9999)


def test_a_sheet_may_bulge():
    x, y = (g.ravel() for g in np.meshgrid(np.arange(8) * 60.0, np.arange(8) * 60.0))
    z = 2 * (1 - ((x - 210) ** 2 + (y - 210) ** 2) / 210**2)  # 4 mm from the middle to a corner
    slope = np.column_stack([4 * (x - 210) / 210**2, 4 * (y - 210) / 210**2, np.ones_like(x)])
    true = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.abs(np.sum(target_normals(np.c_[x, y, z]) * true, axis=1))))
    assert np.max(angle) < 3.0


def test_targets_scattered_in_space_have_no_plane():
    points = np.random.default_rng(4).uniform(0, 1000, (12, 3))
    assert np.isnan(target_normals(points)).all()


def test_few_targets_have_no_plane():
    assert np.isnan(target_normals(np.eye(3))).all()


def test_marker_corners_help_and_get_none():
    points = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0], [50, 50, 0]]
    field = TestField.build(
        list("abcde"), points, kinds=["marker_corner"] * 4 + ["circle"], diameters=10
    )
    normals = field_normals(field)
    assert np.isnan(normals[:4]).all()
    assert abs(normals[4, 2]) == pytest.approx(1.0)
