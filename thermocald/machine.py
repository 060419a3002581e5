"""The checks of a machine: what cameras, thermometers and correct times need and what is missing.

A check reads only files below `root`, so that a folder can represent a machine; a missing file is
no error. Nothing is changed.

Sources: Raspberry Pi documentation, config.txt (camera_auto_detect, dtparam=i2c_arm, w1-gpio) and
vcgencmd get_throttled (the bits); systemd-timesyncd(8) for the clock; kernel documentation of
/proc/device-tree, hwmon and 1-wire.
"""

from __future__ import annotations

import contextlib
import ctypes
import grp
import importlib.util
import os
import pwd
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

NOT_BEFORE = 1_700_000_000.0  # s UTC; this program did not exist before
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised

State = Literal["ok", "missing", "warning", "not needed"]
_Result = tuple[State, str, str]  # state, text and remedy of a finding

# bits of get_throttled: at present, and since the start
_THROTTLED = {
    0: "the supply voltage is too low now",
    1: "the processor's frequency is capped now",
    2: "the processor is throttled now",
    3: "the processor is at its temperature limit now",
    16: "the supply voltage was too low since the start",
    17: "the processor's frequency was capped since the start",
    18: "the processor was throttled since the start",
    19: "the processor was at its temperature limit since the start",
}
_SUPPLY_BITS = (0, 16)
_HOT_C = 80.0  # the firmware throttles from 80 °C on
_COOLER = "give the board a heat sink, or a cooler place"
_FREE_BYTES = 1_000_000_000
# group → the device nodes that it may open
_GROUPS = {
    "video": ("video*", "media*", "dma_heap/*"),
    "i2c": ("i2c-*",),
    "dialout": ("ttyUSB*", "ttyACM*", "ttyAMA*"),
    "gpio": ("gpiochip*",),
}

_MARKS = {"ok": "ok", "missing": "MISSING", "warning": "warning", "not needed": "-"}


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check; remedy: the command that mends it, or nothing."""

    name: str
    state: State
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Machine:
    """A machine as its files describe it.

    root: the folder that is its `/`.
    user, groups: the user and groups of this process; uid 0 may open everything.
    synchronised: whether its clock is synchronised; None: unknown.
    has_module: returns whether this Python finds a module.
    """

    root: Path
    user: str
    uid: int
    groups: frozenset[str]
    synchronised: bool | None
    has_module: Callable[[str], bool] = lambda name: importlib.util.find_spec(name) is not None

    @classmethod
    def here(cls, root: Path) -> Self:
        """Return the machine with a root folder, for the user who runs the program."""
        trusted = machine_clock_trusted() if root == Path("/") else None
        user, groups = str(os.getuid()), set()  # in a container, ids may have no names
        with contextlib.suppress(KeyError):
            user = pwd.getpwuid(os.getuid()).pw_name
        for number in (os.getgid(), *os.getgroups()):
            with contextlib.suppress(KeyError):
                groups.add(grp.getgrgid(number).gr_name)
        return cls(root, user, os.getuid(), frozenset(groups), trusted)

    def findings(self) -> list[Finding]:
        """Run all checks, in the order in which findings are best mended."""
        checks = {
            "machine": self._board, "camera stack": self._camera_stack,
            "camera connector": self._camera_enabled, "groups": self._groups, "I2C": self._i2c,
            "1-wire": self._one_wire, "phones": self._phones, "clock": self._clock,
            "power": self._power, "board temperature": self._heat, "disk": self._disk,
            "service": self._service,
        }  # fmt: skip
        return [Finding(name, *found) for name, check in checks.items() if (found := check())]

    def _read(self, path: str) -> str | None:
        """Return a file's text without NULs and outer white space, None if it cannot be read."""
        try:
            text = (self.root / path).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return None
        return text.replace("\x00", "").strip()

    def _find(self, *patterns: str) -> list[Path]:
        return sorted(path for pattern in patterns for path in self.root.glob(pattern))

    @property
    def board(self) -> str:
        """The model, such as "Raspberry Pi 4 Model B Rev 1.4"; empty without a device tree."""
        return self._read("proc/device-tree/model") or ""

    @property
    def _is_pi(self) -> bool:
        return self.board.startswith("Raspberry Pi")

    @property
    def _settings(self) -> list[str]:
        """The lines of config.txt without comments."""
        text = self._read("boot/firmware/config.txt") or self._read("boot/config.txt") or ""
        return [line.split("#")[0].strip() for line in text.splitlines()]

    def _board(self) -> _Result:
        system = self._read("etc/os-release") or ""
        names = dict(line.split("=", 1) for line in system.splitlines() if "=" in line)
        name = names.get("PRETTY_NAME", "an unknown system").strip('"')
        return "ok", f"{self.board or 'not a Raspberry Pi'}, {name}", ""

    def _camera_stack(self) -> _Result:
        absent = [name for name in ("libcamera", "picamera2") if not self.has_module(name)]
        if not absent:
            return "ok", "picamera2 and libcamera are found", ""
        if not self._is_pi:
            return "not needed", "picamera2 is for the camera of a Raspberry Pi", ""
        if self._find("usr/lib/python3/dist-packages/picamera2"):
            why = "picamera2 is installed, but this Python environment does not see the system's"
            remedy = "python3 -m venv --system-site-packages --upgrade .venv"
            return "missing", f"{why} modules", remedy
        why = f"{' and '.join(absent)} not installed"
        return "missing", why, "sudo apt-get install python3-picamera2"

    def _camera_enabled(self) -> _Result | None:
        if not self._is_pi or not self._settings:
            return None
        wanted = ("camera_auto_detect=1", "dtoverlay=imx", "dtoverlay=ov", "dtoverlay=arducam")
        if any(line.startswith(wanted) for line in self._settings):
            return "ok", "config.txt enables it", ""
        remedy = "echo camera_auto_detect=1 | sudo tee -a /boot/firmware/config.txt && sudo reboot"
        return "missing", "config.txt does not enable it", remedy

    def _groups(self) -> _Result:
        if self.uid == 0:
            return "ok", "root may open every device", ""
        needed = [
            group
            for group, nodes in _GROUPS.items()
            if self._find(*(f"dev/{node}" for node in nodes))
        ]
        lacking = [group for group in needed if group not in self.groups]
        if not lacking:
            return "ok", "no group is missing", ""
        remedy = f"sudo usermod -aG {','.join(lacking)} {self.user}    # then log in again"
        return "missing", f"{self.user} is not in {', '.join(lacking)}", remedy

    def _i2c(self) -> _Result:
        buses = [bus.name for bus in self._find("dev/i2c-*")]
        # monitor connectors have a bus too, 20 and 21 on a Pi
        if "i2c-1" in buses or (buses and not self._is_pi):
            return "ok", ", ".join(buses), ""
        if not self._is_pi:
            return "not needed", "no bus", ""
        remedy = "sudo raspi-config nonint do_i2c 0"
        return "missing", "off: thermometers on the pins are not seen", remedy

    def _one_wire(self) -> _Result | None:
        if self._find("sys/bus/w1/devices"):
            return "ok", f"{len(self._find('sys/bus/w1/devices/*-*'))} found", ""
        if not self._is_pi:
            return None
        remedy = "echo dtoverlay=w1-gpio | sudo tee -a /boot/firmware/config.txt && sudo reboot"
        return "not needed", "off; only a DS18B20 needs it", remedy

    def _phones(self) -> _Result:
        path = os.pathsep.join(str(self.root / folder) for folder in ("usr/bin", "usr/local/bin"))
        if shutil.which("adb", path=path):
            return "ok", "adb is installed", ""
        why = "adb is not installed; only phones need it"
        return "not needed", why, "sudo apt-get install adb"

    def _clock(self) -> _Result:
        if self.synchronised is None:
            return "warning", "it is unknown whether it is synchronised", ""
        if self.synchronised:
            return "ok", "synchronised", ""
        why = "not synchronised: times of epochs may be wrong"
        return "missing", why, "sudo timedatectl set-ntp true"

    def _power(self) -> _Result | None:
        text = self._read("sys/devices/platform/soc/soc:firmware/get_throttled")
        bits = None
        with contextlib.suppress(ValueError):
            bits = int(text or "", 16)
        if bits is None:
            alarms = [
                self._read(str((path.parent / "in0_lcrit_alarm").relative_to(self.root)))
                for path in self._find("sys/class/hwmon/hwmon*/name")
                if self._read(str(path.relative_to(self.root))) == "rpi_volt"
            ]
            bits = None if not alarms else int("1" in alarms)
        if bits is None:
            why = "the firmware does not report under-voltage"
            return ("warning", why, "") if self._is_pi else None
        seen = [text for bit, text in _THROTTLED.items() if bits >> bit & 1]
        if not seen:
            return "ok", "no under-voltage, no throttling", ""
        supply = any(bits >> bit & 1 for bit in _SUPPLY_BITS)
        remedy = "use the board's own power supply and a short cable" if supply else _COOLER
        return "missing" if bits & 0xF else "warning", "; ".join(seen), remedy

    def _heat(self) -> _Result | None:
        text = self._read("sys/class/thermal/thermal_zone0/temp")
        if not self._is_pi or text is None or not text.lstrip("-").isdigit():
            return None
        degrees = int(text) / 1000.0
        if degrees < _HOT_C:
            return "ok", f"{degrees:.0f} °C", ""
        return "warning", f"{degrees:.0f} °C: it throttles", _COOLER

    def _disk(self) -> _Result | None:
        folder = self.root / "var/lib/thermocald"
        while not folder.exists() and folder != self.root:
            folder = folder.parent
        try:
            about = os.statvfs(folder)
        except OSError:
            return None
        free = about.f_bavail * about.f_frsize
        where = "/" + str(folder.relative_to(self.root)).removeprefix(".")
        if about.f_flag & os.ST_RDONLY:
            remedy = "sudo mount -o remount,rw /    # after a look at the log: dmesg | tail"
            return "missing", f"{where} is read-only: nothing can be stored", remedy
        if free < _FREE_BYTES:
            archive = "thermocald archive --config /etc/thermocald/config.yaml --retention"
            remedy = f"sudo apt-get clean; {archive}"
            return "warning", f"{where} has {free / 1e6:.0f} MB free", remedy
        return "ok", f"{where} has {free / 1e9:.1f} GB free", ""

    def _service(self) -> _Result:
        if not self._find("usr/lib/systemd/system/thermocald.service",
                           "etc/systemd/system/thermocald.service"):  # fmt: skip
            return "not needed", "not installed; `thermocald run` works without", ""
        if self._find("etc/systemd/system/multi-user.target.wants/thermocald*.service"):
            return "ok", "starts with the machine", ""
        why = "installed, but it does not start with the machine"
        return "warning", why, "sudo systemctl enable --now thermocald"


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Return a line for each finding, its remedy below it, and a summary at the end."""
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{_MARKS[finding.state]:>7}  {finding.name:<{width}}  {finding.text}")
        if finding.remedy:
            lines.append(f"{'':>9}{'':<{width}}  → {finding.remedy}")
    missing = [finding.name for finding in findings if finding.state == "missing"]
    summary = f"to mend: {', '.join(missing)}" if missing else "nothing is missing"
    return [*lines, "", summary]


def machine_clock_trusted() -> bool:
    """Return whether the clock is synchronised, as reported by systemd-timesyncd or the kernel."""
    if time.time() < NOT_BEFORE:
        return False
    if _SYNCHRONISED.exists():
        return True
    timex = ctypes.create_string_buffer(512)  # more than a struct timex, and only read
    try:
        return bool(0 <= ctypes.CDLL(None).adjtimex(timex) < _TIME_ERROR)
    except (OSError, AttributeError):
        return False
