"""A single command leads from a camera to epochs, a recording and a report."""

from __future__ import annotations

import pytest

from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording


@pytest.fixture
def session(daemon, devices, spawn):
    """options → a running `thermocald session start` in a folder with a configuration."""

    def start(*options: str, **configured):
        sections = devices(period_s=0.3, name="phone-1", **configured)
        daemon.configure(**{**sections, "outputs": []})
        return spawn(daemon.folder, "session", "start", *options)

    return start


def test_it_is_checked_taken_interrupted_resumed_and_archived(session, daemon):
    command = ["--camera", "phone-1", "--series", "M7", "--start", "cold", "--epochs", "5",
               "--no-report"]  # fmt: skip
    first = session(*command)
    daemon.process = first
    daemon.until(lambda: _epochs(daemon.store) >= 2)
    daemon.kill()
    had = _epochs(daemon.store)
    second = session(*command)
    told = second.said()
    assert second.returncode == 0, told
    assert f"has {had} epochs; {5 - had} are still to be taken" in told
    assert "48 targets" in told
    recording = read_recording(daemon.folder / "phone-1-M7")
    assert [epoch.number for epoch in recording.epochs] == list(range(1, 6))
    with Store.open(daemon.store) as store:
        series = store.find_series()
        assert (series.start, series.identity["serial"]) == ("cold", "mock-1")


def _epochs(path) -> int:
    if not path.exists():
        return 0
    try:
        with Store.open(path) as store:
            found = store.all_series()
            return (store.last_epoch(found[0]) or 0) if found else 0
    except ValueError:
        return 0


@pytest.mark.slow
def test_it_ends_with_the_report(session, tmp_path):
    process = session("--epochs", "30", "--series", "M1")
    told = process.said(200)
    assert process.returncode == 0, told
    assert "<svg" in (tmp_path / "phone-1-M1.html").read_text()


@pytest.mark.parametrize(
    ("device", "faults"),
    [("camera phone-1", {"camera": [{"kind": "timeout", "at": 1}]}),
     ("thermometer housing", {"thermometer": [{"kind": "timeout", "at": 1, "count": 100}]})],
)  # fmt: skip
def test_a_device_that_gives_nothing_is_told_before_it_begins(session, daemon, device, faults):
    process = session("--epochs", "5", exposure_s=0.01, **faults)
    told = process.said()
    assert process.returncode == 3
    assert f"error: {device}: " in told
    assert "no answer" in told
    with Store.open(daemon.store) as store:
        assert store.all_series() == []


def test_it_pauses_while_the_phone_is_away(session):
    gone = [{"kind": "unplugged", "at_s": 3.0, "for_s": 2.0}]
    process = session("--epochs", "16", "--no-report", "--no-check", camera=gone)
    told = process.said()
    assert process.returncode == 0, told
    assert "paused: " in told
    assert "the camera is back" in told


def test_wrong_usage_is_one_line(session):
    process = session("--camera", "nobody")
    told = process.said()
    assert process.returncode == 2
    assert "there are: phone-1" in told
    assert "Traceback" not in told
