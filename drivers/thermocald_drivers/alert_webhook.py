"""Alerts as a POST of JSON to a web address.

    outputs:
      - name: hook
        driver: alert_webhook
        url: https://example.org/hooks/thermocald
        token_file: /etc/thermocald/hook-token     # sent as `Authorization: Bearer …`; or none
        when:                                      # as in docs/how-to/alerts.md
          - {drift: x0, sds: 5}
          - {free_disk_gb: 1, path: /var/lib/thermocald}
        device: thermocald                         # the name of results that have none
        timeout_s: 5

Delivered is what the server answers with 2xx. 401, 403 and 404 end the output; everything else is
tried again. Redirections are not followed: a POST would become a GET on the way.
"""

from __future__ import annotations

import http.client
import json
import socket
import urllib.error
import urllib.parse
import urllib.request
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, ConfigurationError, DeviceDenied, DeviceGone
from thermocald_drivers import support
from thermocald_drivers.alert import AlertOutput, secret

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock
    from thermocald_drivers.alert_conditions import Alert

__all__ = ["WebhookAlert"]


class _NoRedirection(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


class WebhookAlert(AlertOutput):
    """One POST for each alert."""

    def __init__(
        self,
        *,
        clock: Clock,
        url: str,
        when: Sequence[Mapping[str, Any]],
        token_file: str | None = None,
        device: str = "thermocald",
        timeout_s: float = 5.0,
    ) -> None:
        self.clock = clock
        self.url = support.text("url", url)
        try:
            parts = urllib.parse.urlsplit(self.url)
            port = parts.port or (443 if parts.scheme == "https" else 80)
        except ValueError as error:
            raise ConfigurationError(f"url: {error}") from error
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ConfigurationError(f"url: {self.url!r} does not begin with https:// or http://")
        self._address = (parts.hostname, port)
        self.token_file = token_file
        # The path may hold a key: messages name the host alone.
        self.where = f"webhook at {parts.hostname}:{port}"
        self.watch(when, device, timeout_s)
        self._open = urllib.request.build_opener(_NoRedirection).open

    def reach(self) -> None:
        secret("token_file", self.token_file)
        try:
            socket.create_connection(self._address, self.timeout_s).close()
        except OSError as error:
            raise DeviceGone(f"{self.where}: cannot connect ({error})") from error

    def deliver(self, alert: Alert) -> None:
        headers = {"Content-Type": "application/json", "User-Agent": "thermocald"}
        if token := secret("token_file", self.token_file):
            headers["Authorization"] = f"Bearer {token}"
        request = urllib.request.Request(
            self.url, json.dumps(alert.document()).encode(), headers, method="POST"
        )
        try:
            with self._open(request, timeout=self.timeout_s):
                pass
        except urllib.error.HTTPError as error:
            error.close()
            if error.code in (401, 403, 404):
                raise DeviceDenied(
                    f"{self.where}: answers {error.code}; check url and token_file"
                ) from error
            raise BadReading(f"{self.where}: answers {error.code}") from error
        except (OSError, http.client.HTTPException) as error:
            raise DeviceGone(f"{self.where}: {error}") from error
