"""Sessions of the real daemon through the real command, as processes."""

from __future__ import annotations

import json
import re
import shutil
import signal
from functools import partial

import pytest
import yaml

from tests.commands import call
from thermocald.daemon.control import ask
from thermocald.daemon.desk import Watch, take_in_the_daemon
from thermocald.daemon.session import Session
from thermocald.discovery.experiment import Separation
from thermocald.errors import DataError, UsageError
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

SESSION = {"camera": "phone-1", "series": "M7", "start": "cold", "epochs": 8}


@pytest.fixture
def live(daemon, devices):
    """configured → a running daemon with a camera whose own series is `watch`."""

    def start(**configured):
        sections = devices(**{"period_s": 0.3, "name": "phone-1", **configured})
        sections["outputs"] = []
        daemon.run(**sections)
        daemon.until(lambda: ask(folder, "session status") is not None)
        return daemon

    folder = daemon.store.with_name(daemon.store.name + ".live")
    daemon.live = folder
    daemon.ask = lambda do, **values: ask(folder, do, **values)
    daemon.session = lambda: ask(folder, "session status")["sessions"].get("phone-1", {})
    return start


@pytest.fixture
def command(daemon, spawn):
    """options → `thermocald session …` in the daemon's folder, running."""
    return partial(spawn, daemon.folder, "session")


def series_of(path) -> dict[str, tuple[str, list[int]]]:
    """{name: (start, epoch numbers)}"""
    with Store.open(path) as store:
        assert store.examine().damaged == ()
        return {
            s.name: (s.start, store.series_columns(s, ["epoch"])["epoch"].astype(int).tolist())
            for s in store.all_series()
        }


def test_the_command_has_the_daemon_take_a_session_and_ends_with_its_recording(live, command):
    daemon = live()
    daemon.until(lambda: "watch" in series_of(daemon.store))
    shutil.rmtree(daemon.live, ignore_errors=True)
    daemon.until(lambda: ask(daemon.live, "session status") is not None)
    process = command("start", "--camera", "phone-1", "--series", "M7", "--start", "cold",
                      "--epochs", "4", "--no-report")  # fmt: skip
    told = process.said()
    assert process.returncode == 0, told
    assert "taken by the daemon" in told
    assert "48 targets" in told
    stored = series_of(daemon.store)
    assert stored["M7"] == ("cold", list(range(1, 5)))
    recording = read_recording(daemon.folder / "phone-1-M7")
    assert recording.head.extra["start"] == "cold"
    assert recording.head.extra["device"]["serial"] == "mock-1"
    assert recording.head.extra["device"]["thermometers"]["housing"]["serial"] == "mock-0"
    assert len(recording.epochs) == 4
    # the camera is back at its own series, which lacks only the time of the session
    count = len(stored["watch"][1])
    daemon.until(lambda: len(series_of(daemon.store)["watch"][1]) > count + 1)
    assert daemon.stop() == 0
    numbers = series_of(daemon.store)["watch"][1]
    assert numbers == list(range(1, len(numbers) + 1))
    assert [e for e in daemon.events() if e.startswith("session")] == [
        "session_begun", "session_ended"
    ]  # fmt: skip


def test_a_series_begins_with_a_new_observation(live):
    """Regression: a frozen camera's first epoch was a repeated frame of the series before."""
    daemon = live(camera=[{"kind": "stuck", "at": 3, "count": 500}])
    daemon.until(lambda: len(series_of(daemon.store).get("watch", ("", []))[1]) > 3)
    daemon.ask("session start", session={**SESSION, "epochs": 3})
    daemon.until(lambda: daemon.session().get("state") == "done")
    assert daemon.stop() == 0
    with Store.open(daemon.store) as store:
        found = store.series_columns(store.series_of("phone-1", "M7"), ["status"])
    assert found["status"].tolist() == ["ok", "repeated_frame", "repeated_frame"]


def test_a_daemon_that_is_killed_goes_on_with_the_session(live):
    daemon = live()
    daemon.ask("session start", session={**SESSION, "epochs": 5})
    daemon.until(lambda: daemon.session().get("last", {}).get("epoch", 0) >= 1)
    daemon.kill()
    had = len(series_of(daemon.store)["M7"][1])
    assert 1 <= had < 5
    daemon.start()
    daemon.until(lambda: daemon.ask("session status") is not None)
    daemon.until(lambda: daemon.session()["state"] == "done")
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"] == ("cold", list(range(1, 6)))


@pytest.mark.slow
def test_it_pauses_while_the_phone_is_away_and_the_command_survives_a_restart(live, command):
    daemon = live(series=None, camera=[{"kind": "unplugged", "at_s": 2.0, "for_s": 4.0}])
    process = command("start", "--camera", "phone-1", "--series", "M7", "--epochs", "12",
                      "--no-report", "--no-check")  # fmt: skip
    daemon.until(lambda: "paused: " in process.printed())
    daemon.until(lambda: "the camera is back" in process.printed())
    daemon.kill()
    daemon.until(lambda: "the daemon does not answer" in process.printed(), alive=False)
    daemon.start()
    told = process.said()
    assert process.returncode == 0, told
    assert len(read_recording(daemon.folder / "phone-1-M7").epochs) == 12


def test_a_camera_without_a_series_rests_until_a_session(live, daemon):
    """A phone must not be warmed by its own frames before a cold start."""
    live(series=None)
    daemon.until(lambda: daemon.status() and daemon.status()["cameras"]["phone-1"]["ticks"] >= 2)
    assert daemon.status()["cameras"]["phone-1"]["device"] == "closed"
    daemon.ask("session start", session={**SESSION, "epochs": 3})
    daemon.until(lambda: daemon.session()["state"] == "done")
    assert len(daemon.session()["found"]) >= 2
    daemon.until(lambda: daemon.status()["cameras"]["phone-1"]["device"] == "closed")
    assert daemon.stop() == 0
    assert series_of(daemon.store) == {"M7": ("cold", [1, 2, 3])}


@pytest.mark.slow
def test_status_and_stop(live, command, daemon):
    live()
    process = command("start", "--series", "M7", "--start", "warm", "--epochs", "1000", "--no-wait")
    told = process.said()
    assert process.returncode == 0, told
    daemon.until(lambda: daemon.session().get("taken", 0) >= 2)
    out = call("session", "status", "--json", "-", folder=daemon.folder).stdout
    one = json.loads(out)["sessions"]["phone-1"]
    assert (one["series"], one["start"], one["state"]) == ("M7", "warm", "running")
    line = call("session", "status", folder=daemon.folder).stdout
    assert re.fullmatch(r"phone-1/M7, warm: \d+ of 1000 epochs, running\n", line)
    assert "of 1000 epochs, stopped" in command("stop").said()
    taken = daemon.session()["taken"]
    assert daemon.session()["state"] == "stopped"
    # it may be continued, but not as another series
    with pytest.raises(UsageError, match="begun with --start 'warm'"):
        daemon.ask("session start", session={**SESSION, "start": "cold"})
    again = daemon.ask("session start", session={**SESSION, "start": "", "epochs": taken + 2})
    assert again["session"]["state"] == "checking"
    daemon.until(lambda: daemon.session()["state"] == "done")
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"] == ("warm", list(range(1, taken + 3)))


def test_what_cannot_be_taken_is_refused_with_the_reason(live, daemon):
    live()
    for wrong, error, words in [
        ({"camera": "nobody"}, UsageError, "there are: phone-1"),
        ({"series": "watch"}, UsageError, "takes series 'watch' all the time"),
        ({"programme": [{"seconds": 10.0, "hold_c": None}]}, UsageError, "no output .* heats"),
    ]:
        with pytest.raises(error, match=words):
            daemon.ask("session start", session={**SESSION, **wrong})
    with pytest.raises(DataError, match="has no session"):
        daemon.ask("session stop", camera="phone-1")
    daemon.ask("session start", session=SESSION)
    with pytest.raises(DataError, match="taking series 'M7' already"):
        daemon.ask("session start", session={**SESSION, "series": "M8"})
    assert daemon.stop() == 0


@pytest.mark.parametrize("what", ["another field", "thermometer housing"])
def test_a_failed_check_is_told_and_nothing_is_begun(live, daemon, what):
    """The camera sees another test field than the configured one; a thermometer is dead."""
    wrong = {"thermometer": [{"kind": "timeout", "at": 1, "count": 10_000}]}
    if what == "another field":
        other = daemon.folder / "other.csv"
        other.write_text("target,X,Y,Z,diameter,sX,sY,sZ\n" + "".join(
            f"t{k},{100 * (k % 4)},{100 * (k // 4)},{10 * k},10,0.1,0.1,0.1\n" for k in range(12)
        ))  # fmt: skip
        sensor = {"width_px": 820, "height_px": 616, "pixel_pitch_mm": 0.00448}
        wrong, what = {"sensor": sensor, "testfield": str(other)}, "test field"
    live(series=None, **wrong)
    daemon.ask("session start", session=SESSION)
    daemon.until(lambda: daemon.session()["state"] == "refused")
    assert "the check failed" in daemon.session()["why"]
    assert what in daemon.session()["why"]
    assert daemon.stop() == 0
    assert series_of(daemon.store) == {}


def test_a_heater_that_reached_its_limit_is_not_started_again_by_a_session(daemon, devices):
    """Each session began with a new output, which had forgotten the limit."""
    pytest.importorskip("gpiozero")
    sections = devices(period_s=0.3, name="phone-1", series=None)
    steps = [{"seconds": 600, "hold_c": 20}]
    sections["outputs"] = [{"name": "lamp", "driver": "relay", "pin": 17, "limit_c": 24,
                            "programme": steps}]  # fmt: skip
    daemon.configure(**sections)
    daemon.start(GPIOZERO_PIN_FACTORY="mock")
    folder = daemon.store.with_name(daemon.store.name + ".live")
    daemon.until(lambda: ask(folder, "session status") is not None)
    hot = [{"seconds": 10.0, "hold_c": 80.0}]
    with pytest.raises(UsageError, match="hold_c"):
        ask(folder, "session start", session={**SESSION, "programme": hot})
    started = ask(folder, "session start", session={**SESSION, "programme": steps, "epochs": 200})
    assert started["session"]["state"] == "checking"
    daemon.until(lambda: daemon.status()["outputs"]["lamp"]["device"] == "failed")
    ask(folder, "session stop", camera="phone-1")
    with pytest.raises(DataError, match=r"lamp: .* reached the limit"):
        ask(folder, "session start", session={**SESSION, "series": "M8", "programme": steps})
    daemon.until(lambda: "reached the limit" in str(daemon.status()["warnings"]))
    assert daemon.stop() == 0
    assert daemon.events().count("device_failed") == 1


@pytest.mark.slow
def test_a_session_in_the_daemon_ends_when_the_effects_are_separated(live, daemon):
    """The command watches, the daemon takes the epochs; see also `test_session_separate`."""
    live()
    session = Session.model_validate({**SESSION, "epochs": 4000, "check": False})
    said: list[str] = []
    watch = Watch(daemon.store, session, ("creep", "slip"), None, said.append)
    watch._compare = lambda: Separation("creep", "slip", 55.0, 14.0, True)
    enough, look = 6, watch.look
    watch.look = lambda taken: look(taken + 40) if taken >= enough else False
    take_in_the_daemon(daemon.live, session, True, said.append, watch)
    watch.close()
    daemon.until(lambda: daemon.session()["state"] == "stopped")
    assert enough <= daemon.session()["taken"] < 100
    assert watch.ended
    assert daemon.stop() == 0


def reload(daemon, **changes) -> None:
    """Change the camera's section of the configuration while a session runs."""
    daemon.ask("session start", session={**SESSION, "epochs": 12, "check": False})
    daemon.until(lambda: daemon.session().get("taken", 0) >= 2)
    document = yaml.safe_load(daemon.config.read_text())
    document["cameras"][0] |= changes
    daemon.config.write_text(yaml.safe_dump(document))
    daemon.signal(signal.SIGHUP)


@pytest.mark.slow
def test_reload_leaves_a_session_alone(live, daemon):
    live()
    reload(daemon, seed=2)
    daemon.until(lambda: daemon.session().get("state") == "done")
    assert "the configuration was read again" in daemon.log()
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"][1] == list(range(1, 13))


def test_a_session_whose_camera_is_gone_has_the_epochs_that_it_took(live, daemon):
    """It was "0 of 40 epochs, stopped"."""
    live()
    reload(daemon, name="phone-2")
    daemon.until(lambda: daemon.session().get("state") == "stopped")
    session = daemon.session()
    assert "there are: phone-2" in session["why"]
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"][1] == list(range(1, session["taken"] + 1))


def test_a_programme_is_taken_up_where_it_was():
    steps = [{"seconds": 600.0, "hold_c": None}, {"seconds": 1500.0, "hold_c": 45.0}]
    session = Session.model_validate({**SESSION, "programme": steps})
    assert session.steps(0.0) == steps
    assert session.steps(700.0) == [{"seconds": 1400.0, "hold_c": 45.0}]
    assert session.steps(5000.0) == [{"seconds": 1.0, "hold_c": None}]
