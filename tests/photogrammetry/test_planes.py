"""The sheets of a field, and targets' normals from their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from tests.photogrammetry.fields import corner_field
from thermocald.photogrammetry.field.planes import field_normals, field_sheets, target_normals
from thermocald.photogrammetry.field.testfield import TestField

RNG = np.random.default_rng(4)


@pytest.mark.parametrize(
    "layout",
    [{}, {"per_side": 3}, {"per_side": 4, "inset": 20.0}, {"per_side": 3, "inset": 3.0}],
    ids=["7", "3", "near the edge", "at the edge"],
)
def test_the_sheets_of_a_corner_are_separated(layout):
    field, normals = corner_field(**layout)
    found = field_normals(field)
    assert np.all(np.abs(np.sum(found * normals, axis=1)) > 0.9999)
    labels = field_sheets(field).reshape(3, -1)
    assert sorted(labels[:, 0]) == [0, 1, 2]
    assert (labels == labels[:, :1]).all()


@pytest.mark.parametrize("planes", [2, 3])
@pytest.mark.parametrize("stretch", [1.0, 1.5])
@pytest.mark.parametrize(("spacing", "inset"), [(60, 20), (60, 45), (60, 100), (300, 20)])
def test_four_targets_on_each_wall_are_plates(planes, stretch, spacing, inset):
    """Regression: the inner ones of several walls formed a plate or a board, or none had a normal.

    (300, 20): large sheets with a target in each corner.
    """
    field, normals = corner_field(2, spacing, inset=inset)
    some = slice(4 * planes)
    points = field.points[some] * [1.0, 1.0, stretch]
    points += np.random.default_rng(2).normal(0, 0.2, points.shape)
    assert np.all(np.abs(np.sum(target_normals(points) * normals[some], axis=1)) > 0.999)


def test_two_boards_on_one_wall_and_a_loose_target():
    board = 50.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4), 0), axis=-1).reshape(-1, 3)
    points = np.vstack([board, board + np.array([900.0, 0, 0]), [[400.0, 50.0, 120.0]]])
    points += np.random.default_rng(1).normal(0, 1.0, points.shape)
    labels = field_sheets(TestField.build([str(k) for k in range(33)], points, 1.0))
    assert labels[-1] == -1
    assert len(set(labels[:16])) == len(set(labels[16:32])) == 1
    assert labels[0] != labels[16]


@pytest.mark.parametrize(("columns", "rows", "step", "bend"), [(12, 9, 30, 2), (16, 12, 50, 50)])
def test_all_rows_of_a_bent_sheet_have_its_normals(columns, rows, step, bend):
    x, y = (g.ravel() * step for g in np.meshgrid(np.arange(columns), np.arange(rows)))
    u = 2 * x / x.max() - 1
    z = bend * (1 - u**2) + np.random.default_rng(1).normal(0, 0.05, x.shape)
    true = np.column_stack([4 * bend * u / x.max(), 0 * u, np.ones_like(u)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    cosine = np.abs(np.sum(target_normals(np.c_[x, y, z]) * true, axis=1))
    assert np.degrees(np.arccos(cosine.clip(max=1))).max() < 4.0


@pytest.mark.parametrize(
    ("points", "most"),
    [(RNG.uniform(0, 1000, (12, 3)), 0), (RNG.uniform(0, 1000, (147, 3)), 18), (np.eye(3), 0)],
)
def test_scattered_and_few_targets_have_no_plane(points, most):
    """Of 147 a quarter seemed to be on boards, in planes of targets that have others nearer."""
    assert np.isfinite(target_normals(points)[:, 0]).sum() <= most


def test_marker_corners_help_but_have_no_normals():
    points = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0], [50, 50, 0]]
    field = TestField.build(
        list("abcde"), points, kinds=["marker_corner"] * 4 + ["circle"], diameters=10
    )
    normals = field_normals(field)
    assert np.isnan(normals[:4]).all()
    assert abs(normals[4, 2]) == pytest.approx(1.0)
