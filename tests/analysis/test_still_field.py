"""Replay and study report knocked boards and wandering targets, and leave them out."""

from __future__ import annotations

import json

import numpy as np
import pytest

import thermocald as tc
from tests.blind.case import Case
from tests.blind.field_motion import BOARD, TARGET
from tests.blind.generator import generate, write
from tests.commands import succeed

EPOCHS = 50


def recorded(tmp_path, field_motion):
    """Write recordings of a camera with a base drift, before a moving and a still field."""
    for name, kind in (("still", ""), ("moved", field_motion)):
        case = Case((), 0.1, 3, epochs=EPOCHS, with_m2=False, field_motion=kind, noise_px=0.04)
        write(generate(case)[0][0], tmp_path / name)
    return tmp_path / "moved", tmp_path / "still"


def replayed(folder):
    return json.loads(succeed("replay", folder, "--json", "-").stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "targets"),
    [
        ("knock", [str(i + 1) for i in BOARD]),
        ("creep", [str(i + 1) for i in BOARD]),
        ("wander", [str(TARGET + 1)]),
    ],
)
def test_a_movement_of_the_field_is_reported_and_is_no_drift(tmp_path, kind, targets):
    moved, still = recorded(tmp_path, kind)

    found, plain = replayed(moved), replayed(still)

    assert plain["field_movements"] == []
    assert [(m["kind"], m["targets"]) for m in found["field_movements"]] == [(kind, targets)]
    assert found["ok"] == plain["ok"] == EPOCHS
    for a, b in zip(found["parameters"], plain["parameters"], strict=True):
        sd = np.hypot(a["sd_change"], b["sd_change"])
        assert abs(a["change"] - b["change"]) < 3 * sd, a["name"]
        assert a["scatter_over_sd"] < 1.5 * b["scatter_over_sd"]
    succeed("study", moved, "--json", tmp_path / "study.json")
    text = (tmp_path / "study.json").read_text()
    assert f'"kind": "{kind}"' in text
    assert "The test field moved" in text or kind == "wander"


def test_a_board_that_alone_is_seen_has_not_moved(tmp_path):
    """Regression: a board moved by 0.7 m, and no epoch after the others vanished was accepted."""
    tc.simulate("rpi-v2.1-heating", seed=1, epochs=75, out=tmp_path / "M1")
    file = tmp_path / "M1" / "observations.csv"
    head, *rows = file.read_text().splitlines()
    left = [row for row in rows if int(row.split(",")[0]) <= 40 or row.split(",")[1][0] == "z"]
    file.write_text("\n".join([head, *left, ""]))

    found = tc.open(tmp_path / "M1").calibrate().as_dict()

    assert found["field_movements"] == []
    assert found["ok"] == 75
    c = found["parameters"][0]
    assert abs(c["per_kelvin"] - 0.1995e-3) < 4 * c["sd_per_kelvin"]
