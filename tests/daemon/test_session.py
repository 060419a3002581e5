"""A single command leads from a camera to epochs, a recording and a report."""

from __future__ import annotations

import time

import pytest
import yaml

from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording


@pytest.fixture
def session(tmp_path, devices, spawn):
    """options → a running `thermocald session start` in a folder with a configuration."""

    def start(*options: str, **configured):
        sections = {**devices(period_s=0.3, name="phone-1", **configured), "outputs": []}
        document = {"store": {"path": "t.db"}, "frames": {"keep": "none"}, **sections}
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
        return spawn(tmp_path, "session", "start", *options)

    return start


def test_it_is_checked_taken_interrupted_resumed_and_archived(session, tmp_path):
    command = ["--camera", "phone-1", "--series", "M7", "--start", "cold", "--epochs", "5",
               "--no-report"]  # fmt: skip
    first = session(*command)
    deadline = time.monotonic() + 90
    path = tmp_path / "t.db"
    while _epochs(path) < 2:
        assert time.monotonic() < deadline
        assert first.poll() is None, first.said()
        time.sleep(0.1)
    first.kill()
    first.wait()
    had = _epochs(path)
    second = session(*command)
    told = second.said()
    assert second.returncode == 0, told
    assert f"has {had} epochs; {5 - had} are still to be taken" in told
    assert "48 targets" in told
    recording = read_recording(tmp_path / "phone-1-M7")
    assert [epoch.number for epoch in recording.epochs] == list(range(1, 6))
    with Store.open(path) as store:
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


def test_a_camera_that_sees_nothing_is_told_before_it_begins(session, tmp_path):
    process = session("--epochs", "5", exposure_s=0.01, camera=[{"kind": "timeout", "at": 1}])
    told = process.said()
    assert process.returncode == 3
    assert "no answer" in told
    assert not (tmp_path / "t.db").exists()


def test_wrong_usage_is_one_line(session):
    process = session("--camera", "nobody")
    told = process.said()
    assert process.returncode == 2
    assert "there are: phone-1" in told
    assert "Traceback" not in told
