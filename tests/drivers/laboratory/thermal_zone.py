"""A zone in a sysfs tree; unplugging removes its folder."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.laboratory.bench import Bench


@contextmanager
def thermometer(tmp_path, monkeypatch):
    tree = Sysfs(tmp_path)
    folder = tree.zone(0, "cpu-thermal", "48312")
    yield Bench(
        {"zone": "cpu-thermal", "sysfs": str(tmp_path)},
        unplug=lambda: shutil.rmtree(folder),
        plug=lambda: tree.zone(2, "cpu-thermal", "47000"),
    )
