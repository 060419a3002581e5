"""The units: hardened, valid, and each template equal to the plain unit."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.commands import call

UNITS = Path(__file__).resolve().parents[2] / "systemd"


@pytest.fixture
def analyze():
    tool = shutil.which("systemd-analyze")
    if tool is None:
        pytest.skip("systemd-analyze is not installed")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([tool, *arguments], capture_output=True, text=True, check=False)

    return run


@pytest.mark.parametrize("unit", sorted(path.name for path in UNITS.glob("*.service")))
def test_the_exposure_is_at_most_two_and_a_half(analyze, unit):
    done = analyze("security", "--offline=true", "--no-pager", str(UNITS / unit))
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= 2.5


def test_systemd_understands_every_line(analyze, tmp_path):
    """With a program that exists; systemd 252 of Debian 12 has no warnings, either."""
    for unit in UNITS.glob("thermocald*.service"):
        text = unit.read_text().replace("/opt/thermocald/bin/thermocald", "/bin/true")
        (tmp_path / unit.name.replace("@", "@one")).write_text(text)
    for unit in UNITS.glob("*.timer"):
        shutil.copy(unit, tmp_path)
    done = analyze("verify", "--man=no", *map(str, sorted(tmp_path.iterdir())))
    told = [line for line in done.stderr.splitlines() if str(tmp_path) in line]
    assert told == []


def test_the_daemon_is_in_every_group_that_its_devices_belong_to():
    """sysusers creates the groups that a system lacks: an unknown one would prevent the start."""
    unit = (UNITS / "thermocald.service").read_text()
    groups = set(re.search(r"^SupplementaryGroups=(.*)$", unit, re.M)[1].split())
    rules = (UNITS / "60-thermocald.rules").read_text()
    assert groups == set(re.findall(r'GROUP="(\w+)"', rules))
    made = re.findall(r"^m thermocald (\w+)$", (UNITS / "thermocald.sysusers").read_text(), re.M)
    assert groups == set(made)


@pytest.mark.parametrize("name", ["thermocald", "thermocald-dashboard", "thermocald-forward"])
def test_the_template_is_the_plain_unit_with_a_name(name):
    plain = (UNITS / f"{name}.service").read_text().splitlines()[1:]
    template = (UNITS / f"{name}@.service").read_text().splitlines()[1:]
    for a, b in zip(plain, template, strict=True):
        # not below /run/thermocald, which is deleted when the plain unit stops
        b = b.replace("RuntimeDirectory=thermocald-%i", "RuntimeDirectory=thermocald")
        b = b.replace("@%i.service", ".service")
        assert b.replace("/%i.yaml", "/config.yaml").replace(" (%i)", "").replace("/%i", "") == a


def test_the_unit_waits_for_ready_feeds_a_watchdog_and_starts_without_the_network():
    text = (UNITS / "thermocald.service").read_text()
    for line in ("Type=notify", "WatchdogSec=60", "Restart=on-failure", "User=thermocald"):
        assert f"\n{line}\n" in text
    assert "network" not in re.sub(r"#.*", "", text).lower().replace("networkless", "")


@pytest.mark.parametrize("unit", sorted(path.name for path in UNITS.glob("*.service")))
def test_the_command_of_a_unit_has_the_options_that_the_unit_gives(unit):
    """The daily backup gave `--to`, which `backup` does not have, and failed every day."""
    (line,) = re.findall(r"^ExecStart=\S+ (.*)$", (UNITS / unit).read_text(), re.MULTILINE)
    assert call(*line.split(), "--help").returncode == 0


def test_everything_is_installed_where_it_belongs(tmp_path):
    environment = {**os.environ, "DESTDIR": str(tmp_path)}
    script = ["sh", str(UNITS / "install.sh")]
    subprocess.run(script, env=environment, check=True, capture_output=True)
    files = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    units = {p.name for p in UNITS.iterdir() if p.suffix in (".service", ".timer")}
    assert len(units) == 10
    assert files == {
        *(f"etc/systemd/system/{name}" for name in units),
        "etc/thermocald/config.yaml",
        "etc/udev/rules.d/60-thermocald.rules",
        "usr/lib/sysusers.d/thermocald.conf",
        "usr/lib/tmpfiles.d/thermocald.conf",
    }
    subprocess.run([*script, "--uninstall"], env=environment, check=True, capture_output=True)
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"etc/thermocald/config.yaml"}


def test_the_page_shares_neither_memory_nor_processor_with_the_daemon():
    """When memory runs out, the page's control group is killed first, the daemon last."""

    def values(unit: str) -> dict[str, str]:
        lines = (UNITS / unit).read_text().splitlines()
        return dict(line.split("=", 1) for line in lines if re.match(r"\w+=", line))

    for at, what in [(at, what) for at in ("", "@") for what in ("dashboard", "forward")]:
        page = values(f"thermocald-{what}{at}.service")
        daemon = values(f"thermocald{at}.service")
        assert int(page["OOMScoreAdjust"]) > 0 > int(daemon["OOMScoreAdjust"])
        assert int(page["MemoryMax"].removesuffix("M")) <= 200
        assert int(daemon["MemoryMin"].removesuffix("M")) >= 100
        assert int(page["CPUWeight"]) < 100 < int(daemon["CPUWeight"])
        assert "MemoryMax" in daemon
        assert page["RestartPreventExitStatus"] == "2"
        # a page, and a daemon that is not up yet, end by SIGTERM with this status: no failure
        assert page["SuccessExitStatus"] == daemon["SuccessExitStatus"] == "143"
