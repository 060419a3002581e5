"""A server on loopback; unplugging stops it."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.alert_servers import WebServer
from tests.drivers.laboratory.bench import on_loopback

_on_loopback = on_loopback(WebServer, {"when": [{"no_result": 2}], "timeout_s": 2.0})


@contextmanager
def output(tmp_path, monkeypatch):
    with _on_loopback(tmp_path, monkeypatch) as bench:
        bench.options["url"] = f"http://127.0.0.1:{bench.options.pop('port')}/hook"
        yield bench
