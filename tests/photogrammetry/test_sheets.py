"""Boards of a field: planes, and what is apart in one plane."""

from __future__ import annotations

import numpy as np

from thermocald.photogrammetry.field.planes import field_sheets
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.physics.testfields import corner_field


def grid(origin, a, b, n=4, step=50.0):
    i, j = np.meshgrid(np.arange(n), np.arange(n))
    return np.array(origin) + step * (i.reshape(-1, 1) * np.array(a) + j.reshape(-1, 1) * b)


def test_three_sheets_of_a_corner():
    labels = field_sheets(corner_field("circles", 5, 80.0))

    assert sorted(np.bincount(labels)) == [25, 25, 25]
    assert all(len(set(labels[k : k + 25])) == 1 for k in (0, 25, 50))


def test_two_boards_on_one_wall_and_a_loose_target():
    rng = np.random.default_rng(1)
    x, y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    points = np.vstack([grid((0, 0, 0), x, y), grid((900, 0, 0), x, y), [[400.0, 50.0, 120.0]]])
    points += rng.normal(0, 1.0, points.shape)
    field = TestField.build([str(k) for k in range(len(points))], points, 1.0)

    labels = field_sheets(field)

    assert labels[-1] == -1
    assert len(set(labels[:16])) == len(set(labels[16:32])) == 1
    assert labels[0] != labels[16]
