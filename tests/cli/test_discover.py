"""`thermocald discover`: document, model, report, refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

import thermocald as tc
from tests.blind.case import Case
from tests.blind.generator import generate, write
from tests.cli.conftest import changed
from tests.commands import document, invoke, succeed
from tests.golden.workshop import PROGRAMME
from thermocald.errors import DataError, UsageError


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blind")
    for s in generate(Case(("thermal_lag",), 0.2, 31, epochs=60))[0]:
        write(s, folder / s.name)
    return folder


@pytest.fixture(scope="module")
def found(recordings):
    """The result of M1 verified on M2, with model.yaml and report.html beside the recordings."""
    return succeed(
        "discover", recordings / "M1", "--verify", recordings / "M2", "--json", "-", "--model-out",
        recordings / "model.yaml", "--report", recordings / "report.html",
    )  # fmt: skip


def test_everything_is_written(recordings, found):
    model, report = recordings / "model.yaml", recordings / "report.html"
    told = json.loads(found.stdout)
    assert [e["effect"] for e in told["effects"]] == ["thermal_lag"]
    assert told["model"] == str(model)
    page = report.read_text().replace("\u00a0", " ")
    assert page.count("<figure") == 5
    for words in ("Could noise do this?", "≤ 1/120", "UTC, 60 epochs."):
        assert words in page
    assert "&lt;" not in page  # no object's repr in place of its text
    assert told["effects"][0]["statement"][1:] in page
    stages = (
        "reading", "looking for targets", "measuring noise", "without a further effect",
        "looking for an effect", "beside thermal_lag",
    )  # fmt: skip
    assert [found.stderr.count(stage) for stage in stages[1:3]] == [1, 1]
    assert [*stages] == sorted(stages, key=found.stderr.index)


def test_with_the_model_found_nothing_is_missing(recordings, found):
    """The new model explains the recording, predicts, and keeps its effect in the next version."""
    model, again = recordings / "model.yaml", recordings / "again.yaml"
    known = document("discover", recordings / "M1", "--model", model, "--model-out", again)
    assert known["verdict"] == "adequate"
    cameras = [tc.load_camera(model), tc.load_camera(again)]
    assert [[e.name for e in c.model.effects] for c in cameras] == [["thermal_lag"]] * 2
    first, second = (c.at(c.model.T0) for c in cameras)
    assert np.allclose(first.values[:3], second.values[:3], atol=0.1 * first.sd["c"])


def test_another_camera_is_refused(recordings, tmp_path):
    changed(recordings / "M2", tmp_path / "M2", {"name": "another"})
    with pytest.raises(UsageError, match="M1 is missing"):
        invoke("discover")
    with pytest.raises(DataError, match="another camera"):
        invoke("discover", recordings / "M1", "--verify", tmp_path / "M2")


@pytest.mark.slow
def test_plan_of_a_preset():
    """Every effect of 0.1 px is found, or listed with the effect that it resembles."""
    plan = document("discover", "--plan", "--preset", "rpi-v2.1-heating", "--seeds", "1")
    undecided = {name for pair in plan["ambiguous"] for name in pair["effects"]}
    assert {name for name, power in plan["power"].items() if power < 1} <= undecided
    assert sum(power == 1 for power in plan["power"].values()) >= 14
    assert ["thermal_lag", "time_offset"] in [pair["effects"] for pair in plan["ambiguous"]]


@pytest.mark.slow
def test_plan_of_a_programme(recordings, found, tmp_path):
    """The set-up is a user's model and programme."""
    model, programme = recordings / "model.yaml", tmp_path / "programme.yaml"
    programme.write_text(PROGRAMME)
    set_up = ("--model", model, "--programme", programme, "--seeds", "1", "--strength", "0.3")
    assert document("discover", "--plan", *set_up)["power"]["creep"] == 1.0


@pytest.mark.slow
def test_an_unexplained_misfit_is_bridged_in_the_model(tmp_path):
    series, _ = generate(Case(("outside",), 0.3, 34, epochs=60, with_m2=False))
    write(series[0], tmp_path / "M1")
    found = document("discover", tmp_path / "M1", "--model-out", tmp_path / "m.yaml")
    (entry,) = found["effects"]
    assert entry["effect"] == "unnamed"
    assert entry["evidence"]["base_misfit"]["against"][0]["rms_px"] > 0.05
    written = yaml.safe_load((tmp_path / "m.yaml").read_text())
    assert written.get("effects", []) == []
    bridge = written["evidence"]["unnamed"]["evidence"]["bridge"]
    assert bridge["transferable"] is False
    assert len(bridge["cosines"]["c"]) == 14
