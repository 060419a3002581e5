"""The ioctls of one camera; unplugging takes the node away and fails them with ENODEV."""

from __future__ import annotations

import errno
from contextlib import contextmanager
from types import SimpleNamespace

import linuxpy.ioctl

from tests.drivers.fakes.v4l2_kernel import FakeCamera
from tests.drivers.laboratory.bench import Bench
from thermocald.hal import SystemClock


@contextmanager
def camera(tmp_path, monkeypatch):
    kernel = FakeCamera(tmp_path / "video0")
    monkeypatch.setattr(linuxpy.ioctl, "fcntl", SimpleNamespace(ioctl=kernel.ioctl))
    away = tmp_path / "away"

    def unplug():
        kernel.path.rename(away)
        kernel.errors = dict.fromkeys(("DQBUF", "STREAMOFF", "G_CTRL"), errno.ENODEV)

    def plug():
        away.rename(kernel.path)
        kernel.errors = {}

    options = {"device": str(kernel.path), "width": 64, "height": 48, "pixel_format": "GREY"}
    yield Bench({**options, "timeout_s": 0.5}, unplug, plug, SystemClock())
