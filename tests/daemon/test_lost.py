"""An epoch that was taken but not stored is lost, and every interface reports it."""

from __future__ import annotations

import json
import signal
import sqlite3

import numpy as np
import pytest
import yaml

from tests.commands import call
from tests.daemon.conftest import make_recording
from tests.recordings import read_rows, write_rows
from tests.store.small import stored_numbers
from thermocald.daemon.plan import recording_config
from thermocald.daemon.service import Service
from thermocald.output.dashboard.view import View
from thermocald.store.database.store import Store


def refuse(path, condition: str) -> None:
    """Create a store whose file takes no row of an epoch."""
    Store.open(path, "append").close()
    with sqlite3.connect(path) as file:
        file.execute(f"CREATE TRIGGER refused BEFORE INSERT ON epoch WHEN {condition} "
                     "BEGIN SELECT RAISE(ABORT, 'no'); END")  # fmt: skip
    file.close()


def test_an_epoch_that_the_file_refuses_is_lost_for_everybody(daemon, measured):
    refuse(daemon.store, "NEW.number = 2")
    daemon.run(**measured)
    daemon.more(4)
    daemon.until(lambda: daemon.status().get("store", {}).get("lost") == 1)
    view = View(daemon.store, daemon.live)
    well, why = view.healthy()
    assert not well
    assert "an epoch was lost: epoch 2 of rpi" in why
    done = call("status", "--store", daemon.store)
    assert done.returncode == 1
    assert "! 1 epoch lost" in done.stdout
    assert "1 epoch lost" in done.stderr
    assert [row["lost"] for row in daemon.results()[:3]] == [0, 1, 1]
    # an hour later the page is healthy again; the count stays
    daemon.signal(signal.SIGSTOP)
    later = daemon.status()
    later["store"]["lost_s_ago"] = 3601.0
    (daemon.live / "status.json").write_text(json.dumps(later))
    assert view.healthy() == (True, "")
    daemon.signal(signal.SIGCONT)
    assert daemon.stop() == 1
    assert "1 epoch lost: epoch 2 of rpi" in daemon.log().splitlines()[-1]
    assert daemon.events().count("epoch_lost") == 1


def edit(path, change) -> None:
    """Change the rows of a table of a recording."""
    rows = read_rows(path)
    change(rows)
    write_rows(path, rows)


@pytest.mark.parametrize("fast", [True, False])
def test_what_a_recording_lacks_does_not_shift_the_rest(tmp_path, fast):
    """Regression: six missing readings left all later epochs without temperature."""
    source = make_recording(tmp_path / "R", 24, interval=0.05)
    edit(source / "epochs.csv", lambda rows: [row.update(temperature="") for row in rows[9:15]])
    config = recording_config(source, tmp_path / "t.db")
    assert Service(config, fast=fast, until_finished=True).run()
    with Store.open(config.store.path) as store:
        series = store.find_series()
        found = store.series_columns(series, ["frame_time", "temperature_time"])
    skew_s = (found["temperature_time"] - found["frame_time"]).round(3).tolist()
    assert skew_s[:9] + skew_s[16:] == [0.001] * 17


@pytest.fixture
def run(tmp_path):
    """A recording of 20 epochs, and a call that plays it into a store: (recording, store, call)."""
    recording, store = make_recording(tmp_path / "small", 20), tmp_path / "t.db"
    words = ("run", "--recording", recording, "--fast", "--store", store)
    return recording, store, lambda *more: call(*words, *more, folder=tmp_path)


def test_a_recording_is_not_played_twice_into_a_store(run):
    """It was: 20 epochs became 40, and the standard deviations of a study 1.4 times too small."""
    _, path, play = run
    assert play("--epochs", "8").returncode == 0  # interrupted
    assert play().returncode == 0
    again = play()
    assert again.returncode == 1
    assert "choose another --store to play it again" in again.stderr
    assert stored_numbers(path) == list(range(1, 21))
    with Store.open(path) as store:
        times = store.series_columns(store.find_series(), ["frame_time"])["frame_time"]
    assert (np.diff(times) > 0).all()


def test_a_recording_whose_channels_no_epoch_can_have_is_refused_before_it_is_played(run):
    """Its epochs would have been kept without any temperature."""
    recording, store, play = run
    document = yaml.safe_load((recording / "recording.yaml").read_text())
    document["temperatures"] = {"board": {"unit": "degC"}, **document["temperatures"]}
    (recording / "recording.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    edit(recording / "epochs.csv", lambda rows: [row.update(board="20.0") for row in rows])
    done = play()
    assert (done.returncode, store.exists()) == (1, False)
    assert "small: cannot be played" in done.stderr
    assert "put this channel first, or rename it" in done.stderr


@pytest.mark.parametrize(("table", "column"), [("epochs", "temperature"), ("observations", "y")])
def test_a_recording_that_breaks_ends_the_command(run, table, column):
    """It is not opened again forever; the epochs before the broken row are stored."""
    recording, store, play = run
    path = recording / f"{table}.csv"
    edit(path, lambda rows: rows[-2].update({column: "x3"}))
    done = play()
    assert done.returncode == 1
    assert f"{table}.csv, line {len(path.read_text().splitlines()) - 1}" in done.stderr
    assert store.exists() == (table == "observations")
