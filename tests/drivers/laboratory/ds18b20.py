"""A sensor in a sysfs tree; unplugging makes its folder vanish, as w1_therm does."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

from tests.drivers.fakes.sysfs import Sysfs, w1_slave
from tests.drivers.laboratory.bench import Bench

ROM = "28-000000bfe244"


@contextmanager
def thermometer(tmp_path, monkeypatch):
    tree = Sysfs(tmp_path)
    folder = tree.w1(ROM, w1_slave(21.5)).parent
    yield Bench(
        {"sensors": {"temperature": ROM}, "sysfs": str(tmp_path)},
        unplug=lambda: shutil.rmtree(folder),
        plug=lambda: tree.w1(ROM, w1_slave(21.5625)),
    )
