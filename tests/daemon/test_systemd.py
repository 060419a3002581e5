"""The units: hardened, valid, and each template equal to the plain unit."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from tests.commands import call
from thermocald.store.recording.reader import read_recording

UNITS = Path(__file__).resolve().parents[2] / "systemd"
FILES = [path for path in UNITS.iterdir() if path.suffix in (".service", ".timer")]
each_unit = pytest.mark.parametrize("unit", sorted(path.name for path in UNITS.glob("*.service")))


def analyze(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze; skips where there is none."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    command = ["systemd-analyze", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@each_unit
def test_the_exposure_is_at_most_two_and_a_half(unit):
    done = analyze("security", "--offline=true", "--no-pager", UNITS / unit)
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= 2.5


def test_systemd_understands_every_line(tmp_path):
    """With a program that exists; systemd 252 of Debian 12 has no warnings, either."""
    for unit in FILES:
        text = unit.read_text().replace("/opt/thermocald/bin/thermocald", "/bin/true")
        (tmp_path / unit.name.replace("@", "@one")).write_text(text)
    done = analyze("verify", "--man=no", *sorted(tmp_path.iterdir()))
    assert [line for line in done.stderr.splitlines() if str(tmp_path) in line] == []


def test_the_daemon_is_in_every_group_that_its_devices_belong_to():
    """sysusers creates the groups that a system lacks: an unknown one would prevent the start."""
    (groups,) = values("thermocald.service", "SupplementaryGroups")
    rules = (UNITS / "60-thermocald.rules").read_text()
    made = (UNITS / "thermocald.sysusers").read_text()
    assert set(groups.split()) == set(re.findall(r'GROUP="(\w+)"', rules))
    assert set(groups.split()) == set(re.findall(r"^m thermocald (\w+)$", made, re.M))


@pytest.mark.parametrize("name", ["thermocald", "thermocald-dashboard", "thermocald-forward"])
def test_the_template_is_the_plain_unit_with_a_name(name):
    plain = (UNITS / f"{name}.service").read_text().splitlines()[1:]
    template = (UNITS / f"{name}@.service").read_text().splitlines()[1:]
    for a, b in zip(plain, template, strict=True):
        # not below /run/thermocald, which is deleted when the plain unit stops
        b = b.replace("RuntimeDirectory=thermocald-%i", "RuntimeDirectory=thermocald")
        b = b.replace("@%i.service", ".service")
        assert b.replace("/%i.yaml", "/config.yaml").replace(" (%i)", "").replace("/%i", "") == a


def values(unit: str, *keys: str) -> list[str]:
    """Return the values of a unit's keys."""
    lines = [line.split("=", 1) for line in (UNITS / unit).read_text().splitlines()]
    found = dict(line for line in lines if len(line) == 2)
    return [found[key] for key in keys]


@each_unit
def test_the_command_of_a_unit_has_the_options_that_the_unit_gives(unit):
    """The daily backup gave `--to`, which `backup` does not have, and failed every day."""
    (line,) = values(unit, "ExecStart")
    assert call(*line.split()[1:], "--help").returncode == 0


def files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def test_everything_is_installed_where_it_belongs(tmp_path):
    environment = {**os.environ, "DESTDIR": str(tmp_path)}
    script = ["sh", str(UNITS / "install.sh")]
    subprocess.run(script, env=environment, check=True, capture_output=True)
    assert len(FILES) == 10
    assert files(tmp_path) == {
        *(f"etc/systemd/system/{path.name}" for path in FILES),
        "etc/thermocald/config.yaml", "etc/udev/rules.d/60-thermocald.rules",
        "usr/lib/sysusers.d/thermocald.conf", "usr/lib/tmpfiles.d/thermocald.conf",
    }  # fmt: skip
    subprocess.run([*script, "--uninstall"], env=environment, check=True, capture_output=True)
    assert files(tmp_path) == {"etc/thermocald/config.yaml"}


# a synchronised clock, without which no frame is deleted for its age
SYNCHRONISED = {"CLOCK_SYNCHRONISED": "1"}


@pytest.mark.slow
def test_the_timers_command_archives_what_has_ended_and_deletes_old_frames(
    daemon, devices, preloaded
):
    """The command of the timer's unit, its paths moved below the daemon's folder."""
    daemon.forker = preloaded
    (line,) = values("thermocald-archive.service", "ExecStart")
    for place in ("/etc/thermocald/", "/var/lib/thermocald/"):
        line = line.replace(place, "")
    program, *words = line.split()
    assert program == "/opt/thermocald/bin/thermocald"

    def timer() -> tuple[int, str]:
        done = preloaded.start(daemon.folder, *words, log="timer.txt", **SYNCHRONISED)
        said = done.said()
        (daemon.folder / "timer.txt").unlink()
        return done.returncode, said

    def delete_an_old_frame() -> str:
        old = sorted(daemon.frames.rglob("*.png"))[0]
        os.utime(old, (time.time() - 2 * 86400,) * 2)
        status, said = timer()
        assert (status, old.exists()) == (0, False), said
        return said

    assert timer()[0] == 2  # no configuration: one line, no traceback
    daemon.configure(**devices())
    assert "nothing has been stored yet" in timer()[1]
    for series in ("M1", "M2"):
        daemon.configure(**devices(series=series), keep="all", frames={"max_age_days": 1})
        daemon.start(**SYNCHRONISED)
        daemon.more(4)
        if series == "M1":
            assert daemon.stop() == 0
    # while the daemon runs, it deletes an old frame and logs it
    assert "frames deleted: 1 " in delete_an_old_frame()
    assert not (daemon.folder / "recordings/one-M2").exists()
    assert len(read_recording(daemon.folder / "recordings/one-M1").epochs) >= 4
    assert daemon.stop() == 0
    # without a daemon, the command deletes and logs it; a second run archives nothing
    assert "one-M1" not in delete_an_old_frame()
    assert daemon.events().count("frames_deleted") == 2
