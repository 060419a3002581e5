"""Alerts to a program of the user.

    outputs:
      - name: alarm
        driver: alert_exec
        command: [/usr/local/bin/alarm, --loud]    # a list: no shell reads it
        when:                                      # as in docs/how-to/alerts.md
          - {drift: c, px: 0.5}
          - {no_result: 30}
        device: thermocald                         # the name of results that have none
        timeout_s: 10

The program gets the alert as JSON on its standard input, and `THERMOCALD_STATE` (out, in),
`THERMOCALD_CONDITION`, `THERMOCALD_DEVICE`, `THERMOCALD_TEXT` in its environment. What it prints is
not kept. After `timeout_s` it is killed with all that it started. One that fails is tried again
three times, then the alert is dropped, which is logged.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceError,
    DeviceNotFound,
    DeviceTimeout,
)
from thermocald_drivers import support
from thermocald_drivers.alert import AlertOutput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock
    from thermocald_drivers.alert_conditions import Alert

__all__ = ["ExecAlert"]

_TRIES = 3

log = logging.getLogger(__name__)


class ExecAlert(AlertOutput):
    """Runs a program for each alert."""

    def __init__(
        self,
        *,
        clock: Clock,
        command: Sequence[str],
        when: Sequence[Mapping[str, Any]],
        device: str = "thermocald",
        timeout_s: float = 10.0,
    ) -> None:
        self.clock = clock
        if not isinstance(command, list) or not command:
            raise ConfigurationError("command: must be a list: the program, then its arguments")
        self.command = [support.text("command", part) for part in command]
        self.where = self.command[0]
        self.watch(when, device, timeout_s)
        self._failed = 0

    def reach(self) -> None:
        if shutil.which(self.command[0]) is None:
            raise DeviceNotFound(f"{self.where}: there is no such program that may be run")

    def deliver(self, alert: Alert) -> None:
        try:
            self._run(alert)
        except DeviceError as error:
            self._failed += 1
            if self._failed < _TRIES:
                raise
            log.error("%s; the alert is dropped after %d tries", error, _TRIES)
        self._failed = 0

    def _run(self, alert: Alert) -> None:
        told = {
            "THERMOCALD_STATE": alert.state,
            "THERMOCALD_CONDITION": alert.condition,
            "THERMOCALD_DEVICE": alert.device,
            "THERMOCALD_TEXT": alert.text,
        }
        try:
            child = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **told},
                start_new_session=True,
            )
        except OSError as error:
            raise support.fault(error, self.where, seen=True) from error
        try:
            child.communicate(json.dumps(alert.document()).encode(), self.timeout_s)
        except subprocess.TimeoutExpired as error:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.communicate()
            raise DeviceTimeout(f"{self.where}: not done in {self.timeout_s:g} s") from error
        if child.returncode:
            raise BadReading(f"{self.where}: ended with exit status {child.returncode}")
