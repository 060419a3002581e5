"""Alerts to a program, to a web address and by e-mail; for MQTT see `mqtt`.

    outputs:
      - name: alarm
        driver: alert_exec
        command: [/usr/local/bin/alarm, --loud]    # a list; no shell is involved
        when:                                      # as in docs/how-to/alerts.md
          - {drift: c, px: 0.5}
          - {no_result: 30}
        device: thermocald                         # for results that name no device
        timeout_s: 10
      - name: hook
        driver: alert_webhook
        url: https://example.org/hooks/thermocald
        token_file: /etc/thermocald/hook-token     # sent as `Authorization: Bearer …`; optional
        when: [{drift: x0, sds: 5}, {free_disk_gb: 1, path: /var/lib/thermocald}]
        timeout_s: 5
      - name: letter
        driver: alert_mail
        host: mail.example.org
        port: 587
        security: starttls                         # tls: from the first byte (port 465); none
        username: thermocald                       # with password_file: /etc/mail-password
        ca: /etc/ssl/own-ca.pem                    # for a server with a private certificate
        sender: thermocald@example.org
        recipients: [me@example.org]
        when: [{temperature: temperature, above_c: 60}]
        timeout_s: 10

alert_exec: the program receives the alert as JSON on its standard input, and `THERMOCALD_STATE`
(out, in), `THERMOCALD_CONDITION`, `THERMOCALD_DEVICE` and `THERMOCALD_TEXT` in its environment. Of
the daemon's environment it receives only PATH, HOME, LANG, LC_ALL and TZ. Its output is discarded.
After `timeout_s` it is killed with all processes it started. After three failures the alert is
dropped, which is logged, and a warning of the status until one is delivered.

alert_webhook: each alert is one POST of JSON. An answer of 2xx means delivered; 401, 403 and 404
stop the output; after any other answer the alert is sent again. Redirections are not followed: they
would turn the POST into a GET and let a foreign server point into this network. A user name or
password in the address is rejected; messages never quote the address, since it may contain a key.

alert_mail: each alert is one e-mail. A password is never sent without TLS; if the server rejects
it, the output stops.
"""

from __future__ import annotations

import http.client
import json
import logging
import os
import shutil
import signal
import smtplib
import socket
import ssl
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from contextlib import suppress
from email.message import EmailMessage
from email.utils import formatdate
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceNotFound,
    DeviceTimeout,
)
from thermocald_drivers import support
from thermocald_drivers.alert import AlertOptions, AlertOutput, secret

if TYPE_CHECKING:
    from thermocald_drivers.alert import Alert

TRIES = 3
PASSED_ON = ("PATH", "HOME", "LANG", "LC_ALL", "TZ")
Address = Annotated[
    str, support.like(r"[^@\s,;<>]+@[^@\s,;<>]+", "is not an e-mail address, name@host")
]

log = logging.getLogger(__name__)


class ExecAlert(AlertOutput):
    """An output that runs a program for each alert."""

    class Options(AlertOptions):
        command: Annotated[list[support.Text], Field(min_length=1)]
        timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 10.0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.where: str = self.options.command[0]
        self._failed = 0
        self._dropped = ""  # why the last alert was not delivered, else empty

    def warnings(self) -> list[str]:
        return [*super().warnings(), *([self._dropped] if self._dropped else [])]

    def open(self) -> None:
        if shutil.which(self.where) is None:
            raise DeviceNotFound(f"{self.where}: does not exist or is not executable")
        self.handle = True

    def deliver(self, alert: Alert) -> None:
        dropped = ""
        try:
            self._run(alert)
        except DeviceError as error:
            self._failed += 1
            if self._failed < TRIES:
                raise
            dropped = f"{error}; the alert is dropped after {TRIES} tries"
            log.error(dropped)
        self._failed, self._dropped = 0, dropped

    def _run(self, alert: Alert) -> None:
        variables = {
            f"THERMOCALD_{name.upper()}": getattr(alert, name).replace("\0", "")
            for name in ("state", "condition", "device", "text")
        }
        passed_on = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        try:
            child = subprocess.Popen(
                self.options.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**passed_on, **variables},
                start_new_session=True,
            )
        except OSError as error:
            raise support.fault(error, self.where, seen=True) from error
        try:
            child.communicate(json.dumps(alert.document()).encode(), self.options.timeout_s)
        except subprocess.TimeoutExpired as error:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.communicate()
            raise DeviceTimeout(f"{self.where}: not finished in {self.timeout_s:g} s") from error
        if child.returncode:
            raise BadReading(f"{self.where}: ended with exit status {child.returncode}")


class _NoRedirection(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


class WebhookAlert(AlertOutput):
    """An output that sends one POST for each alert."""

    class Options(AlertOptions):
        url: support.Text
        token_file: support.Text | None = None

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        url = self.options.url
        try:  # no message quotes the address: it may hold a key
            parts = urllib.parse.urlsplit(url)
            port = parts.port or (443 if parts.scheme == "https" else 80)
        except ValueError:
            raise ConfigurationError("url: is not an address; check its port") from None
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ConfigurationError("url: does not begin with https:// or http:// and a host")
        if "@" in parts.netloc:
            raise ConfigurationError(
                "url: contains a user name or password; use token_file, or a key in the path"
            )
        if not url.isascii() or not url.isprintable() or " " in url:
            raise ConfigurationError("url: contains characters that must be written as %XX")
        self._address = (parts.hostname, port)
        self.where = f"webhook at {parts.hostname}:{port}"
        self._open = urllib.request.build_opener(_NoRedirection).open

    def open(self) -> None:
        self._token()
        try:
            socket.create_connection(self._address, self.options.timeout_s).close()
        except OSError as error:
            raise DeviceGone(f"{self.where}: cannot connect ({support.reason(error)})") from None
        self.handle = True

    def deliver(self, alert: Alert) -> None:
        headers = {"Content-Type": "application/json", "User-Agent": "thermocald"}
        if token := self._token():
            headers["Authorization"] = f"Bearer {token}"
        document = json.dumps(alert.document()).encode()
        request = urllib.request.Request(self.options.url, document, headers, method="POST")
        try:
            with self._open(request, timeout=self.options.timeout_s):
                return
        except urllib.error.HTTPError as error:
            error.close()
            code = error.code
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise DeviceGone(f"{self.where}: {support.reason(error)}") from None
        if code in (401, 403, 404):
            raise DeviceDenied(f"{self.where}: answers {code}; check url and token_file")
        raise BadReading(f"{self.where}: answers {code}")

    def _token(self) -> str | None:
        token = secret("token_file", self.options.token_file)
        if token is not None and not (token.isascii() and token.isprintable()):
            raise ConfigurationError(
                f"token_file {self.options.token_file}: is not one line of text"
            )
        return token


class MailAlert(AlertOutput):
    """An output that sends one e-mail for each alert."""

    class Options(AlertOptions):
        host: support.Text
        port: support.Port = 587
        security: Literal["starttls", "tls", "none"] = "starttls"
        username: support.Text | None = None
        password_file: support.Text | None = None
        ca: support.Text | None = None
        sender: Address
        recipients: Annotated[list[Address], Field(min_length=1)]
        timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 10.0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        if bool(o.username) != bool(o.password_file):
            raise ConfigurationError("username and password_file: one needs the other")
        if o.username and o.security == "none":
            raise ConfigurationError("security: a password is not sent without TLS")
        self.where = f"mail server {o.host}:{o.port}"

    def open(self) -> None:
        self._send(None)
        self.handle = True

    def deliver(self, alert: Alert) -> None:
        letter = EmailMessage()
        letter["From"] = self.options.sender
        letter["To"] = ", ".join(self.options.recipients)
        letter["Date"] = formatdate()
        mark = "alert" if alert.state == "out" else "over"
        letter["Subject"] = f"[thermocald] {mark}: {' '.join(alert.text.split())}"
        details = json.dumps(alert.document(), indent=1, ensure_ascii=False)
        letter.set_content(f"{alert.text}\n\n{details}\n")
        self._send(letter)

    def _send(self, letter: EmailMessage | None) -> None:
        """Send a letter; without one, only check that the server accepts the connection."""
        o = self.options
        password = secret("password_file", o.password_file)
        try:
            context = ssl.create_default_context(cafile=o.ca)
            tls = partial(smtplib.SMTP_SSL, context=context)
            connect: Any = tls if o.security == "tls" else smtplib.SMTP
            with connect(o.host, o.port, timeout=o.timeout_s) as server:
                if o.security == "starttls":
                    server.starttls(context=context)
                if o.username and password is not None:
                    server.login(o.username, password)
                if letter is not None:
                    server.send_message(letter)
        except smtplib.SMTPAuthenticationError as error:
            if error.smtp_code < 500:
                raise DeviceGone(f"{self.where}: cannot check the password now") from None
            raise DeviceDenied(
                f"{self.where}: rejects the password; check username and password_file"
            ) from None
        except (smtplib.SMTPRecipientsRefused, smtplib.SMTPSenderRefused):
            raise BadReading(f"{self.where}: rejects the sender or a recipient") from None
        except smtplib.SMTPServerDisconnected:
            raise DeviceGone(f"{self.where}: no answer, or it closed the connection") from None
        except (OSError, ValueError, smtplib.SMTPException) as error:
            raise DeviceGone(f"{self.where}: {support.reason(error)}") from None
