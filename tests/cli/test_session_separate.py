"""`session start --until-separated`: a planned programme on the relay, until effects separate."""

from __future__ import annotations

import pytest
import yaml

from tests.commands import answer
from thermocald.config import parse_config
from thermocald.daemon.desk import Watch, take_on_the_desk
from thermocald.daemon.plan import mock_config
from thermocald.daemon.session import Session
from thermocald.discovery.experiment import Separation
from thermocald.store.database.store import Store

PIN, LIMIT_C = 17, 45.0


def heated(folder, period_s):
    """The configuration of the mock camera, a thermometer and a relay that heats."""
    document = mock_config().model_dump(mode="json", by_alias=True)
    document["store"]["path"] = str(folder / "t.db")
    document["outputs"] = [{
        "name": "lamp", "driver": "relay", "pin": PIN, "limit_c": LIMIT_C,
        "programme": [{"seconds": 1, "hold_c": None}],
    }]  # fmt: skip
    document["cameras"][0]["period_s"] = period_s
    return document


@pytest.fixture
def config(tmp_path, monkeypatch):
    """Run it on mock pins, with epochs as fast as possible."""
    monkeypatch.setenv("GPIOZERO_PIN_FACTORY", "mock")
    monkeypatch.chdir(tmp_path)
    document = heated(tmp_path, 0.4)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    return parse_config(document, tmp_path / "config.yaml")


def run(*arguments):
    return answer("session", "start", "--epochs", 4500, *arguments)


def test_a_dry_run_prints_a_programme_that_a_session_takes(config, tmp_path):
    result = run("--until-separated", "permanent_set,self_heating", "--dry-run", "--max-rate", "2")
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
        (["--until-separated", "creep"], "give two different effects"),
        (["--dry-run"], "--dry-run needs --until-separated"),
        (["--until-separated", "creep,slip", "--max-temperature", "23"],
         "0.5 K of warming above 22.0 °C; 5 K"),
        (["--until-separated", "creep,slip", "--epochs", "50"],
         "50 epochs of 0.4 s are 0 min; heat needs 15 min"),
    ],
)  # fmt: skip
def test_wrong_usage_is_said(config, arguments, said):
    result = run(*arguments)
    assert result.exit_code != 0
    assert said in str(result.exception or result.output)


def test_without_a_heater_there_is_nothing_to_plan(config, tmp_path):
    document = yaml.safe_load((tmp_path / "config.yaml").read_text())
    document["outputs"] = []
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    result = run("--until-separated", "creep,slip", "--dry-run")
    assert "no output of the configuration heats" in str(result.exception or result.output)


@pytest.mark.slow
def test_the_session_heats_and_ends_when_they_are_separated(config, tmp_path, monkeypatch):
    from gpiozero import Device

    camera = config.cameras[0].name
    session = Session(
        camera=camera, series="M1", epochs=60, check=False,
        programme=[{"seconds": 600.0, "hold_c": 44.0}],
    )  # fmt: skip
    seen, heated = [], []
    monkeypatch.setattr("thermocald.daemon.desk._FEWEST", 4)
    watch = Watch(config.store.path, session, ("creep", "slip"), None, print)

    def compared():
        with Store.open(config.store.path) as store:
            seen.append(store.last_epoch(store.find_series(camera, "M1")))
        heated.append(Device.pin_factory.pin(17).state)
        return Separation("creep", "slip", 55.0, 14.0, True)

    monkeypatch.setattr(watch, "_compare", compared)
    take_on_the_desk(config, session, print, watch)
    watch.close()

    with Store.open(config.store.path) as store:
        taken = store.last_epoch(store.find_series(camera, "M1"))
    assert seen
    assert 4 <= taken < 60
    assert heated == [1]
    assert Device.pin_factory.pin(17).state == 0
    assert watch.ended
