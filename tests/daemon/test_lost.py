"""An epoch that was taken but not stored is lost, and every interface reports it."""

from __future__ import annotations

import json
import sqlite3
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.acquisition.test_pipeline import until
from tests.commands import call
from tests.daemon.conftest import make_recording
from tests.daemon.test_store_file import guard, path  # noqa: F401
from tests.store.small import stored_numbers
from thermocald.acquisition.pipeline import Pipeline
from thermocald.acquisition.thermometers import Thermometers
from thermocald.cli.run import status
from thermocald.daemon.live_state import LiveState, status_warnings
from thermocald.daemon.plan import recording_config
from thermocald.daemon.service import Service
from thermocald.errors import DataError, StoreError
from thermocald.hal import Frame, SystemClock
from thermocald.output.dashboard.view import View
from thermocald.store.database.store import Store


@pytest.mark.parametrize("fast", [True, False])
def test_what_a_recording_lacks_does_not_shift_the_rest(tmp_path, fast):
    """Regression: six missing readings left all later epochs without temperature."""
    source = make_recording(tmp_path / "R", 24, interval=0.05)
    rows = [line.split(",") for line in (source / "epochs.csv").read_text().splitlines()]
    column = rows[0].index("temperature")
    for row in rows[10:16]:
        row[column] = ""
    (source / "epochs.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    config = recording_config(source, tmp_path / "t.db")
    assert Service(config, fast=fast, until_finished=True).run()
    with Store.open(config.store.path) as store:
        series = store.find_series()
        found = store.series_columns(series, ["frame_time", "temperature_time"])
    skew_s = (found["temperature_time"] - found["frame_time"]).round(3).tolist()
    assert skew_s[:9] + skew_s[16:] == [0.001] * 17


def refuse(path, statement: str) -> None:  # noqa: F811
    with sqlite3.connect(path) as db:
        db.execute(f"CREATE TRIGGER refused {statement} BEGIN SELECT RAISE(ABORT, 'no'); END")
    db.close()


REFUSALS = {
    "its number": None,
    "the row": "BEFORE INSERT ON epoch WHEN NEW.number = 4",
    "its observations": "BEFORE INSERT ON detail",
    "a word": "BEFORE INSERT ON status_code WHEN NEW.status = 'ok'",
    "its time": "BEFORE INSERT ON epoch WHEN NEW.frame_time > 1e9 + 3.5",
}


@pytest.mark.parametrize("refusal", REFUSALS)
def test_a_refused_row_is_lost_for_everybody(guard, path, tmp_path, refusal, monkeypatch, capsys):  # noqa: F811
    if REFUSALS[refusal] is None:
        guard.keep(2, time_s=2e9)
    else:
        refuse(path, REFUSALS[refusal])
        guard.keep(4)
    assert guard.lost == 1
    document = {"store": guard.status(), "pid": 1, "stalled": []}
    live = LiveState(tmp_path / "live")
    live.write_status(document)
    well, why = View(path, live.folder).healthy()
    assert not well
    assert "an epoch was lost" in why
    document |= {
        "cameras": {}, "outputs": {}, "clock": {"trusted": True},
        "thermometers": {"air": {"device": "open", "faults": 0, "why": "", "warnings": ["slow"]}},
        "frames": {"paused": ""}, "sessions": {}, "age_s": 0.0, "utc": 1.0, "started": 0.0,
        "version": "0",
    }  # fmt: skip
    document["warnings"] = status_warnings(document)
    assert any("1 epoch lost" in text for text in status_warnings(document))
    assert "thermometer air: slow" in status_warnings(document)
    monkeypatch.setattr("thermocald.cli.run.read_status", lambda *_: document)
    with pytest.raises(DataError, match="1 epoch lost"):
        status()
    assert "1 epoch lost" in capsys.readouterr().out
    (event,) = [e for e in guard.store.events() if e.kind == "epoch_lost"]
    assert "epoch" in event.text
    # an hour later the page is healthy again; the count stays
    status_file = live.folder / "status.json"
    later = json.loads(status_file.read_text())
    later["store"]["lost_s_ago"] = 3601.0
    status_file.write_text(json.dumps(later))
    assert View(path, live.folder).healthy() == (True, "")


def test_the_exit_status_of_run_says_so(tmp_path):
    """A run at the command line, in which the file refuses one of twenty epochs."""
    recording = make_recording(tmp_path / "small", 20)
    run = ["run", "--recording", recording, "--fast", "--store", tmp_path / "t.db"]
    with Store.open(tmp_path / "t.db", "append"):
        pass
    refuse(tmp_path / "t.db", "BEFORE INSERT ON epoch WHEN NEW.number = 7")
    done = call(*run, folder=tmp_path)
    assert done.returncode == 1
    assert "1 epoch lost: epoch 7 of rpi" in done.stderr
    assert stored_numbers(tmp_path / "t.db") == [n for n in range(1, 21) if n != 7]


def test_a_recording_is_not_played_twice_into_a_store(tmp_path):
    """It was: 20 epochs became 40, and the standard deviations of a study 1.4 times too small."""
    recording = make_recording(tmp_path / "small", 20)
    run = ["run", "--recording", recording, "--fast", "--store", tmp_path / "t.db"]
    assert call(*run, "--epochs", "8", folder=tmp_path).returncode == 0  # interrupted
    assert call(*run, folder=tmp_path).returncode == 0
    assert stored_numbers(tmp_path / "t.db") == list(range(1, 21))
    with Store.open(tmp_path / "t.db") as store:
        times = store.series_columns(store.find_series(), ["frame_time"])["frame_time"]
    assert (np.diff(times) > 0).all()
    again = call(*run, folder=tmp_path)
    assert again.returncode == 1
    assert "choose another --store to play it again" in again.stderr
    assert stored_numbers(tmp_path / "t.db") == list(range(1, 21))


def test_what_waits_at_the_end_for_a_store_that_is_away_is_lost(guard, path):  # noqa: F811
    def away():
        raise StoreError("the disk is away")

    guard._file.watch = away
    refuse(path, "BEFORE INSERT ON epoch")
    guard.keep(4)
    assert (guard.waiting, guard.lost) == (1, 0)
    guard.close()
    assert guard.lost == 1
    assert guard.status()["lost_why"].startswith("epoch 4: ")


@pytest.mark.parametrize("how", ["the keeper breaks", "too many wait", "the end"])
def test_an_epoch_that_is_not_handed_over_is_lost(how):
    gate, told = threading.Event(), []

    def keep(acquired):
        if how == "the keeper breaks":
            raise RuntimeError("a mistake of ours")
        gate.wait(20.0)

    keeper = SimpleNamespace(keep=keep, backlog=lambda below: None, lose=told.append)
    none = Thermometers(SimpleNamespace(cameras=(), thermometers=()), SystemClock())
    pipeline = Pipeline("cam", None, none, (), keeper, SystemClock())
    pipeline.start()
    count = 2 if how == "the keeper breaks" else 10 if how.startswith("too") else 3
    for _ in range(count):
        pipeline.submit(Frame(np.zeros((5000, 5000), np.uint8), 0.0, 0.0))
    if how == "the keeper breaks":
        until(lambda: len(told) == count)
    elif how == "the end":
        pipeline.stop(0.2)
    gate.set()
    assert pipeline.stop(20.0) or how == "the end"
    assert pipeline.lost == len(told) > 0
    assert all(text.startswith("camera cam: ") for text in told)


def test_a_recording_whose_channels_no_epoch_can_have_is_refused_before_it_is_played(tmp_path):
    """Its epochs would have been kept without any temperature."""
    recording, store = make_recording(tmp_path / "small", 20), tmp_path / "t.db"
    head, epochs = recording / "recording.yaml", recording / "epochs.csv"
    document = yaml.safe_load(head.read_text())
    document["temperatures"] = {"board": {"unit": "degC"}, **document["temperatures"]}
    head.write_text(yaml.safe_dump(document, sort_keys=False))
    names, *rows = [line.split(",") for line in epochs.read_text().splitlines()]
    table = [[*names[:3], "board", *names[3:]], *([*r[:3], "20.0", *r[3:]] for r in rows)]
    epochs.write_text("\n".join(map(",".join, table)) + "\n")
    done = call("run", "--recording", recording, "--fast", "--store", store)
    assert (done.returncode, store.exists()) == (1, False)
    assert "small: cannot be played" in done.stderr
    assert "put this channel first, or rename it" in done.stderr


@pytest.mark.parametrize("table", ["epochs.csv", "observations.csv"])
def test_a_recording_that_breaks_ends_the_command(tmp_path, table):
    """It is not opened again forever; the epochs before the broken row are stored."""
    recording, store = make_recording(tmp_path / "small", 20), tmp_path / "t.db"
    lines = (recording / table).read_text().splitlines()
    number = len(lines) - 1
    lines[number - 1] = lines[number - 1].replace(lines[number - 1].split(",")[3], "x3", 1)
    (recording / table).write_text("\n".join(lines) + "\n")
    done = call("run", "--recording", recording, "--fast", "--store", store)
    assert done.returncode == 1
    assert f"{table}, line {number}" in done.stderr
    assert "Traceback" not in done.stderr
    assert store.exists() == (table == "observations.csv")
