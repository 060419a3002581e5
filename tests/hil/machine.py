"""The laboratory's virtual machine: boot it, run commands, cut the power."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.hil import thermal_zone

if TYPE_CHECKING:
    from collections.abc import Callable

BOOT_S = 240.0
# The least that NumPy and OpenCV need (x86-64-v2). With "max", which also has AVX, Python and NumPy
# sometimes crashed in the emulation (QEMU 7.2)
CPU = "Nehalem"
GUEST = "/mnt/host/guest"
PRELOADED = "/run/preloaded.sock"
_SSH_FAILED = 255  # our commands never end with it
STORE_SIZE = "48M"  # small, so that little has to be freed for observations (20 MB)
WRITES_BYTES = 4 << 30  # sparse


class Machine:
    """A guest with temporary disks.

    `store` is an empty file system for the daemon's store, /dev/vdb in the guest; `writes` is the
    disk to which device mapper logs the writes there, /dev/vdc. `serial` is the socket of a USB
    serial adapter, which QEMU plugs in while a client is connected; `wire` likewise for a client
    with the USB redirection protocol. `share` is /mnt/host in the guest.
    """

    def __init__(self, built: Path, folder: Path, accelerator: str = "tcg,thread=multi") -> None:
        self.built, self.folder, self.accelerator = built, folder, accelerator
        folder.mkdir(parents=True, exist_ok=True)
        self.disk = folder / "disk.qcow2"
        self.empty, self.store = folder / "empty.raw", folder / "store.raw"
        self.writes = folder / "writes.raw"
        self.share = folder / "share"
        self.share.mkdir(exist_ok=True)
        self.serial = folder / "serial.sock"
        self.wire = folder / "wire.sock"
        self.scripts = folder / "scripts.sock"
        self.zone = folder / "zone.aml"
        self.zone.write_bytes(thermal_zone.table())
        self.process: subprocess.Popen[bytes] | None = None
        self._master: subprocess.Popen[bytes] | None = None
        self.port = 0
        self.boot_s = 0.0

    def boot(self) -> None:
        """Start the guest and wait until it runs commands."""
        if not self.disk.exists():
            base = (self.built / "root.ext4").resolve()
            subprocess.run(
                ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", base, self.disk],
                check=True,
            )
            # initialise everything now, so that the kernel writes nothing later by itself
            features = "lazy_itable_init=0,lazy_journal_init=0,nodiscard"
            subprocess.run(
                ["mke2fs", "-q", "-t", "ext4", "-m", "0", "-E", features, self.empty, STORE_SIZE],
                check=True,
            )
            shutil.copyfile(self.empty, self.store)
            with self.writes.open("wb") as file:
                file.truncate(WRITES_BYTES)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        for path in (self.serial, self.wire):
            path.unlink(missing_ok=True)
        begin = time.monotonic()
        with (self.folder / "qemu.log").open("ab") as log:
            self.process = subprocess.Popen(
                self._command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        while time.monotonic() - begin < BOOT_S:
            if self.process.poll() is not None:
                raise RuntimeError(f"QEMU ended: {(self.folder / 'qemu.log').read_text()[-500:]}")
            if self.run("true", check=False, timeout_s=20).returncode == 0:
                self.boot_s = time.monotonic() - begin
                self._share_a_connection()
                return
            time.sleep(0.5)
        raise RuntimeError(f"the guest did not answer in {BOOT_S:g} s; see {self.folder}/console")

    def _command(self) -> list[str]:
        kernel_line = (
            "console=ttyS0 root=/dev/vda rw quiet loglevel=4 mitigations=off net.ifnames=0 "
            "systemd.show_status=0 panic=-1"
        )
        return [
            *("setpriv", "--pdeathsig", "KILL"),  # QEMU ends with its parent
            *("qemu-system-x86_64", "-M", "q35", "-accel", self.accelerator, "-cpu", CPU),
            *("-smp", "2", "-m", "1536", "-nodefaults", "-no-user-config", "-display", "none"),
            "-no-reboot",  # a kernel that panics, as v4l2loopback may make it, ends the machine
            *("-kernel", str(self.built / "kernel"), "-initrd", str(self.built / "initrd")),
            *("-append", kernel_line),
            *("-drive", f"file={self.disk},if=virtio,format=qcow2,cache=writeback"),
            *("-drive", f"file={self.store},if=virtio,format=raw,cache=writeback"),
            *("-drive", f"file={self.writes},if=virtio,format=raw,cache=writeback"),
            *("-netdev", f"user,id=n,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22"),
            *("-device", "virtio-net-pci,netdev=n,romfile="),
            *("-virtfs", f"local,path={self.share},mount_tag=host,security_model=none"),
            *("-acpitable", f"file={self.zone}"),
            *("-device", "virtio-rng-pci", "-device", "qemu-xhci,id=usb"),
            *("-chardev", f"socket,id=line,path={self.serial},server=on,wait=off"),
            *("-device", "usb-serial,chardev=line,bus=usb.0,id=adapter"),
            *("-chardev", f"socket,id=wire,path={self.wire},server=on,wait=off"),
            *("-device", "usb-redir,chardev=wire,bus=usb.0,id=bridge"),
            *("-serial", f"file:{self.folder / 'console'}"),
        ]

    def _ssh(self, *more: str) -> list[str]:
        return [
            *("ssh", "-q", "-i", str(self.built / "key"), "-p", str(self.port)),
            *("-o", "StrictHostKeyChecking=no", "-o", "UserKnownHostsFile=/dev/null"),
            *("-o", "ConnectTimeout=10", "-o", "BatchMode=yes", "-S", str(self.folder / "ssh")),
            *(*more, "root@127.0.0.1"),
        ]

    def _share_a_connection(self) -> None:
        """Open one connection for all commands: a key exchange takes two seconds."""
        quiet = subprocess.DEVNULL
        self.scripts.unlink(missing_ok=True)
        forward = ("-L", f"{self.scripts}:{PRELOADED}")
        self._master = subprocess.Popen(
            self._ssh("-M", "-N", *forward), stdin=quiet, stdout=quiet, stderr=quiet
        )
        while not (self.folder / "ssh").exists() and self._master.poll() is None:
            time.sleep(0.05)

    def run(
        self, command: str, *, check: bool = True, timeout_s: float = 120.0, tries: int = 3
    ) -> subprocess.CompletedProcess[str]:
        """Run a shell command as root in the guest; retry if a busy guest refuses to connect."""
        if self.process is None or self.process.poll() is not None:
            raise RuntimeError(f"the guest ended: {(self.folder / 'console').read_text()[-2000:]}")
        quiet = subprocess.DEVNULL
        ssh = [*self._ssh(), command]
        try:
            done = subprocess.run(
                ssh, capture_output=True, text=True, timeout=timeout_s, stdin=quiet, check=False
            )
        except subprocess.TimeoutExpired:
            if check:
                raise
            return subprocess.CompletedProcess(ssh, 124, "", "timed out")
        if check and done.returncode == _SSH_FAILED and tries > 1:
            time.sleep(1.0)
            return self.run(command, timeout_s=timeout_s, tries=tries - 1)
        if check and done.returncode:
            raise RuntimeError(f"{command}: status {done.returncode}\n{done.stdout}{done.stderr}")
        return done

    def python(
        self, script: str, *arguments: object, timeout_s: float = 300.0, **steps: Callable[[], None]
    ) -> Any:
        """Run a script of tests/hil/guest in the guest; return the JSON of its last line.

        steps: what to do when the script prints a line with this name.
        """
        words = [f"{GUEST}/{script}", *map(str, arguments)]
        with self._preloaded() as line:
            line.settimeout(timeout_s)
            line.sendall(json.dumps(words).encode() + b"\n")
            printed = []
            for text in line.makefile():
                steps.get(text.strip(), lambda: None)()
                printed.append(text)
        try:
            return json.loads(printed[-1])
        except (ValueError, IndexError):
            raise RuntimeError(f"{words}:\n{''.join(printed)}") from None

    def _preloaded(self, timeout_s: float = 240.0) -> socket.socket:
        """Return a connection to the process that runs scripts, which is started if it is not."""
        deadline = time.monotonic() + timeout_s
        while True:
            line = socket.socket(socket.AF_UNIX)
            line.connect(str(self.scripts))
            if line.recv(6) == b"ready\n":
                return line
            line.close()  # nothing listens in the guest
            if time.monotonic() > deadline:
                why = self.run("journalctl -u preloaded -n 20 --no-pager -o cat").stdout
                raise RuntimeError(f"no scripts can be run in the guest: {why}")
            start = f"python3 {GUEST}/preloaded.py {PRELOADED}"
            start = f"systemd-run -q --collect --unit preloaded {start}"
            self.run(f"systemctl is-active -q preloaded || {start}", check=False)
            time.sleep(0.2)

    def wait(self, command: str, timeout_s: float = 60.0) -> str:
        """Wait until a command succeeds in the guest; return its output."""
        deadline = time.monotonic() + timeout_s
        while True:
            done = self.run(command, check=False)
            if done.returncode == 0:
                return done.stdout
            if time.monotonic() > deadline:
                raise RuntimeError(f"not in {timeout_s:g} s: {command}\n{done.stdout}{done.stderr}")
            time.sleep(0.2)

    def cut_power(self) -> None:
        """Kill the guest without shutdown or flush; only data that the host has survive."""
        for process in (self.process, self._master):
            if process is not None:
                process.kill()
                process.wait()
        self.process = self._master = None
        (self.folder / "ssh").unlink(missing_ok=True)

    def close(self) -> None:
        self.cut_power()
        for path in (self.disk, self.empty, self.store, self.writes, self.serial, self.wire):
            path.unlink(missing_ok=True)
