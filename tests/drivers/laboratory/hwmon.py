"""A chip in a sysfs tree; unplugging removes its folder."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.laboratory.bench import Bench


@contextmanager
def thermometer(tmp_path, monkeypatch):
    tree = Sysfs(tmp_path)
    folder = tree.hwmon(0, "lm75", temp1_input="21062")
    yield Bench(
        {"chip": "lm75", "sysfs": str(tmp_path)},
        unplug=lambda: shutil.rmtree(folder),
        plug=lambda: tree.hwmon(1, "lm75", temp1_input="21125"),
    )
