"""A real Dask scheduler with worker processes on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Self

# docs/how-to/fleet.md: idle processes cost less
SETTINGS = """\
distributed:
  worker: {profile: {enabled: false}, memory: {monitor-interval: 1s}}
  admin: {tick: {interval: 500ms}, system-monitor: {interval: 2s, disk: false}}
"""


class DaskCluster:
    """A scheduler in a folder, and workers that a test starts and kills; a context manager."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._known = folder / "scheduler.json"
        self._settings = folder / "dask.yaml"
        self._settings.write_text(SETTINGS)
        self._stack = ExitStack()
        self.scheduler = self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")
        deadline = time.monotonic() + 60
        while not self._known.exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        self.address = json.loads(self._known.read_text())["address"]
        self.workers = [self.start_worker() for _ in range(workers)]

    def start_worker(self) -> subprocess.Popen[bytes]:
        return self._start("dask_worker", "--nthreads", "1", "--no-nanny")

    def replace_worker(self, number: int) -> None:
        """Kill a worker as a power cut does, and start another in its place."""
        self.workers[number].kill()
        self.workers[number].wait()
        self.workers[number] = self.start_worker()

    def _start(self, program: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--scheduler-file",
                   str(self._known), "--no-dashboard", *options]  # fmt: skip
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            # as Dask's own nanny starts workers: sums do not depend on the number of cores
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1",
                 "DASK_CONFIG": str(self._settings)},
        )  # fmt: skip
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
