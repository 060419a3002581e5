"""Faults that the real daemon, as a process, must survive."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commands import finish
from tests.daemon.conftest import columns_of, make_photographs
from tests.marks import mostly_slow
from tests.recordings import read_rows
from thermocald.acquisition.pipeline import AcquiredEpoch
from thermocald.acquisition.steady_clock import SteadyClock
from thermocald.acquisition.thermometers import Thermometers
from thermocald.config import load_config
from thermocald.daemon.live_state import LiveState
from thermocald.daemon.series_run import Runtime
from thermocald.daemon.service import Service
from thermocald.daemon.station import Station
from thermocald.daemon.store_guard import StoreGuard
from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.hal import Frame, Reading
from thermocald.store.database.store import Store


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("rounds", [3, pytest.param(60, marks=pytest.mark.slow)])
def test_what_was_told_as_stored_is_there_and_right_in_a_hostile_week(
    daemon, recording, replayed, preloaded, tmp_path, rounds
):
    """Every round ends with a kill; before, files of the store were deleted or the clock leapt."""
    daemon.forker = preloaded
    daemon.configure(**replayed(recording))
    rng, offset = np.random.default_rng(5), tmp_path / "offset"
    for number in range(rounds):
        offset.write_text("0".ljust(12))
        daemon.start(CLOCK_OFFSET_FILE=str(offset))
        daemon.more(int(rng.integers(1, 6)))
        if number % 3 == 1:
            files = sorted(p for p in daemon.folder.glob("thermocald.db*") if p.is_file())
            for path in files if number % 2 else [files[number % len(files)]]:
                path.unlink()
            daemon.more(2)  # the first one may have been written before
        elif number % 3 == 2:
            leap_s = rng.choice([120 * 86400, -3600, 7200, -86400])
            offset.write_text(str(leap_s).ljust(12))
        time.sleep(rng.uniform(0.0, 0.3))
        daemon.kill()
        daemon.stored()
        kept = columns_of(daemon.store, "frame_time", "c")
        for row in daemon.results():
            here = {name: column[row["epoch"] - 1] for name, column in kept.items()}
            assert row["stored"]
            assert here["frame_time"] == row["frame_time"]
            # a deferred calibration may have been added since
            assert row["c"] is None or here["c"] == row["c"]
    assert "Traceback" not in daemon.log()


def times(daemon, device: str) -> list[float]:
    """Return the times of a camera's epochs."""
    return [r["frame_time"] for r in daemon.results() if r["device"] == device]


def readings_of(daemon, name: str | None = None) -> list:
    try:
        with Store.open(daemon.store) as store:
            return list(store.readings(name))
    except StoreError:  # it is being created
        return []


def test_an_unplugged_camera_is_told_once_and_no_other_device_waits(daemon, devices):
    """Readings that belong to no epoch are stored and archived: of a thermometer of no camera,
    and of a camera's thermometer while it is away.
    """
    gone = [{"kind": "unplugged", "at_s": 1.0, "for_s": 1.5}]
    sections = devices(camera=gone, period_s=0.4)
    sections["cameras"].append({**sections["cameras"][0], "name": "two", "thermometers": [],
                                "faults": []})  # fmt: skip
    sections["thermometers"].append({**sections["thermometers"][0], "name": "air", "seed": 7})
    daemon.run(**sections)
    daemon.until(lambda: "camera one is back" in daemon.log())
    daemon.until(lambda: len(times(daemon, "two")) > 8)
    daemon.until(lambda: len(readings_of(daemon, "air")) > 5)
    assert daemon.stop() == 0
    assert [e for e in daemon.events() if e.startswith("device")] == ["device_out", "device_back"]
    one, two = times(daemon, "one"), times(daemon, "two")
    away = np.diff(one)
    assert 1.5 < away.max() < 4.5  # 1.5 s away, and a few ticks until the retry
    assert np.sort(away)[-2] < 1.5
    # the other camera continued meanwhile
    begin = one[int(away.argmax())]
    usual = 1.5 / np.mean(np.diff(two))  # epochs in 1.5 s
    assert sum(begin < t < begin + 1.5 for t in two) >= 0.3 * usual - 1
    housing, air = readings_of(daemon, "housing"), readings_of(daemon, "air")
    assert [r for r in housing if begin < r.utc < begin + away.max()]
    # a reading of an epoch is not stored twice, except at both ends
    paired = {r["temperature_time"] for r in daemon.results() if r["device"] == "one"}
    assert len(paired & {r.utc for r in housing}) <= 3
    finish("archive", "--config", "config.yaml", "--to", "out", folder=daemon.folder)
    archived = read_rows(daemon.folder / "out/thermometer-air.csv")
    told = [float(row["temperature"]) for row in archived]
    assert told == [r.values["temperature"] for r in air]


def received(channel: socket.socket) -> bytes:
    """Return what has been received on a channel that does not wait."""
    data = b""
    with suppress(BlockingIOError):
        while True:
            data += channel.recv(4096)
    return data


@pytest.mark.slow  # waits for the watchdog
def test_a_hung_capture_trips_the_watchdog_and_holds_nothing_else_up(daemon, devices, tmp_path):
    sections = devices(camera=[{"kind": "timeout", "at": 8}], timeout_s=3600.0)
    sections["cameras"].append({**sections["cameras"][0], "name": "two", "faults": []})
    daemon.configure(**sections)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(place := str(tmp_path / "notify.sock"))
        systemd.settimeout(60)
        daemon.start("--hang-after", "3", NOTIFY_SOCKET=place, WATCHDOG_USEC="2000000")
        for wanted in (b"READY=1", b"WATCHDOG=1"):
            while wanted not in systemd.recv(4096):
                pass
        # on a busy machine, opening and calculating may take long
        daemon.until(lambda: len(times(daemon, "one")) == 7)
        daemon.until(lambda: daemon.status()["stalled"] == ["camera one hangs"])
        systemd.setblocking(False)
        received(systemd)
        time.sleep(2.5)
        assert b"WATCHDOG=1" not in received(systemd)
    count = len(times(daemon, "two"))
    daemon.until(lambda: len(times(daemon, "two")) > count + 5)
    assert len(times(daemon, "one")) == 7
    begin = time.monotonic()
    assert daemon.stop() == 0  # the hung thread does not prevent the exit
    assert time.monotonic() - begin < 8.0  # it was waited for, 10 s
    assert "hung" in daemon.events()


def test_a_hang_up_while_it_starts_does_not_end_it(recording, tmp_path):
    """systemd does not restart a service that a SIGHUP ended; it came in the first second, too."""
    script = f"""
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name in ("typer", "thermocald.config", "thermocald.daemon.plan", "thermocald.parallel"):
            os.kill(os.getpid(), signal.SIGHUP)
sys.meta_path.insert(0, Finder())
sys.argv = "thermocald run --recording {recording} --fast --store t.db --epochs 3".split()
from thermocald.cli import main
main()
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    with Store.open(tmp_path / "t.db") as store:
        assert store.last_epoch(store.find_series()) == 3


@pytest.mark.parametrize("failing", mostly_slow(["write", "sync"], "write"))
def test_a_disk_that_fails_beneath_the_store_loses_nothing(
    daemon, measured, preloaded, tmp_path, failing
):
    """Input/output errors of writes, and of the flush that a commit depends on."""
    asked = tmp_path / "asked"
    daemon.forker = preloaded
    measured["thermometers"].append({"name": "air", "driver": "mock", "period_s": 0.1})
    daemon.configure(**measured)
    daemon.start(DISK_ERROR_OF=str(daemon.store), DISK_ERROR_FILE=str(asked))
    daemon.more(4)
    asked.write_text(failing)
    daemon.until(lambda: daemon.status().get("store", {}).get("waiting", 0) >= 5)
    begin, told = time.time(), daemon.results()[-1]["epoch"]
    daemon.more(5)
    end = time.time()
    asked.unlink()
    daemon.until(lambda: "can be written again" in daemon.log())
    daemon.until(lambda: daemon.results()[-1]["stored"])
    daemon.kill()  # the store has all epochs
    assert len(daemon.stored()[0]) >= told
    assert daemon.log().count("results wait in memory") == 1
    assert "Traceback" not in daemon.log()
    utcs = [reading.utc for reading in readings_of(daemon, "air")]
    assert utcs == sorted(utcs)
    assert any(begin < utc < end for utc in utcs)


def test_a_broken_configuration_at_reload_changes_nothing_a_good_one_does(
    daemon, measured, recording, tmp_path
):
    """A device that failed is opened again, also without a change."""
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "recording.yaml").write_text("[")
    air = {"name": "air", "driver": "replay", "recording": "./broken", "loop": True}
    measured["thermometers"].append(air)
    daemon.configure(**measured)
    good = daemon.config.read_text()
    daemon.start()
    daemon.more(2)

    def reload(text: str) -> None:
        daemon.config.write_text(text)
        daemon.signal(signal.SIGHUP)

    def air_is(state: str) -> bool:
        return daemon.status().get("thermometers", {}).get("air", {}).get("device", "") == state

    reload(good.replace("period_s", "perriod_s"))
    daemon.until(lambda: "cannot be reloaded" in daemon.log())
    assert "is 'period_s' meant?" in daemon.log()
    daemon.more(2)
    for text, device in ((good.replace("name: rpi", "name: other"), "other"), (good, "rpi")):
        reload(text)
        daemon.until(lambda device=device: daemon.results()[-1]["device"] == device)
    daemon.until(lambda: air_is("failed"))
    shutil.copytree(recording, broken, dirs_exist_ok=True)
    reload(good)
    daemon.until(lambda: air_is("open"))
    assert daemon.stop() == 0
    with Store.open(daemon.store) as store:
        assert store.examine().damaged == ()
        for series in store.all_series():
            numbers = store.series_columns(series, ["epoch"])["epoch"].tolist()
            assert numbers == list(range(1, len(numbers) + 1))
        (failed,) = (event.text for event in store.events() if event.kind == "reload_failed")
    assert failed.startswith("the configuration cannot be reloaded, the old one stays in force: ")


@pytest.mark.parametrize("fails", [[2, 4], [2, 4, 5]])
def test_a_reload_that_fails_after_the_old_devices_were_stopped_starts_them_again(
    daemon, measured, monkeypatch, fails
):
    """It ended the daemon, or went on without any device and looked healthy. If they cannot be
    started again, it ends."""
    built = []

    def build(*arguments):
        built.append(True)
        if len(built) in fails:  # the 2nd and 3rd are only trials
            raise PermissionError(13, "Permission denied", "testfield.csv")
        return Station(*arguments)

    def reload(service) -> bool:
        daemon.configure(**measured, logging={"level": "error"})
        service._reload = len(built) < 4
        return len(built) > 4 and service.station.cameras[0].run.taken > 2

    monkeypatch.setattr("thermocald.daemon.service.Station", build)
    daemon.configure(**measured)
    service = Service(load_config(daemon.config), daemon.config, on_turn=reload)
    if len(fails) > 2:
        with pytest.raises(PermissionError):
            service.run()
        return
    assert service.run()
    assert service.config.logging.level == "info"
    with Store.open(daemon.store) as store:
        assert [e.kind for e in store.events()].count("reload_failed") == len(fails)


@pytest.fixture
def line(daemon, measured):
    """The camera of a station that is not started."""
    daemon.configure(**measured)
    with closing(StoreGuard(daemon.store)) as guard:
        runtime = Runtime(guard, SteadyClock(), LiveState(daemon.live))
        yield Station(load_config(daemon.config), runtime).cameras[0]


def test_an_epoch_that_cannot_be_calibrated_later_is_not_waited_for(line):
    """Until the daemon's end, its status said that epochs were still to be calibrated."""
    line.run.pipeline.dropped += 1
    frame, epoch = Frame(None, 0.0, 1.7e9, observations={}), Epoch(1, 1.7e9, 1.7e9, {})
    line.run.keep(AcquiredEpoch(1, frame, True, epoch))
    assert line.run.last["status"] == "frame_not_kept"
    assert line.status()["deferred"] == 0
    photograph = Frame(None, 0.0, 1.7e9, encoded=b"\xff\xd8")
    line.run.keep(AcquiredEpoch(2, photograph, True, replace(epoch, number=2)))
    line.run.frames.root = Path("f" * 300)  # a folder that could not be entered ended the thread
    assert line.run.backlog(3) is None


def test_a_frame_stamped_before_the_new_time_was_followed_is_not_trusted(line, monkeypatch):
    """After a suspend of 8 h, the epochs of the next minute then remained 8 h too early."""
    frame, followed, seen = Frame(None, 0.0, 1.7e9, observations={}), [], []
    monkeypatch.setattr(line.plan.camera, "capture", lambda: followed.append(True) or frame)
    monkeypatch.setattr(line.runtime.clock, "trusted", lambda: bool(followed))
    monkeypatch.setattr(line.run.pipeline, "submit", lambda _, trust: seen.append(trust))
    line._capture()
    assert seen == [False]
    station, reading = line.station, Reading({"temperature": 20.0}, 0.0, 1.7e9)
    followed.clear()  # likewise a reading without an epoch
    monkeypatch.setattr(station.thermometers, "read", lambda _: followed.append(True) or reading)
    monkeypatch.setattr(line.runtime.guard, "reading", lambda one: seen.append(one.clock_trusted))
    station._read("recorded")
    assert seen == [False, False]


def test_a_thermometer_that_is_being_read_does_not_delay_the_end(daemon, devices, monkeypatch):
    """A serial one with its usual time-out of 10 s did, by 10 s."""
    daemon.configure(**devices())
    ended, answered = [], threading.Event()
    monkeypatch.setattr(Thermometers, "read", lambda *_: answered.wait(60.0))

    def end(service) -> bool:
        if service.station.cameras[0].run.stored:
            ended.append(time.monotonic())
        return bool(ended)

    Service(load_config(daemon.config), on_turn=end).run()
    took_s = time.monotonic() - ended[0]
    answered.set()
    assert took_s < 8.0


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_garbage_frames_are_epochs_with_a_reason_and_kept_as_events(
    daemon, recording, replayed, tmp_path, count
):
    rng = np.random.default_rng(1)
    heads = [b"\xff\xd8\xff\xe0", b"\xff\xd8" + b"\xff\xd9", b"\xff\xd8\xff\xdb\x00\x43\xff\xd9"]
    garbage = make_photographs(tmp_path / "garbage", recording, [
        heads[k % 3] + rng.bytes(int(rng.integers(0, 3000))) + b"\xff\xd9" * (k % 2)
        for k in range(1, count + 1)
    ])  # fmt: skip
    daemon.run("--epochs", str(count), **replayed(garbage, loop=False), keep="events")
    assert daemon.wait(300) == 0
    numbers, statuses = daemon.stored()
    assert numbers == list(range(1, count + 1))
    assert "ok" not in statuses
    kept = sorted(int(p.stem) for p in daemon.frames.rglob("*.jpg"))
    assert kept == numbers
    assert "Traceback" not in daemon.log()
    assert daemon.log().count("its last 20 epochs have no result; ") == 1
    assert daemon.events().count("no_result") == 1
