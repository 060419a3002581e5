"""`session start --until-separated`: a planned programme on the relay, until effects separate."""

from __future__ import annotations

from concurrent.futures import wait

import pytest
import yaml

import thermocald as tc
from tests.commands import answer, finish
from thermocald.daemon.desk import Watch
from thermocald.daemon.plan import mock_config
from thermocald.daemon.session import Session

PIN, LIMIT_C = 17, 45.0


@pytest.fixture
def configure(tmp_path, monkeypatch):
    """Write config.yaml: the mock camera, a thermometer and a relay that heats."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GPIOZERO_PIN_FACTORY", "mock")

    def write(**changes):
        document = mock_config().model_dump(mode="json", by_alias=True)
        document["store"]["path"] = str(tmp_path / "t.db")
        document["outputs"] = [{
            "name": "lamp", "driver": "relay", "pin": PIN, "limit_c": LIMIT_C,
            "programme": [{"seconds": 1, "hold_c": None}],
        }]  # fmt: skip
        document["cameras"][0]["period_s"] = 0.4
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(document | changes))

    return write


def run(*arguments):
    return answer("session", "start", "--epochs", 4500, "--until-separated", *arguments)


def test_a_dry_run_prints_a_programme_that_a_session_takes(configure, tmp_path):
    configure()
    result = run("permanent_set,self_heating", "--dry-run", "--max-rate", "2")
    assert result.exit_code == 0, result.output
    steps = yaml.safe_load(result.stdout)["programme"]
    session = Session(camera="mock", series="M1", epochs=5, programme=[
        {"seconds": float(s["seconds"]), "hold_c": s["hold_c"]} for s in steps])  # fmt: skip
    assert max(s.hold_c for s in session.programme if s.hold_c) <= 44.0
    assert "sd at the end" in result.stdout
    assert not (tmp_path / "t.db").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--max-temperature 23", "0.5 K of warming above 22.0 °C; 5 K"),
        ("--epochs 50", "50 epochs of 0.4 s are 0 min; heat needs 15 min"),
        ("--dry-run", "no output of the configuration heats"),
    ],
)
def test_what_cannot_be_planned_is_said(configure, arguments, said):
    configure(**({"outputs": []} if arguments == "--dry-run" else {}))
    result = run("creep,slip", *arguments.split())
    assert result.exit_code != 0
    assert said in str(result.exception or result.output)


@pytest.mark.slow
def test_a_watch_ends_a_session_when_the_stored_epochs_separate_the_effects(tmp_path):
    """Only the program itself compares the effects."""
    true = {"permanent_set": {"c": 1e-5, "x0": 6e-5, "y0": 4e-5}}
    tc.simulate("rpi-v2.1-heating", effects=true, own_effects=False, out=tmp_path / "M1")
    finish("replay", tmp_path / "M1", "--store", tmp_path / "t.db")
    session = Session(camera="rpi-v2.1", series="M1", epochs=150, check=False)
    said = []
    watch = Watch(tmp_path / "t.db", session, ("creep", "permanent_set"), None, said.append)
    watch.look(150)
    wait([watch._pending])
    assert watch.look(150)
    watch.close()
    assert watch.found.better == "permanent_set"
    assert "creep is excluded" in " ".join(said)
