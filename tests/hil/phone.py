"""The laboratory's phone: Debian's adbd in a chroot, with a scripted camera and dumpsys."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
from PIL import Image

from tests.hil.bars import stamp

# not 5555 to 5585, which the adb server uses for emulators
PHONE_PORT = 5600
ADBD = "/usr/lib/android-sdk/platform-tools/adbd"


class Phone:
    """The phone; its scripts (tests/hil/handset/bin) read and write the folder `state`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.state = root / "phone"
        self.camera_folder = root / "sdcard" / "DCIM" / "Camera"
        self.serial = f"127.0.0.1:{PHONE_PORT}"
        self._adbd: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Reset the phone (no photographs, asleep), and attach it to the adb server."""
        for folder in (self.state, self.camera_folder):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        (self.state / "photographs").mkdir()
        self.say("dumpsys.battery", "  voltage: 4100\n  temperature: 287\n")
        self.say(
            "dumpsys.media.camera",
            "  android.lens.focusDistance (80007): float[1]\n        [0.25 ]\n",
        )
        self.plug()

    def plug(self) -> None:
        """Start adbd, and connect the adb server."""
        # in its own mount namespace, so that no mount of /dev and /proc remains
        script = (
            f"mount --rbind /dev {self.root}/dev && mount -t proc proc {self.root}/proc && "
            f"ADBD_PORT={PHONE_PORT} exec chroot {self.root} {ADBD}"
        )
        quiet = subprocess.DEVNULL
        self._adbd = subprocess.Popen(
            ["unshare", "-m", "sh", "-c", script], stdin=quiet, stdout=quiet, stderr=quiet
        )
        self.attach()

    def attach(self, timeout_s: float = 30.0) -> None:
        """Repeat `adb connect` until the phone is listed as a device."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self.adb("connect", self.serial)
            if f"{self.serial}\tdevice" in self.adb("devices"):
                return
            time.sleep(0.1)
        raise RuntimeError(f"adb does not see the phone: {self.adb('devices')}")

    def adb(self, *arguments: str) -> str:
        done = subprocess.run(
            ["adb", *arguments], capture_output=True, text=True, timeout=30, check=False
        )
        return done.stdout + done.stderr

    def pull(self) -> None:
        """Kill adbd, as if the cable were pulled."""
        if self._adbd is not None:
            self._adbd.send_signal(signal.SIGKILL)
            self._adbd.wait()
            self._adbd = None

    def stop(self) -> None:
        self.adb("disconnect", self.serial)
        self.adb("kill-server")
        self.pull()
        shutil.rmtree(self.state, ignore_errors=True)
        self.state.mkdir()

    def say(self, name: str, text: str) -> None:
        (self.state / name).write_text(text)

    def unsay(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            (self.state / name).unlink()

    def load(self, images: np.ndarray, first: int = 1) -> None:
        """Load numbered photographs for the camera's next exposures."""
        for k, image in enumerate(images):
            tags = Image.Exif()
            sub = tags.get_ifd(0x8769)
            sub[0x829A], sub[0x8827] = 0.01, 100
            sub[0x9003], sub[0x9291] = "2000:01:01 00:00:00", "999"
            path = self.state / "photographs" / f"{first + k:05d}.jpg"
            Image.fromarray(stamp(image, first + k)).save(path, "JPEG", quality=92, exif=tags)

    def exposures(self) -> dict[int, float]:
        """Return {number: s UTC} of the true exposures."""
        lines = (self.state / "exposures").read_text().splitlines()
        return {int(n): float(t) for n, t in (line.split() for line in lines)}
