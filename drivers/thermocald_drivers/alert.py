"""What the alert drivers share: results are watched, changes wait until they are delivered.

Each alert driver is an output of its own, with its own thread and bounded queue in the daemon, so
that one that cannot be reached delays neither a tick nor the others. What could not be delivered
is kept, in order, over closing and opening; the newest `MOST_WAITING` of them.
"""

from __future__ import annotations

import logging
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError, DeviceGone
from thermocald.hal import Output
from thermocald_drivers import support
from thermocald_drivers.alert_conditions import Alert, Watch, condition_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["AlertOutput", "secret"]

MOST_WAITING = 100

log = logging.getLogger(__name__)


class AlertOutput(Output):
    """An output that delivers alerts; a driver says how in `deliver`, and where in `where`."""

    where: str

    def watch(self, when: Sequence[Mapping[str, Any]], device: str, timeout_s: float) -> None:
        """Take the options that all alert drivers have; raises ConfigurationError."""
        if not isinstance(when, list) or not when:
            raise ConfigurationError("when: must be a list of conditions")
        conditions = [condition_of(stanza) for stanza in when]
        names = [condition.name for condition in conditions]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ConfigurationError(f"when: {min(twice)} is given twice")
        self.device = support.text("device", device)
        self.timeout_s = support.number("timeout_s", timeout_s, 0.05, 60, "s")
        self._watch = Watch(conditions)
        self._waiting: deque[Alert] = deque(maxlen=MOST_WAITING)
        self._opened = False

    def open(self) -> None:
        self.reach()
        self._opened = True

    def close(self) -> None:
        self._opened = False

    def emit(self, result: Mapping[str, Any]) -> None:
        if not self._opened:
            raise DeviceGone(f"{self.where}: not open")
        for alert in self._watch.changes(result, str(result.get("device", self.device))):
            log.warning("%s", alert.text, extra={"event": "alert"})
            self._waiting.append(alert)
        while self._waiting:
            self.deliver(self._waiting[0])
            self._waiting.popleft()

    def reach(self) -> None:
        """Look whether alerts can be delivered; a DeviceError if not."""
        raise NotImplementedError

    def deliver(self, alert: Alert) -> None:
        """Deliver one alert, within `timeout_s`; a DeviceError if that failed."""
        raise NotImplementedError


def secret(name: str, path: str | None) -> str | None:
    """The text of a file that holds a password or a token, None without a file."""
    if path is None:
        return None
    try:
        return Path(path).read_text().strip()
    except OSError as error:
        raise support.fault(error, f"{name} {path}", seen=False) from error
