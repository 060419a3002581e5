"""The web page as a child of a daemon that was started by hand; it never ends the daemon.

Under systemd the page is a unit of its own, with its own bound on memory: in the daemon's control
group it could take what the daemon needs.
"""

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


log = logging.getLogger(__name__)

_NOT_SOONER_S = 10.0
_GRACE_S = 3.0
_WRONG_CONFIGURATION = 2  # the exit status of a port in use, or of a token that cannot be used
_REFUSED = "there is no page: its configuration or its port cannot be used (see the line above)"
_PRIVATE = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}


class DashboardProcess:
    """`thermocald dashboard` for a store and a live folder."""

    def __init__(self, store: Path, live: Path) -> None:
        self._store = store.absolute()
        self._live = live.absolute()
        self._child: subprocess.Popen[bytes] | None = None
        self._next_at = 0.0
        self.why = ""  # why there is no page, empty while there is one or none is wanted

    def keep(self, config: DashboardConfig) -> None:
        """See that it runs; it is started at most every 10 s."""
        if self.why == _REFUSED or os.environ.get("INVOCATION_ID"):
            return
        child = self._child
        if (child is not None and child.poll() is None) or time.monotonic() < self._next_at:
            return
        if child is not None and child.returncode == _WRONG_CONFIGURATION:
            self.why = _REFUSED
            log.error("%s; acquisition goes on without it", self.why)
            return
        if child is not None:
            self.why = f"the page ended ({child.returncode}); it is started again"
            log.warning(self.why)
        self._next_at = time.monotonic() + _NOT_SOONER_S
        command = [sys.executable, "-m", "thermocald", "dashboard"]
        command += ["--store", str(self._store), "--live", str(self._live)]
        command += ["--host", config.host, "--port", str(config.port)]
        for name in config.names:
            command += ["--name", name]
        if config.token_file is not None:
            command += ["--token-file", str(config.token_file)]
        environment = {k: v for k, v in os.environ.items() if k not in _PRIVATE}
        try:
            # a group of its own: Ctrl-C ends the daemon, which then ends the page
            self._child = subprocess.Popen(command, env=environment, process_group=0)
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
