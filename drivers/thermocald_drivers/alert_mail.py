"""Alerts by e-mail.

    outputs:
      - name: letter
        driver: alert_mail
        host: mail.example.org
        port: 587
        security: starttls                         # tls: from the first byte (port 465); none
        username: thermocald                       # and password_file: /etc/mail-password
        ca: /etc/ssl/own-ca.pem                    # of a server with a certificate of its own
        sender: thermocald@example.org
        recipients: [me@example.org]
        when:                                      # as in docs/how-to/alerts.md
          - {temperature: temperature, above_c: 60}
        device: thermocald                         # the name of results that have none
        timeout_s: 10

A password is never sent without TLS. A password that the server refuses ends the output.
"""

from __future__ import annotations

import json
import smtplib
import ssl
from email.message import EmailMessage
from email.utils import formatdate
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, ConfigurationError, DeviceDenied, DeviceGone
from thermocald_drivers import support
from thermocald_drivers.alert import AlertOutput, secret

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock
    from thermocald_drivers.alert_conditions import Alert

__all__ = ["MailAlert"]


class MailAlert(AlertOutput):
    """One letter for each alert."""

    def __init__(
        self,
        *,
        clock: Clock,
        host: str,
        sender: str,
        recipients: Sequence[str],
        when: Sequence[Mapping[str, Any]],
        port: int = 587,
        security: str = "starttls",
        username: str | None = None,
        password_file: str | None = None,
        ca: str | None = None,
        device: str = "thermocald",
        timeout_s: float = 10.0,
    ) -> None:
        self.clock = clock
        self.host = support.text("host", host)
        self.port = int(support.number("port", port, 1, 65535, whole=True))
        self.security = support.choice("security", security, ("starttls", "tls", "none"))
        self.username, self.password_file, self.ca = username, password_file, ca
        if bool(username) != bool(password_file):
            raise ConfigurationError("username and password_file: one needs the other")
        if username and self.security == "none":
            raise ConfigurationError("security: a password is not sent without TLS")
        self.sender = _address("sender", sender)
        if not isinstance(recipients, list) or not recipients:
            raise ConfigurationError("recipients: must be a list of addresses")
        self.recipients = [_address("recipients", one) for one in recipients]
        self.where = f"mail server {self.host}:{self.port}"
        self.watch(when, device, timeout_s)

    def reach(self) -> None:
        self._send(None)

    def deliver(self, alert: Alert) -> None:
        letter = EmailMessage()
        letter["From"] = self.sender
        letter["To"] = ", ".join(self.recipients)
        letter["Date"] = formatdate()
        mark = "alert" if alert.state == "out" else "over"
        letter["Subject"] = f"[thermocald] {mark}: {' '.join(alert.text.split())}"
        details = json.dumps(alert.document(), indent=1, ensure_ascii=False)
        letter.set_content(f"{alert.text}\n\n{details}\n")
        self._send(letter)

    def _send(self, letter: EmailMessage | None) -> None:
        """Send a letter; without one, only see whether the server would take it."""
        try:
            with self._connect() as server:
                if self.security == "starttls":
                    server.starttls(context=self._context())
                password = secret("password_file", self.password_file)
                if self.username and password is not None:
                    server.login(self.username, password)
                if letter is not None:
                    server.send_message(letter)
        except smtplib.SMTPAuthenticationError as error:
            raise DeviceDenied(
                f"{self.where}: refuses the password; check username and password_file"
            ) from error
        except (smtplib.SMTPRecipientsRefused, smtplib.SMTPSenderRefused) as error:
            raise BadReading(f"{self.where}: refuses the addresses ({error})") from error
        except (OSError, smtplib.SMTPException) as error:
            raise DeviceGone(f"{self.where}: {error}") from error

    def _connect(self) -> smtplib.SMTP:
        if self.security == "tls":
            return smtplib.SMTP_SSL(
                self.host, self.port, timeout=self.timeout_s, context=self._context()
            )
        return smtplib.SMTP(self.host, self.port, timeout=self.timeout_s)

    def _context(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=self.ca)


def _address(name: str, value: Any) -> str:
    address = support.text(name, value)
    if "@" not in address or any(c in address for c in ",;<>\r\n "):
        raise ConfigurationError(f"{name}: {value!r} is not an e-mail address")
    return address
