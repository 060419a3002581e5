"""Boards that are knocked or creep and targets that wander are reported, not as the camera's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.bridge import generated
from tests.blind.case import Case
from tests.blind.field_motion import BOARD, MOVED_MM, TARGET
from tests.blind.outcome import excess_closed
from thermocald.discovery.result import discover_series
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.results import Discovery
from thermocald.thermal.reduce import reduce_together


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "effects"),
    [("knock", ()), ("knock", ("softening",)), ("creep", ()), ("creep", ("permanent_set",))],
)
def test_a_board_that_moves_is_reported_and_the_cameras_effect_is_named(discovered, kind, effects):
    found, _ = discovered(*effects, px=0.1, seed=2, field_motion=kind)
    assert tuple(e.effect for e in found.effects) == effects
    (moved,) = found.as_dict()["field"]["movements"]
    assert (moved["recording"], moved["kind"]) == ("M1", kind)
    assert moved["targets"] == [str(i + 1) for i in BOARD]
    # a single camera sees it only across the rays
    assert 0.5 * MOVED_MM < moved["size_mm"] < 1.2 * MOVED_MM
    assert moved["sd_size_mm"] < 0.01
    assert (moved["time_s"] is not None) is (kind == "knock")


@pytest.mark.parametrize("effects", [(), pytest.param(("softening",), marks=pytest.mark.slow)])
def test_a_target_that_wanders_is_reported_and_no_displacement(discovered, effects):
    found, _ = discovered(*effects, px=0.1, seed=2, epochs=60, field_motion="wander")
    assert tuple(e.effect for e in found.effects) == effects
    (moved,) = found.as_dict()["field"]["movements"]
    assert (moved["kind"], moved["targets"]) == ("wander", [str(TARGET + 1)])


TAGS = (0, 4, 9, 13, 18, 22)
"""Of the nine on each sheet, in order: two on each."""


def few_tags(effect, wandering, course):
    """Discover an effect where six tags are seen, some of whose corners wander by 0.3 px.

    wandering: rows of M1's corners and of M2's; course: of their number and the time, 0 to 1.
    """
    corners = [49 * (t // 9) + 14 * (t % 9 // 3) + 2 * (t % 3) for t in TAGS]
    rows = np.array([at + k for at in corners for k in (0, 1, 7, 8)])
    names, inputs = [f"{t}.{k}" for t in TAGS for k in range(4)], []
    series, _ = generated(Case((effect,), 0.25, 901, epochs=60))
    for source, moved in zip(series, wandering, strict=True):
        points = np.array(source.grid.points)[:, rows]
        for k, row in enumerate(moved):
            way = 0.4 * np.array([np.cos(2.0 * k), np.sin(2.0 * k)])
            points[:, row] += np.outer(course(np.linspace(0, 1, len(points)), k), way)
        field = TestField.build(names, source.field.points[rows], 0.02)
        field = replace(field, kinds=("marker_corner",) * len(rows))
        grid = ObservationGrid(points, np.array(source.grid.weights)[:, rows])
        inputs.append(replace(source, field=field, grid=grid))
    return discover_series(reduce_together(inputs))


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["slip", "thermal_gradient"])
def test_an_effect_is_named_where_corners_of_a_few_tags_wander(effect):
    """They are so few that three of them bend the cameras until none stands out."""
    wandering = [{1, 9, 11}, {3, 12, 16}]

    found = few_tags(effect, map(sorted, wandering), lambda u, k: np.cos(np.pi * (k + 1) * u + k))

    assert [e.effect for e in found.effects] == [effect]
    assert excess_closed(found) == pytest.approx(1.0, abs=0.05)
    moved = [{int(m.rows[0]) for m in each} for each in found.examination.field_movements]
    assert moved == wandering


@pytest.mark.slow
def test_a_knock_that_may_be_a_slip_is_listed_as_both():
    """So many corners jump that none is left out, and the mount is assumed to move."""
    jumping = range(0, 24, 3), range(1, 24, 3)

    found = few_tags("slip", jumping, lambda u, k: 0.4 * (u > 0.2 + 0.07 * k))

    assert found.headline == "adequate: slip or a knock of the mount"
    (knock,) = found.as_dict()["mount"]["knocks"]
    assert knock["not_excluded"] == ["slip"]
    said = "\n".join(Discovery(**vars(found)).lines())
    assert "a knock of the mount or a slip inside the camera" in said
    assert "is missing" not in said
