"""Epochs that cannot be stored, on a full disk or for good: every interface reports it."""

from __future__ import annotations

import json
import re
import resource
import signal
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.commands import call
from tests.daemon.conftest import columns_of, make_recording
from tests.marks import mostly_slow
from tests.recordings import read_rows, write_rows
from tests.store.small import stored_numbers
from thermocald.acquisition.calibrator import Calibrator
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
    view = View(daemon.store, lambda: daemon.live)
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
    found = columns_of(config.store.path, "frame_time", "temperature_time")
    skew_s = (found["temperature_time"] - found["frame_time"]).round(3).tolist()
    assert skew_s[:9] + skew_s[16:] == [0.001] * 17


def test_a_recording_in_real_time_waits_for_a_slow_machine(tmp_path, monkeypatch):
    """Epochs whose calibration was deferred had neither a result nor image points, for good."""
    calibrate = Calibrator.calibrate
    monkeypatch.setattr(Calibrator, "calibrate", lambda *a: time.sleep(0.15) or calibrate(*a))
    config = recording_config(make_recording(tmp_path / "R", 12), tmp_path / "t.db")
    assert Service(config, until_finished=True).run()
    assert set(columns_of(config.store.path, "status")["status"].tolist()) == {"ok"}


@pytest.fixture
def run(tmp_path):
    """A recording of 20 epochs, and a call that plays it into a store: (recording, store, call)."""
    recording, store = make_recording(tmp_path / "small", 20), tmp_path / "t.db"
    words = ("run", "--recording", recording, "--fast", "--store", store)
    return recording, store, lambda *more: call(*words, *more, folder=tmp_path)


def test_a_recording_is_not_played_twice_into_a_store(run):
    """It was: 20 epochs became 40, and the standard deviations of a study 1.4 times too small."""
    recording, path, play = run
    Store.open(path, "append").close()  # an empty one is no hindrance
    stop = {"on_turn": lambda service: service.station.cameras[0].run.stored >= 4}
    config = recording_config(recording, path)
    # at most 12 of 20 epochs, also if a busy machine stops it late
    Service(config, fast=True, until_finished=True, epochs=12, **stop).run()
    assert play().returncode == 0
    again = play()
    assert again.returncode == 1
    assert "choose another --store to play it again" in again.stderr
    assert stored_numbers(path) == list(range(1, 21))
    found = columns_of(path, "frame_time", "status")
    assert (np.diff(found["frame_time"]) > 0).all()
    # those that waited when it was interrupted had no result for good: `frame_not_kept`
    assert set(found["status"].tolist()) == {"ok"}


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


def fill(folder: Path) -> Path:
    """Fill the disk of a folder to the last byte; return the file that does so."""
    with (folder / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 1 << 16, 1 << 12, 512, 1):
            try:
                while file.write(b"\0" * size) == size:
                    pass
            except OSError:
                continue
    return folder / "filler"


def told(daemon) -> str:
    """Return what the exit status of `status`, its text and the page agree on."""
    done = call("status", "--store", daemon.store)
    answer = done.returncode, View(daemon.store, lambda: daemon.live).healthy()
    waits = " waiting" in done.stdout + done.stderr
    words = {(0, (True, "")): "well", (1, (False, "the store cannot be written")): "out"}
    return words.get(answer, "") if waits == (done.returncode == 1) else ""


def test_it_is_said_and_waited_for_and_what_waits_at_the_end_is_counted(
    daemon, measured, small_disk
):
    disk = small_disk(40)
    daemon.store = disk / "thermocald.db"
    daemon.configure(**measured)
    filler = fill(disk)
    daemon.start()
    assert daemon.wait() in (1, 3)
    assert "error: " in daemon.log()
    filler.unlink()
    daemon.start()
    daemon.more(2)
    daemon.until(lambda: told(daemon) == "well")  # its status needs room, the first time
    fill(disk)
    daemon.until(lambda: told(daemon) == "out")
    waiting = daemon.status()["store"]["waiting"]
    # the status is current, not from before the disk was full
    daemon.until(lambda: daemon.status()["store"]["waiting"] > waiting + 2)
    had = len(daemon.results())
    filler.unlink()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[had:]))
    daemon.until(lambda: told(daemon) == "well")
    had = len(daemon.results())
    assert set(range(1, had + 1)) <= set(daemon.stored()[0])
    assert any(not r["stored"] for r in daemon.results())
    fill(disk)
    daemon.until(lambda: told(daemon) == "out")
    assert daemon.stop() == 1
    filler.unlink()
    (lost,) = map(int, re.findall(r"error: (\d+) epochs? lost", daemon.log()))
    assert daemon.log().count(" lost: epoch ") == 2  # in the log, and by the command at its end
    assert lost > 0
    assert len(daemon.stored()[0]) + lost >= daemon.results()[-1]["epoch"]
    assert {"store_out", "observations_paused"} <= set(daemon.events())


@pytest.mark.parametrize("room", mostly_slow([1, 4095, 8193, 30_000], 1))
def test_what_was_reported_kept_is_kept_where_a_little_room_is_left(daemon, measured, room):
    """A write fits in part, as at a quota; then the daemon is killed and started again."""
    daemon.run(**measured)
    daemon.more(2)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (16384 + room, 16384 + room))
    daemon.until(lambda: daemon.status().get("store", {}).get("waiting", 0) > 2)
    daemon.kill()
    kept = {r["epoch"] for r in daemon.results() if r["stored"]}
    assert kept <= set(daemon.stored()[0])
    had = len(daemon.results())
    daemon.start()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[had:]))
    assert daemon.stop() == 0
    assert kept <= set(daemon.stored()[0])
