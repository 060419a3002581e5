"""The web page in a process of its own, started again when it ends: it never ends the daemon."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.config import DashboardConfig

__all__ = ["DashboardProcess"]

log = logging.getLogger(__name__)

_NOT_SOONER_S = 10.0
_GRACE_S = 3.0
_PRIVATE = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}


class DashboardProcess:
    """`thermocald dashboard` for a store and a live folder."""

    def __init__(self, store: Path, live: Path) -> None:
        self._store = store.absolute()
        self._live = live.absolute()
        self._child: subprocess.Popen[bytes] | None = None
        self._next_at = 0.0

    def keep(self, config: DashboardConfig) -> None:
        """See that it runs; it is started at most every 10 s."""
        child = self._child
        if (child is not None and child.poll() is None) or time.monotonic() < self._next_at:
            return
        if child is not None:
            log.warning("the dashboard ended (%s); it is started again", child.returncode)
        self._next_at = time.monotonic() + _NOT_SOONER_S
        command = [sys.executable, "-m", "thermocald", "dashboard"]
        command += ["--store", str(self._store), "--live", str(self._live)]
        command += ["--host", config.host, "--port", str(config.port)]
        if config.token_file is not None:
            command += ["--token-file", str(config.token_file)]
        environment = {k: v for k, v in os.environ.items() if k not in _PRIVATE}
        try:
            self._child = subprocess.Popen(command, env=environment)
        except OSError as error:
            log.error("the dashboard cannot be started: %s", error)

    def stop(self) -> None:
        """End it."""
        child = self._child
        if child is None or child.poll() is not None:
            return
        child.terminate()
        try:
            child.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
