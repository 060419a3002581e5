"""A server on loopback; unplugging stops it."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.alert_servers import MailServer
from tests.drivers.laboratory.bench import Bench


@contextmanager
def output(tmp_path, monkeypatch):
    servers = [MailServer()]
    port = servers[0].port
    yield Bench(
        {"host": "127.0.0.1", "port": port, "security": "none", "sender": "a@example.org",
         "recipients": ["b@example.org"],
         "when": [{"no_result": 2}], "timeout_s": 2.0},
        unplug=servers[-1].close,
        plug=lambda: servers.append(MailServer(port)),
    )  # fmt: skip
    servers[-1].close()
