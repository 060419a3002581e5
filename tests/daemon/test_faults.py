"""Faults that the real daemon, as a process, must survive."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np
import pytest

from tests.daemon.conftest import make_photographs
from tests.marks import mostly_slow
from thermocald.config import load_config
from thermocald.daemon.service import Service
from thermocald.daemon.station import Station
from thermocald.errors import StoreError
from thermocald.store.database.store import Store


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kills", [3, pytest.param(80, marks=pytest.mark.slow)])
def test_killed_and_restarted_nothing_committed_is_lost(daemon, recording, replayed, kills):
    """40 more kills in test_chaos, and 300 of the store's writer in store/test_kills."""
    daemon.configure(**replayed(recording))
    rng = np.random.default_rng(5)
    for _ in range(kills):
        daemon.start()
        daemon.more(int(rng.integers(1, 6)))
        time.sleep(rng.uniform(0.0, 0.1))  # two periods
        daemon.kill()
        told = [result["epoch"] for result in daemon.results()]
        numbers, _ = daemon.stored()
        assert set(told) <= set(numbers)
    assert len(numbers) > 3 * kills


def test_unplugged_and_back_told_once_each_and_no_other_device_waits(daemon, devices):
    gone = [{"kind": "unplugged", "at_s": 1.0, "for_s": 1.5}]
    sections = devices(camera=gone, period_s=0.4)
    second = {**sections["cameras"][0], "name": "two", "faults": []}
    sections["cameras"].append(second)
    daemon.run(**sections)
    daemon.until(lambda: "camera one is back" in daemon.log())
    daemon.until(lambda: sum(r["device"] == "two" for r in daemon.results()) > 8)
    assert daemon.stop() == 0
    assert daemon.log().count("camera one is out") == 1
    assert daemon.log().count("camera one is back") == 1
    assert [e for e in daemon.events() if e.startswith("device")] == ["device_out", "device_back"]
    times = {name: [r["frame_time"] for r in daemon.results() if r["device"] == name]
             for name in ("one", "two")}  # fmt: skip
    away = np.diff(times["one"])
    assert 1.5 < away.max() < 4.5  # 1.5 s away, and a few ticks until the retry
    assert np.sort(away)[-2] < 1.5
    # the other camera continued meanwhile
    begin = times["one"][int(away.argmax())]
    usual = 1.5 / np.mean(np.diff(times["two"]))  # epochs in 1.5 s
    assert sum(begin < t < begin + 1.5 for t in times["two"]) >= 0.3 * usual - 1


@pytest.fixture
def heard(tmp_path):
    """s → the messages to the notification socket, in place of systemd's, in this time."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(str(tmp_path / "notify.sock"))
        channel.settimeout(0.1)

        def listen(seconds: float) -> list[str]:
            messages: list[str] = []
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                with suppress(TimeoutError):
                    messages += channel.recv(4096).decode().split("\n")
            return messages

        yield listen


@pytest.mark.slow  # waits for the watchdog
def test_a_hung_capture_trips_the_watchdog_and_holds_nothing_else_up(
    daemon, devices, heard, tmp_path
):
    hangs = [{"kind": "timeout", "at": 8}]
    sections = devices(camera=hangs, timeout_s=3600.0)
    sections["cameras"].append({**sections["cameras"][0], "name": "two", "faults": []})
    daemon.configure(**sections)
    place = str(tmp_path / "notify.sock")
    daemon.start("--hang-after", "3", NOTIFY_SOCKET=place, WATCHDOG_USEC="2000000")
    daemon.until(lambda: "READY=1" in heard(0.1))
    assert "WATCHDOG=1" in heard(1.2)
    # on a busy machine, opening and calculating may take long
    daemon.until(lambda: sum(r["device"] == "one" for r in daemon.results()) == 7)
    daemon.until(lambda: daemon.status()["stalled"] == ["camera one hangs"])
    heard(0.5)
    assert "WATCHDOG=1" not in heard(2.5)
    count = len([r for r in daemon.results() if r["device"] == "two"])
    daemon.until(lambda: len([r for r in daemon.results() if r["device"] == "two"]) > count + 5)
    assert len([r for r in daemon.results() if r["device"] == "one"]) == 7
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
    daemon.configure(**measured)
    daemon.start(DISK_ERROR_OF=str(daemon.store), DISK_ERROR_FILE=str(asked))
    daemon.more(4)
    asked.write_text(failing)
    daemon.until(lambda: "results wait in memory" in daemon.log())
    daemon.until(lambda: daemon.status().get("store", {}).get("waiting", 0) >= 5)
    told = daemon.results()[-1]["epoch"]
    asked.unlink()
    daemon.until(lambda: "can be written again" in daemon.log())
    daemon.until(lambda: daemon.results()[-1]["stored"])
    daemon.kill()  # the store has all epochs
    numbers, _ = daemon.stored()
    assert len(numbers) >= told
    assert daemon.log().count("results wait in memory") == 1
    assert "Traceback" not in daemon.log()


def test_on_a_read_only_file_system_it_says_so_and_leaves_the_rest_to_the_restart(
    daemon, measured, small_disk
):
    disk = small_disk(8)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    daemon.store = disk / "thermocald.db"
    daemon.run(**measured)
    assert daemon.wait() == 1
    assert "error:" in daemon.log()
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    daemon.start()
    daemon.more(3)
    assert daemon.stop() == 0


def test_a_broken_configuration_at_reload_changes_nothing_a_good_one_does(daemon, measured):
    daemon.configure(**measured)
    good = daemon.config.read_text()
    daemon.start()
    daemon.more(2)
    daemon.config.write_text(good.replace("period_s", "perriod_s"))
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: "cannot be reloaded" in daemon.log())
    assert "is 'period_s' meant?" in daemon.log()
    daemon.more(2)
    daemon.config.write_text(good.replace("name: rpi", "name: other"))
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: daemon.results()[-1]["device"] == "other")
    daemon.config.write_text(good)
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: daemon.results()[-1]["device"] == "rpi")
    assert daemon.stop() == 0
    with Store.open(daemon.store) as store:
        assert store.examine().damaged == ()
        for series in store.all_series():
            numbers = store.series_columns(series, ["epoch"])["epoch"].tolist()
            assert numbers == list(range(1, len(numbers) + 1))
        (failed,) = (event.text for event in store.events() if event.kind == "reload_failed")
    assert failed.startswith("the configuration cannot be reloaded, the old one stays in force: ")


def test_a_reload_that_fails_after_the_old_devices_were_stopped_ends_it(
    daemon, measured, monkeypatch
):
    """It went on without any device, and looked healthy."""
    daemon.configure(**measured)
    service = Service(load_config(daemon.config), daemon.config, on_turn=lambda _: reload())
    turns, built = [], []

    def reload():
        turns.append(True)
        if len(turns) == 1:
            daemon.configure(**measured, logging={"level": "error"})
            service._reload = True
        return len(turns) > 20

    def build(*arguments):
        built.append(True)
        if len(built) == 3:  # after the first and the one that is only a trial
            raise StoreError("its disk is gone")
        return Station(*arguments)

    monkeypatch.setattr("thermocald.daemon.service.Station", build)
    with pytest.raises(StoreError, match="disk is gone"):
        service.run()


def test_a_reload_opens_a_failed_device_also_without_a_change(daemon, devices, recording, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "recording.yaml").write_text("[")
    sections = devices()
    air = {"name": "air", "driver": "replay", "recording": "./broken", "loop": True}
    sections["thermometers"].append({**air, "period_s": 0.2})
    daemon.run(**sections)

    def state() -> str:
        return daemon.status().get("thermometers", {}).get("air", {}).get("device", "")

    daemon.until(lambda: state() == "failed")
    shutil.rmtree(broken)
    shutil.copytree(recording, broken)
    daemon.signal(signal.SIGHUP)
    daemon.until(lambda: state() == "open")
    assert daemon.stop() == 0


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_garbage_frames_are_epochs_with_a_reason(daemon, recording, tmp_path, count):
    rng = np.random.default_rng(1)
    heads = [b"\xff\xd8\xff\xe0", b"\xff\xd8" + b"\xff\xd9", b"\xff\xd8\xff\xdb\x00\x43\xff\xd9"]
    garbage = make_photographs(tmp_path / "garbage", recording, [
        heads[k % 3] + rng.bytes(int(rng.integers(0, 3000))) + b"\xff\xd9" * (k % 2)
        for k in range(1, count + 1)
    ])  # fmt: skip
    daemon.start("--recording", str(garbage), "--fast", "--store", str(daemon.store), config=False)
    assert daemon.wait(300) == 0
    numbers, statuses = daemon.stored()
    assert numbers == list(range(1, count + 1))
    assert "ok" not in statuses
    assert "Traceback" not in daemon.log()
    assert daemon.log().count("its last 20 epochs have no result; ") == 1
    assert daemon.events().count("no_result") == 1
