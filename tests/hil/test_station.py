"""The daemon under systemd in the guest: a warm-up before a test field, then faults.

Frames come through v4l2loopback, temperatures through the kernel's lm75 driver and a USB serial
adapter. The feeder logs the times of frames and temperatures, and every frame contains its number,
so that stored epochs can be compared with the log.
"""

from __future__ import annotations

import bisect
import json
import shutil
import statistics
import time

import numpy as np
import pytest

from tests.hil.conftest import plugged_instrument
from tests.hil.frames import subject
from tests.hil.power import replay, wait_for_mark
from tests.hil.station import CAMERA, PERIOD_S, SIZE, STORE, VIVID, prepare

EPOCHS = 30
CALIBRATED = 27  # at least, after the daemon has calibrated postponed epochs
FPS = 4.0
HOLD = round(PERIOD_S * FPS)
STAMP_S = 0.005
VIVID_DRIVER = "/sys/bus/platform/drivers/vivid"


class Station:
    """The daemon in the guest."""

    def __init__(self, machine, instrument):
        self.machine, self.instrument = machine, instrument

    def install(self, i2c_bus):
        run = self.machine.run
        folder = self.machine.share / "station"
        folder.mkdir()
        prepare(folder, self.instrument.port, EPOCHS)
        self.i2c_bus = i2c_bus
        run(
            "mkdir -p /etc/thermocald && "
            "cp /mnt/host/station/*.csv /mnt/host/station/config.yaml /etc/thermocald/"
        )
        run("sh /mnt/host/guest/install_unit.sh /mnt/host/systemd")
        run("modprobe dm-log-writes && sh /mnt/host/guest/store_disk.sh logged")
        run(
            f"test -e /sys/bus/i2c/devices/{i2c_bus}-0048 || "
            f"echo tmp75 0x48 > /sys/bus/i2c/devices/i2c-{i2c_bus}/new_device"
        )
        run("systemctl start mosquitto", timeout_s=60)
        self.feed()
        probe = "/opt/thermocald/bin/thermocald check /etc/thermocald/config.yaml --probe --json -"
        self.probed = json.loads(run(f"{probe} 2>/dev/null", check=False, timeout_s=240).stdout)
        run("systemctl start thermocald", timeout_s=240)
        self.until(lambda status: river(status)["stored"] >= 1, "the first epoch")

    def feed(self):
        """Start the camera's feeder."""
        self.machine.run(
            "rm -f /run/feed.log; systemd-run -q --unit=feeder --collect "
            f"python3 /mnt/host/guest/feed.py {CAMERA} /mnt/host/station/frames.npy "
            "/mnt/host/station/temperatures.npy /run/feed.log "
            f"--fps {FPS} --hold {HOLD} --bus {self.i2c_bus} --go /run/heating"
        )
        try:
            self.machine.wait("test -s /run/feed.log", 120)
        except RuntimeError as error:
            why = self.machine.run("journalctl -u feeder -n 20 --no-pager -o cat").stdout
            raise AssertionError(f"the feeder does not run:\n{why}") from error

    def stop_feeding(self):
        """Stall the camera; a killed feeder could not restart while the device is open."""
        self.machine.run("systemctl kill -s SIGSTOP feeder")

    def go_on_feeding(self):
        self.machine.run("systemctl kill -s SIGCONT feeder")

    def stored(self):
        """Return the store's content after a check of the whole file."""
        return self.machine.python("store.py")

    def numbers(self):
        """Return the numbers of the river's epochs in the store, in order."""
        return [epoch["number"] for epoch in self.stored()["series"]["river"]]

    def events(self):
        """Return the kinds of the store's events."""
        return [event["kind"] for event in self.stored()["events"]]

    def status(self):
        out = self.machine.wait("cat /run/thermocald/status.json", 60)
        return json.loads(out)

    def until(self, condition, what, timeout_s=180.0):
        """Wait until the daemon's status fulfils a condition; return the status."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = self.status()
            if condition(status):
                return status
            if time.monotonic() > deadline:
                journal = self.machine.run("journalctl -u thermocald -n 20 --no-pager").stdout
                raise AssertionError(f"not in {timeout_s:g} s: {what}\n{journal}")
            time.sleep(0.5)

    def journal(self, pattern):
        """Return the lines of the daemon's journal that match a pattern."""
        done = self.machine.run(
            f"journalctl -u thermocald --no-pager -o cat | grep -E '{pattern}'", check=False
        )
        return done.stdout.splitlines()


@pytest.fixture(scope="module")
def station(machine, video, i2c_bus):
    with plugged_instrument(machine) as instrument:
        one = Station(machine, instrument)
        one.install(i2c_bus)
        yield one


def river(status):
    return status["cameras"]["river"]


def device_states(status):
    every = {**status["cameras"], **status["thermometers"]}
    return {name: state["device"] for name, state in every.items()}


def caught_up(station, timeout_s=120.0):
    """Wait until all epochs of the river are calibrated; fail if there is no progress."""
    deadline, before = time.monotonic() + timeout_s, None
    while True:
        left = station.machine.python("calibrated.py").get("not_calibrated", 0)
        if not left:
            return
        if left != before:
            deadline, before = time.monotonic() + timeout_s, left
        if time.monotonic() > deadline:
            raise AssertionError(f"{left} epochs not calibrated, none in {timeout_s:g} s")
        time.sleep(1.0)


@pytest.fixture(scope="module")
def series(station):
    """Return the store after the heating, the feeder's log, and the clock offset."""
    first = station.until(lambda s: river(s)["stored"] >= 2, "the first epochs", 240)
    station.machine.run("touch /run/heating")
    last = river(first)["stored"] + EPOCHS + 2
    station.until(lambda s: river(s)["stored"] >= last, f"{EPOCHS} epochs", 420)
    station.stop_feeding()  # without new frames, the daemon calibrates postponed epochs
    station.until(
        lambda s: river(s)["waiting"] == 0 and river(s)["device"] == "out", "no frames left", 120
    )
    caught_up(station)
    stored = station.stored()
    log = {}
    for line in station.machine.run("cat /run/feed.log").stdout.splitlines():
        number, before, after, celsius = line.split()
        log[int(number)] = (float(before), float(after), float(celsius))
    # the closest pair of several: a busy guest may pause between the two clocks
    read = "((m(), t(), m()) for _ in range(50))"
    offset = float(
        station.machine.run(
            f"python3 -c 'from time import monotonic as m, time as t; "
            f"print(min((c - a, b - (a + c) / 2) for a, b, c in {read})[1])'"
        ).stdout
    )
    return stored, log, offset


def test_the_probe_shows_every_device(station, report):
    """`thermocald check config.yaml --probe` runs before the daemon."""
    probes = {probe["name"]: probe for probe in station.probed["probes"]}
    assert {name for name, probe in probes.items() if probe["error"]} == set()
    assert probes["river"]["values"]["width_px"] == SIZE[0]
    assert probes["yard"]["values"]["height_px"] == 360
    assert probes["lens"]["values"] == {"temperature_c": 25.0}
    assert probes["line"]["values"] == {"temperature_c": 21.25}
    took = ", ".join(f"{name} {1e3 * probe['took_s']:.0f} ms" for name, probe in probes.items())
    report(f"thermocald check --probe, trigger to frame and read to value: {took}")


def test_every_epoch_has_its_frame_and_time(series, report):
    stored, log, offset = series
    epochs = [e for e in stored["series"]["river"] if e["frame"] in log]
    assert len(epochs) >= EPOCHS
    numbers = [e["frame"] for e in epochs]
    assert numbers == sorted(set(numbers))  # no frame twice, none out of order
    errors = []
    for epoch in epochs:
        before, after, _ = log[epoch["frame"]]
        at = epoch["frame_time"] - offset
        errors.append(max(before - at, at - after, 0.0))
    assert max(errors) < STAMP_S
    gaps = np.diff([e["frame_time"] for e in epochs])
    report(
        f"daemon: {len(epochs)} epochs stored, times wrong by at most {1e3 * max(errors):.2f} ms, "
        f"interval median {statistics.median(gaps):.3f} s (set {PERIOD_S:g} s), largest "
        f"{max(gaps):.2f} s"
    )


def test_every_epoch_has_its_temperatures(series):
    """Each temperature was in the register at its stored time."""
    stored, log, offset = series
    times = sorted((before, celsius) for before, _, celsius in log.values())
    starts = [at for at, _ in times]
    checked = 0
    for epoch in stored["series"]["river"]:
        if epoch["frame"] not in log or epoch["temperatures"].get("lens") is None:
            continue
        at = epoch["temperature_time"] - offset
        # the kernel's driver may return a value as old as its refresh interval, 0.22 s
        here = {times[max(0, bisect.bisect(starts, t) - 1)][1] for t in (at - 0.5, at, at + 0.05)}
        low, high = min(here), max(here)
        assert low - 0.001 <= epoch["temperatures"]["lens"] <= high + 0.001
        assert epoch["temperatures"]["line"] == 21.25
        checked += 1
    assert checked >= EPOCHS - 2


def test_the_epochs_are_calibrated(series, report):
    """The stored interior orientation follows the temperature like the rendered camera."""
    stored, log, _ = series
    good = [e for e in stored["series"]["river"] if e["status"] == "ok" and e["frame"] in log]
    assert len(good) >= CALIBRATED
    model = subject(*SIZE)[1]
    celsius = np.array([log[e["frame"]][2] for e in good])
    x0 = np.array([e["values"][1] for e in good])
    slope = np.polyfit(celsius, x0, 1)[0]
    true = model.rates["x0"]
    assert slope == pytest.approx(true, rel=0.1)
    report(
        f"daemon: {len(good)} epochs calibrated, dx0/dT {1e3 * slope:.3f} µm/K, "
        f"true {1e3 * true:.3f} µm/K"
    )


def test_the_daemon_keeps_far_within_its_units_memory(station, series, report):
    """At its limit, the kernel would kill it in the middle of a series."""
    group = "/sys/fs/cgroup/system.slice/thermocald.service/memory"
    lines = f"grep -h '^anon \\|^oom_kill ' {group}.stat {group}.events"
    limit, _, own, _, killed = station.machine.run(f"cat {group}.max; {lines}").stdout.split()
    assert int(killed) == 0
    assert int(own) < 0.5 * int(limit)
    report(
        f"daemon: {int(own) / 1e6:.0f} MB of the unit's {int(limit) / 1e6:.0f} MB after a series"
    )


def test_a_stalled_camera_comes_back(station, series):
    """The feeder is stopped since the end of the series: one warning, and one return."""
    before = river(station.status())["stored"]
    outs, backs = station.journal("camera river is out"), station.journal("camera river is back")
    assert len(outs) == len(backs) + 1  # one warning for many attempts
    station.go_on_feeding()
    station.until(lambda s: river(s)["stored"] > before + 1, "epochs again", 120)
    assert len(station.journal("camera river is out")) == len(outs)
    assert len(station.journal("camera river is back")) == len(backs) + 1


def test_the_other_camera_is_unplugged(station):
    """vivid is unbound and bound again: its epochs pause, the river's do not."""
    station.until(lambda s: s["cameras"]["yard"]["stored"] > 0, "frames of the yard", 120)
    station.machine.run(f"echo vivid.0 > {VIVID_DRIVER}/unbind")
    out = station.until(lambda s: device_states(s)["yard"] == "out", "yard out")
    there, yards = river(out)["stored"], out["cameras"]["yard"]["stored"]
    still = station.until(lambda s: river(s)["stored"] > there + 1, "the river goes on")
    assert still["cameras"]["yard"]["stored"] == yards
    station.machine.run(f"echo vivid.0 > {VIVID_DRIVER}/bind")
    station.machine.wait(f"test -e {VIVID}")
    station.until(lambda s: s["cameras"]["yard"]["stored"] > yards, "epochs of the yard again")
    assert station.journal("camera yard is out")
    assert station.journal("camera yard is back")
    yard = [epoch["number"] for epoch in station.stored()["series"]["yard"]]
    assert yard == list(range(1, len(yard) + 1))


def bare_epochs(station, last):
    """Return the river's stored epochs after number `last` without any temperature."""
    epochs = station.stored()["series"]["river"]
    return [e for e in epochs if e["number"] > last and set(e["temperatures"].values()) <= {None}]


def both_are_read(station):
    """Return whether the river's last stored epoch has both temperatures."""
    temperatures = station.stored()["series"]["river"][-1]["temperatures"]
    return temperatures["lens"] is not None and temperatures["line"] == 21.25


def test_thermometers_are_unplugged_and_plugged_in_again(station):
    """The kernel's driver is unbound, the serial adapter pulled; their values are missing."""
    bus = f"/sys/bus/i2c/devices/i2c-{station.i2c_bus}"
    last = station.numbers()[-1]
    station.machine.run(f"echo 0x48 > {bus}/delete_device")
    station.instrument.pull()
    station.until(lambda s: {device_states(s)[k] for k in ("lens", "line")} == {"out"}, "both out")
    # a busy guest may store epochs late that were read before the pull
    station.until(lambda _: len(bare_epochs(station, last)) >= 2, "epochs without temperatures")
    station.machine.run(f"echo tmp75 0x48 > {bus}/new_device")
    station.instrument.plug()
    station.until(
        lambda s: {device_states(s)[k] for k in ("lens", "line")} == {"open"}, "both back"
    )
    station.until(lambda _: both_are_read(station), "epochs with temperatures again")
    stored = station.stored()
    for name in ("lens", "line"):
        assert station.journal(f"thermometer {name} is out")
        assert station.journal(f"thermometer {name} is back")
        texts = [e["text"] for e in stored["events"] if f"thermometer {name} is" in e["text"]]
        assert [text.split(" is ")[1].split()[0].strip(":") for text in texts] == ["out", "back"]


def test_the_clock_is_set(station):
    """The clock is set two hours back, then forwards: epochs go on, the store has the steps."""
    before = river(station.status())["stored"]
    station.machine.run("date -s '-2 hours'")
    station.until(lambda s: river(s)["stored"] > before + 3, "epochs after the step")
    station.machine.run("date -s '+2 hours'")
    there = river(station.status())["stored"]
    station.until(lambda s: river(s)["stored"] > there + 1, "epochs after the step forwards")
    stored = station.stored()
    steps = [event["text"] for event in stored["events"] if event["kind"] == "clock_step"]
    assert len(steps) == 2
    assert station.journal("the clock was set back by 2.0 hours")
    epochs = stored["series"]["river"][max(0, before - 2) :]
    times = [e["frame_time"] for e in epochs]
    assert times == sorted(times)
    assert max(np.diff(times)) < 60.0  # stored times have no step of two hours


def test_a_hung_daemon_is_restarted(station):
    """systemd's watchdog ends the stopped daemon; the new one goes on with the next number."""
    # on a busy machine the watchdog may have restarted the daemon just now
    show = 'pid="$(systemctl show -P MainPID thermocald)"; test "$pid" != 0 && echo "$pid"'
    pid = station.machine.wait(show, 120).strip()
    last, started = station.numbers()[-1], station.events().count("started")
    station.machine.run(f"kill -STOP {pid}")
    station.machine.wait(
        f'new="$(systemctl show -P MainPID thermocald)"; test "$new" != {pid} -a "$new" != 0 && '
        "systemctl is-active -q thermocald",
        300,
    )
    assert station.journal("Watchdog timeout")
    station.until(lambda s: river(s)["stored"] >= 1, "epochs again", 240)
    numbers = station.numbers()
    assert numbers == list(range(1, len(numbers) + 1))
    assert numbers[-1] > last
    assert station.events().count("started") == started + 1


def test_power_cut(station, report):
    """The power fails, and everything not flushed is lost, but no stored epoch.

    Epochs that another process has read from the store count as stored. A file that was not flushed
    shows that data are lost.
    """
    machine = station.machine
    acknowledged = station.numbers()[-1]
    machine.run(
        f"head -c 100000 /dev/zero > {STORE}/never-flushed; dmsetup message store 0 mark power-cut"
    )
    wait_for_mark(machine.writes, "power-cut")
    machine.cut_power()
    shutil.copyfile(machine.empty, machine.store)
    writes = replay(machine.writes, machine.store, "power-cut")
    machine.boot()
    machine.run("sh /mnt/host/guest/store_disk.sh plain")
    numbers = station.numbers()  # reads and checks the whole file
    assert numbers == list(range(1, len(numbers) + 1))
    assert numbers[-1] >= acknowledged
    assert machine.run(f"test -s {STORE}/never-flushed", check=False).returncode == 1
    report(
        f"power cut: {numbers[-1]} epochs stored, {acknowledged} read before it; {writes} "
        f"flushed writes replayed, booted again in {machine.boot_s:.0f} s"
    )
