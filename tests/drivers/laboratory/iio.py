"""A chip in a sysfs tree; unplugging removes its folder."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.laboratory.bench import Bench

FILES = {"in_temp_raw": "1344", "in_temp_scale": "15.625"}


@contextmanager
def thermometer(tmp_path, monkeypatch):
    tree = Sysfs(tmp_path)
    folder = tree.iio(0, "tmp117", **FILES)
    yield Bench(
        {"chip": "tmp117", "sysfs": str(tmp_path)},
        unplug=lambda: shutil.rmtree(folder),
        plug=lambda: tree.iio(0, "tmp117", **FILES),
    )
