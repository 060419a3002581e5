"""Boards that are knocked or creep, a target that wanders: reported, and none of the camera's."""

from __future__ import annotations

import pytest

from tests.blind.field_motion import BOARD, MOVED_MM, TARGET
from thermocald.discovery.result import discover_series

slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "effects"),
    [
        pytest.param("knock", (), marks=slow),
        ("knock", ("softening",)),
        pytest.param("creep", (), marks=slow),
        pytest.param("creep", ("permanent_set",), marks=slow),
    ],
)
def test_a_board_that_moves_is_reported_and_the_cameras_effect_is_named(evidence_of, kind, effects):
    evidence, _ = evidence_of(*effects, px=0.1, seed=2, field_motion=kind)

    found = discover_series(evidence)

    assert tuple(e.effect for e in found.effects) == effects
    document = found.as_dict()["field"]["movements"]
    assert [(m["recording"], m["kind"]) for m in document] == [("M1", kind)]
    assert document[0]["targets"] == [str(i + 1) for i in BOARD]
    # what one camera sees of it is across the rays
    assert 0.5 * MOVED_MM < document[0]["size_mm"] < 1.2 * MOVED_MM
    assert document[0]["sd_size_mm"] < 0.01
    assert (document[0]["time_s"] is not None) is (kind == "knock")


@pytest.mark.parametrize("effects", [(), pytest.param(("softening",), marks=slow)])
def test_a_target_that_wanders_is_reported_and_no_displacement(evidence_of, effects):
    evidence, _ = evidence_of(*effects, px=0.1, seed=2, field_motion="wander")

    found = discover_series(evidence)

    assert tuple(e.effect for e in found.effects) == effects
    (moved,) = found.as_dict()["field"]["movements"]
    assert (moved["kind"], moved["targets"]) == ("wander", [str(TARGET + 1)])


def test_a_field_that_stands_is_not_reported(evidence_of):
    evidence, _ = evidence_of(px=0.1, seed=2)

    assert "field" not in discover_series(evidence).as_dict()
