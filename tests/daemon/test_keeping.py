"""Readings without a camera, the archive, retention by the timer."""

from __future__ import annotations

import csv
import os
import shlex
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.commands import call
from tests.daemon.conftest import make_photographs
from thermocald.errors import StoreError
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import read_recording

UNITS = Path(__file__).resolve().parents[2] / "systemd"
# a synchronised clock, without which no frame is deleted for its age
SYNCHRONISED = {"CLOCK_SYNCHRONISED": "1"}


def readings_of(daemon, name=None) -> list:
    try:
        with Store.open(daemon.store) as store:
            return list(store.readings(name))
    except StoreError:  # it is being created
        return []


def test_a_thermometer_alone_is_stored_and_archived(daemon, devices):
    sections = devices()
    daemon.run(thermometers=[{**sections["thermometers"][0], "name": "air"}])
    daemon.until(lambda: len(readings_of(daemon)) > 5)
    assert daemon.stop() == 0
    kept = readings_of(daemon)
    assert {r.thermometer for r in kept} == {"air"}
    assert all(20 < r.values["temperature"] < 30 for r in kept)
    gaps = [b.utc - a.utc for a, b in pairwise(kept)]
    assert min(gaps) > 0.1
    done = call("archive", "--config", "config.yaml", "--to", "out", folder=daemon.folder)
    assert done.returncode == 0, done.stderr
    with (daemon.folder / "out/thermometer-air.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["temperature"]) for row in rows] == [r.values["temperature"] for r in kept]


def test_a_thermometer_of_no_camera_is_stored_and_a_paired_one_while_the_camera_is_away(
    daemon, devices
):
    sections = devices(camera=[{"kind": "unplugged", "at_s": 0.5, "for_s": 1.0}])
    sections["thermometers"].append({**sections["thermometers"][0], "name": "air", "seed": 7})
    daemon.run(**sections)
    daemon.until(lambda: "camera one is back" in daemon.log())
    daemon.until(lambda: daemon.results() and daemon.results()[-1]["epoch"] > 3)
    daemon.until(lambda: len(readings_of(daemon, "air")) > 5)
    assert daemon.stop() == 0
    housing = readings_of(daemon, "housing")
    with Store.open(daemon.store) as store:
        (out, back) = [e.utc for e in store.events() if e.kind in ("device_out", "device_back")]
        epochs = store.series_columns(store.find_series(), ["temperature_time"])
    away = [r for r in housing if out < r.utc < back]
    assert away  # five, if the machine has time for every tick
    # a reading of an epoch is not stored twice, except at both ends
    assert len(set(epochs["temperature_time"]) & {r.utc for r in housing}) <= 3


@pytest.mark.slow
def test_readings_wait_for_a_store_that_cannot_be_written(daemon, devices):
    import resource

    daemon.run(thermometers=devices()["thermometers"])
    daemon.until(lambda: len(readings_of(daemon)) > 2)
    before = resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (8192, before[1]))
    daemon.until(lambda: "results wait in memory" in daemon.log())
    begin = time.time()
    time.sleep(4.0)
    end = time.time()
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, before)
    daemon.until(lambda: "can be written again" in daemon.log())
    assert daemon.stop() == 0
    times = [r.utc for r in readings_of(daemon)]
    assert times == sorted(times)
    # the readings while nothing could be written: 20 ticks, fewer on a busy machine
    assert sum(begin < t < end for t in times) >= 10


@pytest.fixture
def timer_command(daemon, preloaded):
    """The command line of the timer's unit, its paths moved below a folder of the test."""
    lines = (UNITS / "thermocald-archive.service").read_text().splitlines()
    (line,) = [one for one in lines if one.startswith("ExecStart=")]
    words = shlex.split(line.removeprefix("ExecStart="))
    assert words[0] == "/opt/thermocald/bin/thermocald"
    moved = {"/etc/thermocald/": "", "/var/lib/thermocald/": ""}
    for old, new in moved.items():
        words = [word.replace(old, new) for word in words]

    daemon.forker = preloaded

    def run() -> tuple[int, str]:
        done = preloaded.start(daemon.folder, *words[1:], log="timer.txt", **SYNCHRONISED)
        said = done.said()
        (daemon.folder / "timer.txt").unlink()
        return done.returncode, said

    return run


@pytest.mark.slow
def test_the_timers_command_archives_what_has_ended_and_deletes_old_frames(
    daemon, devices, timer_command
):
    assert timer_command()[0] == 2  # no configuration: one line, no traceback
    limits = {"keep": "all", "folder": str(daemon.folder / "frames"), "max_age_days": 1,
              "min_free_gb": 0.01}  # fmt: skip
    daemon.configure(**devices(), frames=limits)
    assert "nothing was stored yet" in timer_command()[1]
    for series in ("M1", "M2"):
        sections = devices(series=series)
        daemon.configure(**sections, frames=limits)
        daemon.start(**SYNCHRONISED)
        daemon.more(4)
        if series == "M1":
            assert daemon.stop() == 0
    # while the daemon runs, it deletes an old frame and logs it
    old = sorted((daemon.folder / "frames").rglob("*.png"))[0]
    yesterday = time.time() - 2 * 86400
    os.utime(old, (yesterday, yesterday))
    status, said = timer_command()
    assert status == 0, said
    assert "frames deleted: 1 " in said
    assert not old.exists()
    assert (daemon.folder / "recordings/one-M1").is_dir()
    assert not (daemon.folder / "recordings/one-M2").exists()
    assert len(read_recording(daemon.folder / "recordings/one-M1").epochs) >= 4
    assert daemon.stop() == 0
    # without a daemon, the command deletes and logs it; a second run archives nothing
    old = sorted((daemon.folder / "frames").rglob("*.png"))[0]
    os.utime(old, (yesterday, yesterday))
    status, said = timer_command()
    assert status == 0, said
    assert "one-M1" not in said
    assert not old.exists()
    assert daemon.events().count("frames_deleted") == 2


def test_the_frame_of_an_event_is_kept(daemon, recording, replayed):
    """Empty images: every epoch is an event."""
    grey = cv2.imencode(".jpg", np.full((64, 64), 128, np.uint8))[1].tobytes()
    folder = make_photographs(daemon.folder / "grey", recording, [grey] * 3)
    kept = {"folder": str(daemon.folder / "kept"), "min_free_gb": 0.0, "keep": "events"}
    daemon.run("--epochs", "3", **replayed(folder, loop=False), frames=kept)
    assert daemon.wait() == 0
    names = sorted(p.name for p in (daemon.folder / "kept").rglob("*.jpg"))
    assert names == [f"{k:07d}.jpg" for k in (1, 2, 3)]
