"""Fixtures of the laboratory; tests of parts that were not built are skipped."""

from __future__ import annotations

import compileall
import contextlib
import os
import shutil
import socket
import zipfile
from pathlib import Path
from py_compile import PycInvalidationMode

import pytest

from tests.hil.machine import Machine
from tests.hil.one_wire import Adapter, Plugged, Probe
from tests.hil.phone import Phone

HERE = Path(__file__).parent
BUILT = Path(os.environ.get("THERMOCALD_LABORATORY", HERE.parents[1] / "build" / "hil"))


def pytest_collection_modifyitems(items):
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.hil)


@pytest.fixture(autouse=True)
def no_leaked_threads():
    """Allow threads: a replugged instrument has a new one, which its fixture joins."""


@pytest.fixture(scope="session")
def report():
    """Collect lines with measured figures, which the run prints at its end."""
    lines: list[str] = []
    yield lines.append
    path = BUILT / "measured.txt"
    with path.open("a") as file:
        file.writelines(f"{line}\n" for line in lines)


@pytest.fixture(scope="session")
def machine(tmp_path_factory):
    """Boot the guest with this checkout's thermocald."""
    if not (BUILT / "guest" / "built").exists():
        pytest.skip("the laboratory's guest is not built: make hil")
    guest = Machine(BUILT / "guest", tmp_path_factory.mktemp("guest"))
    (wheel,) = sorted((BUILT / "wheel").glob("thermocald-*.whl"))
    with zipfile.ZipFile(wheel) as file:
        file.extractall(guest.share / "thermocald")
    # here, because the daemon in the guest may not write what it compiles, and is slow at it
    compileall.compile_dir(
        guest.share / "thermocald", ddir="/opt/thermocald", quiet=1,
        invalidation_mode=PycInvalidationMode.UNCHECKED_HASH,
    )  # fmt: skip
    shutil.copytree(HERE / "guest", guest.share / "guest")
    (guest.share / "tests_hil").mkdir()
    shutil.copy(HERE / "bars.py", guest.share / "tests_hil")
    shutil.copytree(HERE.parents[1] / "systemd", guest.share / "systemd")
    try:
        guest.boot()
        guest.run("mkdir -p /opt/thermocald && cp -r /mnt/host/thermocald/. /opt/thermocald/")
        yield guest
    finally:
        guest.close()


@pytest.fixture(scope="session")
def video(machine):
    """Load v4l2loopback at /dev/video40 (drivers), 41 (station), and vivid at its stable name."""
    machine.run(
        "modprobe v4l2loopback video_nr=40,41 card_label=laboratory,station exclusive_caps=1,1"
    )
    machine.run("modprobe vivid n_devs=1")
    node = "/dev/v4l/by-path/platform-vivid.0-video-index0"
    machine.wait(f"test -c /dev/video40 -a -c /dev/video41 && test -e {node}")
    return machine


@pytest.fixture(scope="session")
def i2c_bus(machine):
    """Return the number of an SMBus: LM75 0x48, 0x49, BME280 0x76."""
    machine.run("modprobe -a i2c-dev lm75 bmp280-i2c; modprobe i2c-stub chip_addr=0x48,0x49,0x76")
    find = "grep -l 'SMBus stub' /sys/class/i2c-dev/*/name"
    return int(machine.wait(f"{find} | sed 's/.*i2c-\\([0-9]*\\).*/\\1/' | grep ."))


class Instrument(Plugged):
    """A thermometer at the guest's USB serial adapter, which answers `T?` with T=…"""

    celsius = 21.25

    def _serve(self, line: socket.socket) -> None:
        pending = b""
        while data := line.recv(256):
            pending += data
            while b"\n" in pending:
                command, pending = pending.split(b"\n", 1)
                if command.strip() == b"T?":
                    line.sendall(f"T={self.celsius:+.3f}\r\n".encode())


@contextlib.contextmanager
def plugged_instrument(machine):
    """Plug the instrument in, and set `port` to its stable name in the guest."""
    machine.run("modprobe -a xhci-pci ftdi_sio")
    one = Instrument(machine.serial)
    one.plug()
    try:
        one.port = machine.wait("ls /dev/serial/by-id/*", 60).split()[0]
        yield one
    finally:
        one.pull()


@pytest.fixture
def instrument(machine):
    with plugged_instrument(machine) as one:
        yield one


@pytest.fixture
def wire(machine):
    """Plug in a DS9490R with two DS18B20, and wait until the guest has found them."""
    machine.run("modprobe xhci-pci")
    adapter = Adapter(machine.wire, Probe(0xBFE244, 21.5), Probe(0x1B2C3D, -10.125))
    adapter.plug()
    names = " ".join(f"-e /sys/bus/w1/devices/{probe.name}/w1_slave -a" for probe in adapter.probes)
    try:
        machine.wait(f"test {names} -d /sys", 90)
        yield adapter
    finally:
        adapter.pull()


@pytest.fixture
def phone(tmp_path):
    """Start a real adbd behind the real adb server, in their own network."""
    if not (BUILT / "phone" / "built").exists():
        pytest.skip("the laboratory's phone is not built: make hil")
    if os.environ.get("THERMOCALD_NETWORK") != "own":
        pytest.skip("adbd listens on all interfaces: make hil runs this in a network namespace")
    one = Phone(BUILT / "phone" / "root")
    one.start()
    yield one
    one.stop()
