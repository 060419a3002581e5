"""A server on loopback; unplugging stops it."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.alert_servers import WebServer
from tests.drivers.laboratory.bench import Bench


@contextmanager
def output(tmp_path, monkeypatch):
    servers = [WebServer()]
    port = servers[0].port
    yield Bench(
        {"url": f"http://127.0.0.1:{port}/hook",
         "when": [{"no_result": 2}], "timeout_s": 2.0},
        unplug=servers[-1].close,
        plug=lambda: servers.append(WebServer(port)),
    )  # fmt: skip
    servers[-1].close()
