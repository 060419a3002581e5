"""A named pipe; unplugging is its reader going away."""

from __future__ import annotations

import os
from contextlib import contextmanager

from tests.drivers.laboratory.bench import Bench


@contextmanager
def output(tmp_path, monkeypatch):
    path = tmp_path / "results.fifo"
    os.mkfifo(path)
    reader = [os.open(path, os.O_RDONLY | os.O_NONBLOCK)]
    yield Bench(
        {"path": str(path), "timeout_s": 0.5},
        unplug=lambda: os.close(reader.pop()),
        plug=lambda: reader.append(os.open(path, os.O_RDONLY | os.O_NONBLOCK)),
    )
    for descriptor in reader:
        os.close(descriptor)
