"""Sessions through the real command: by the running daemon, and without one by the command."""

from __future__ import annotations

import json
import re
import shutil
import signal
from contextlib import nullcontext

import pytest
import yaml

from tests.commands import call
from thermocald.daemon.desk import Watch, take_in_the_daemon
from thermocald.daemon.session import Session
from thermocald.discovery.experiment import Separation
from thermocald.errors import DataError, UsageError
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

SESSION = {"camera": "phone-1", "series": "M7", "start": "cold", "epochs": 8}
COLD = ("session", "start", "--camera", "phone-1", "--series", "M7", "--start", "cold",
        "--no-report")  # fmt: skip


@pytest.fixture
def configured(daemon, devices):
    """Return a call that configures the daemon with a camera whose own series is `watch`."""
    return lambda **changed: daemon.configure(
        **{**devices(**{"period_s": 0.3, "name": "phone-1", **changed}), "outputs": []}
    )


@pytest.fixture
def live(daemon, configured):
    """Return a call that starts the configured daemon."""

    def start(**changed) -> None:
        configured(**changed)
        daemon.start()
        daemon.until(lambda: daemon.ask("session status") is not None)

    daemon.session = lambda: daemon.ask("session status")["sessions"].get("phone-1", {})
    return start


def series_of(path) -> dict[str, tuple[str, list[int]]]:
    """{name: (start, epoch numbers)}"""
    with Store.open(path) as store:
        assert store.examine().damaged == ()
        return {
            s.name: (s.start, store.series_columns(s, ["epoch"])["epoch"].astype(int).tolist())
            for s in store.all_series()
        }


def count(daemon, name: str) -> int:
    """Return how many epochs of a series are stored."""
    try:
        return len(series_of(daemon.store).get(name, ("", []))[1])
    except (ValueError, OSError):  # the store is being created
        return 0


def test_the_command_has_the_daemon_take_a_session_and_ends_with_its_recording(live, daemon):
    live()
    daemon.until(lambda: count(daemon, "watch"))
    shutil.rmtree(daemon.live, ignore_errors=True)
    daemon.until(lambda: daemon.ask("session status") is not None)
    process = daemon.command(*COLD, "--epochs", "4")
    told = process.said()
    assert process.returncode == 0, told
    assert "taken by the daemon" in told
    assert "48 targets" in told
    assert series_of(daemon.store)["M7"] == ("cold", [1, 2, 3, 4])
    recording = read_recording(daemon.folder / "phone-1-M7")
    assert recording.head.extra["start"] == "cold"
    assert recording.head.extra["device"]["serial"] == "mock-1"
    assert recording.head.extra["device"]["thermometers"]["housing"]["serial"] == "mock-0"
    assert len(recording.epochs) == 4
    # the camera is back at its own series, which lacks only the time of the session
    had = count(daemon, "watch")
    daemon.until(lambda: count(daemon, "watch") > had + 1)
    assert daemon.stop() == 0
    numbers = series_of(daemon.store)["watch"][1]
    assert numbers == list(range(1, len(numbers) + 1))
    sessions = [event for event in daemon.events() if event.startswith("session")]
    assert sessions == ["session_begun", "session_ended"]


def test_without_a_daemon_it_is_checked_taken_interrupted_resumed_and_archived(configured, daemon):
    configured()
    daemon.process = daemon.command(*COLD, "--epochs", "5")
    daemon.until(lambda: count(daemon, "M7") >= 2)
    daemon.kill()
    had = count(daemon, "M7")
    again = [word for word in COLD if word not in ("--start", "cold")]
    told = daemon.command(*again, "--epochs", "5").said()
    assert f"; {5 - had} of 5 remain to be taken" in told
    assert "48 targets" in told
    recording = read_recording(daemon.folder / "phone-1-M7")
    assert [epoch.number for epoch in recording.epochs] == list(range(1, 6))
    assert series_of(daemon.store) == {"M7": ("cold", [1, 2, 3, 4, 5])}


@pytest.mark.slow
def test_it_ends_with_the_report(configured, daemon, tmp_path):
    configured()
    daemon.command("session", "start", "--epochs", "30", "--series", "M1").said(200)
    assert "<svg" in (tmp_path / "phone-1-M1.html").read_text()


@pytest.mark.parametrize(
    ("device", "faults"),
    [("camera phone-1", {"camera": [{"kind": "timeout", "at": 1}]}),
     ("thermometer housing", {"thermometer": [{"kind": "timeout", "at": 1, "count": 100}]})],
)  # fmt: skip
def test_a_device_that_gives_nothing_is_told_before_it_begins(configured, daemon, device, faults):
    configured(exposure_s=0.01, **faults)
    process = daemon.command(*COLD, "--epochs", "5")
    told = process.said()
    assert process.returncode == 3
    assert f"error: {device}: " in told
    assert "no answer" in told
    assert series_of(daemon.store) == {}


def test_a_series_begins_with_a_new_observation(live, daemon):
    """Regression: a frozen camera's first epoch was a repeated frame of the series before."""
    live(camera=[{"kind": "stuck", "at": 3, "count": 500}])
    daemon.until(lambda: count(daemon, "watch") > 3)
    daemon.ask("session start", session={**SESSION, "epochs": 3})
    daemon.until(lambda: daemon.session().get("state") == "done")
    assert daemon.stop() == 0
    with Store.open(daemon.store) as store:
        found = store.series_columns(store.series_of("phone-1", "M7"), ["status"])
    assert found["status"].tolist() == ["ok", "repeated_frame", "repeated_frame"]


@pytest.mark.parametrize("running", [True, False])
def test_it_pauses_while_the_phone_is_away_and_survives_a_killed_daemon(
    live, configured, daemon, running
):
    gone = {"series": None, "camera": [{"kind": "unplugged", "at_s": 2.0, "for_s": 2.0}]}
    live(**gone) if running else configured(**gone)
    process = daemon.command(*COLD, "--epochs", "12", "--no-check")
    if running:
        daemon.until(lambda: "the camera is back" in process.printed())
        daemon.kill()
        daemon.until(lambda: "the daemon does not answer" in process.printed(), alive=False)
        daemon.start()
    told = process.said()
    assert process.returncode == 0, told
    assert "paused: " in told
    assert "the camera is back" in told
    assert series_of(daemon.store) == {"M7": ("cold", list(range(1, 13)))}


@pytest.mark.slow
def test_status_and_stop(live, daemon):
    live()
    daemon.command(
        "session", "start", "--series", "M7", "--start", "warm", "--epochs", "1000", "--no-wait"
    ).said()
    daemon.until(lambda: daemon.session().get("taken", 0) >= 2)
    out = call("session", "status", "--json", "-", folder=daemon.folder).stdout
    one = json.loads(out)["sessions"]["phone-1"]
    assert (one["series"], one["start"], one["state"]) == ("M7", "warm", "running")
    line = call("session", "status", folder=daemon.folder).stdout
    assert re.fullmatch(r"phone-1/M7, warm: \d+ of 1000 epochs, running\n", line)
    assert "of 1000 epochs, stopped" in daemon.command("session", "stop").said()
    taken = daemon.session()["taken"]
    # it may be continued, but not as another series
    with pytest.raises(UsageError, match="begun with --start 'warm'"):
        daemon.ask("session start", session=SESSION)
    again = daemon.ask("session start", session={**SESSION, "start": "", "epochs": taken + 2})
    assert again["session"]["state"] == "checking"
    daemon.until(lambda: daemon.session()["state"] == "done")
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"] == ("warm", list(range(1, taken + 3)))


def test_what_cannot_be_taken_is_refused_with_the_reason(live, daemon):
    live()
    hot = [{"seconds": 10.0, "hold_c": None}]
    for wrong, error, words in [
        ({"camera": "nobody"}, UsageError, "there are: phone-1"),
        ({"series": "watch"}, UsageError, "takes series 'watch' all the time"),
        ({"programme": hot}, UsageError, "no output .* heats"),
        ({}, None, ""),
        ({"series": "M8"}, DataError, "taking series 'M7' already"),
    ]:
        with pytest.raises(error, match=words) if error else nullcontext():
            daemon.ask("session start", session={**SESSION, **wrong})
    daemon.ask("session stop", camera="phone-1")
    with pytest.raises(DataError, match="has no session"):
        daemon.ask("session stop", camera="phone-1")
    assert daemon.stop() == 0


@pytest.mark.parametrize("what", ["test field", "thermometer housing", ""])
def test_a_failed_check_is_told_and_nothing_is_begun(live, daemon, recording, what):
    """The camera sees another test field than the configured one; a thermometer is dead. Before
    and after a session the camera rests: its frames would warm a phone before a cold start.
    """
    wrong = {}
    if what == "test field":
        sensor = {"width_px": 820, "height_px": 616, "pixel_pitch_mm": 0.00448}
        wrong = {"sensor": sensor, "testfield": str(recording / "testfield.csv")}
    elif what:
        wrong = {"thermometer": [{"kind": "timeout", "at": 1, "count": 10_000}]}

    def camera(key: str):
        return daemon.status().get("cameras", {}).get("phone-1", {}).get(key, 0)

    live(series=None, **wrong)
    daemon.until(lambda: camera("ticks") >= 2)
    assert camera("device") == "closed"
    daemon.ask("session start", session={**SESSION, "epochs": 3})
    daemon.until(lambda: daemon.session()["state"] == ("refused" if what else "done"))
    assert re.search(
        f"the check failed: .*{what}" if what else "complete: 3 epochs", daemon.session()["why"]
    )
    daemon.until(lambda: camera("device") == "closed")
    assert daemon.stop() == 0
    assert series_of(daemon.store) == ({} if what else {"M7": ("cold", [1, 2, 3])})


def test_a_heater_that_reached_its_limit_is_not_started_again_by_a_session(daemon, devices):
    """Each session began with a new output, which had forgotten the limit."""
    pytest.importorskip("gpiozero")
    sections = devices(period_s=0.3, name="phone-1", series=None)
    steps = [{"seconds": 600, "hold_c": 20}]
    sections["outputs"] = [{"name": "lamp", "driver": "relay", "pin": 17, "limit_c": 24,
                            "programme": steps}]  # fmt: skip
    daemon.configure(**sections)
    daemon.start(GPIOZERO_PIN_FACTORY="mock")
    daemon.until(lambda: daemon.ask("session status") is not None)
    hot = [{"seconds": 10.0, "hold_c": 80.0}]
    with pytest.raises(UsageError, match="hold_c"):
        daemon.ask("session start", session={**SESSION, "programme": hot})
    daemon.ask("session start", session={**SESSION, "programme": steps, "epochs": 200})
    daemon.until(lambda: daemon.status()["outputs"]["lamp"]["device"] == "failed")
    daemon.ask("session stop", camera="phone-1")
    with pytest.raises(DataError, match=r"lamp: .* reached the limit"):
        daemon.ask("session start", session={**SESSION, "series": "M8", "programme": steps})
    daemon.until(lambda: "reached the limit" in str(daemon.status()["warnings"]))
    assert daemon.stop() == 0
    assert daemon.events().count("device_failed") == 1


@pytest.mark.slow
def test_a_session_in_the_daemon_ends_when_the_effects_are_separated(live, daemon):
    """The command watches, the daemon takes the epochs; see also `test_session_separate`."""
    live()
    session = Session.model_validate({**SESSION, "epochs": 4000, "check": False})
    watch = Watch(daemon.store, session, ("creep", "slip"), None, print)
    watch._compare = lambda: Separation("creep", "slip", 55.0, 14.0, True)
    look = watch.look
    watch.look = lambda taken: look(taken + 40) if taken >= 6 else False
    take_in_the_daemon(daemon.live, session, True, print, watch)
    watch.close()
    daemon.until(lambda: daemon.session()["state"] == "stopped")
    assert 6 <= daemon.session()["taken"] < 100
    assert watch.ended
    assert daemon.stop() == 0


@pytest.mark.parametrize(
    ("changed", "state", "why"),
    [pytest.param({"seed": 2}, "done", "complete: 12 epochs", marks=pytest.mark.slow),
     ({"name": "phone-2"}, "stopped", "there are: phone-2")],
)  # fmt: skip
def test_reload_leaves_a_session_alone_whose_camera_stays(live, daemon, changed, state, why):
    """Of a session whose camera is gone it was said "0 of 40 epochs, stopped"."""
    live()
    daemon.ask("session start", session={**SESSION, "epochs": 12, "check": False})
    daemon.until(lambda: daemon.session().get("taken", 0) >= 2)
    document = yaml.safe_load(daemon.config.read_text())
    document["cameras"][0] |= changed
    daemon.config.write_text(yaml.safe_dump(document))
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: daemon.session().get("state") == state)
    session = daemon.session()
    assert why in session["why"]
    assert "the configuration was read again" in daemon.log()
    assert daemon.stop() == 0
    assert series_of(daemon.store)["M7"][1] == list(range(1, session["taken"] + 1))


def test_a_programme_is_taken_up_where_it_was():
    steps = [{"seconds": 600.0, "hold_c": None}, {"seconds": 1500.0, "hold_c": 45.0}]
    session = Session.model_validate({**SESSION, "programme": steps})
    assert session.steps(0.0) == steps
    assert session.steps(700.0) == [{"seconds": 1400.0, "hold_c": 45.0}]
    assert session.steps(5000.0) == [{"seconds": 1.0, "hold_c": None}]
