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
def test_a_board_that_moves_is_reported_and_the_cameras_effect_is_named(evidence_of, kind, effects):
    evidence, _ = evidence_of(*effects, px=0.1, seed=2, field_motion=kind)

    found = discover_series(evidence)

    assert tuple(e.effect for e in found.effects) == effects
    document = found.as_dict()["field"]["movements"]
    assert [(m["recording"], m["kind"]) for m in document] == [("M1", kind)]
    assert document[0]["targets"] == [str(i + 1) for i in BOARD]
    # a single camera sees it only across the rays
    assert 0.5 * MOVED_MM < document[0]["size_mm"] < 1.2 * MOVED_MM
    assert document[0]["sd_size_mm"] < 0.01
    assert (document[0]["time_s"] is not None) is (kind == "knock")


@pytest.mark.parametrize("effects", [(), pytest.param(("softening",), marks=pytest.mark.slow)])
def test_a_target_that_wanders_is_reported_and_no_displacement(evidence_of, effects):
    evidence, _ = evidence_of(*effects, px=0.1, seed=2, epochs=60, field_motion="wander")

    found = discover_series(evidence)

    assert tuple(e.effect for e in found.effects) == effects
    (moved,) = found.as_dict()["field"]["movements"]
    assert (moved["kind"], moved["targets"]) == ("wander", [str(TARGET + 1)])


TAGS = (0, 4, 9, 13, 18, 22)
"""Of the nine on each sheet, in order: two on each."""
WANDERING = ((1, 9, 11), (3, 12, 16))
"""Corners that wander: of M1, others of M2."""


def few_tags(source, wandering, course):
    """Keep six tags of a blind recording, some of whose corners wander by 0.3 px."""
    corners = [49 * (t // 9) + 14 * (t % 9 // 3) + 2 * (t % 3) for t in TAGS]
    rows = np.array([at + k for at in corners for k in (0, 1, 7, 8)])
    points = np.array(source.grid.points)[:, rows]
    for k, row in enumerate(wandering):
        way = 0.4 * np.array([np.cos(2.0 * k), np.sin(2.0 * k)])
        points[:, row] += np.outer(course(np.linspace(0, 1, len(points)), k), way)
    field = TestField.build(
        [f"{t}.{k}" for t in TAGS for k in range(4)], source.field.points[rows], 0.02
    )
    return replace(
        source,
        field=replace(field, kinds=("marker_corner",) * len(rows)),
        grid=ObservationGrid(points, np.array(source.grid.weights)[:, rows]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["slip", "thermal_gradient"])
def test_an_effect_is_named_where_corners_of_a_few_tags_wander(effect):
    """They are so few that three of them bend the cameras until none stands out."""
    series, _ = generated(Case((effect,), 0.25, 901, epochs=60))
    inputs = [
        few_tags(s, rows, lambda u, k: np.cos(np.pi * (k + 1) * u + k))
        for s, rows in zip(series, WANDERING, strict=True)
    ]

    found = discover_series(reduce_together(inputs))

    assert [e.effect for e in found.effects] == [effect]
    assert excess_closed(found) == pytest.approx(1.0, abs=0.05)
    moved = [{int(m.rows[0]) for m in each} for each in found.examination.field_movements]
    assert moved == [set(rows) for rows in WANDERING]


@pytest.mark.slow
def test_a_knock_that_may_be_a_slip_is_listed_as_both():
    """So many corners jump that none is left out, and the mount is assumed to move."""
    series, _ = generated(Case(("slip",), 0.25, 901, epochs=60))
    inputs = [
        few_tags(s, range(at, 24, 3), lambda u, k: 0.4 * (u > 0.2 + 0.07 * k))
        for at, s in enumerate(series)
    ]

    found = discover_series(reduce_together(inputs))

    assert found.headline == "adequate: slip or a knock of the mount"
    (knock,) = found.as_dict()["mount"]["knocks"]
    assert knock["not_excluded"] == ["slip"]
    said = "\n".join(Discovery(**vars(found)).lines())
    assert "a knock of the mount or a slip inside the camera" in said
    assert "is missing" not in said
