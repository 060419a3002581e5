"""`thermocald forward` with the daemon's configuration, as its unit starts it."""

from __future__ import annotations

import pytest

from tests.commands import succeed
from tests.fleet.conftest import count
from thermocald.errors import StoreError, UsageError

CONFIG = """
store: {path: small.db}
frames: {folder: frames}
thermometers: [{name: air, driver: mock}]
forward: {to: %s, station: gauge7, frames: events}
"""


def test_everything_comes_from_the_configuration(station, server, tmp_path, monkeypatch):
    passwords = tmp_path / "pgpass"
    passwords.write_text("127.0.0.1:*:*:owner:secret\n")
    passwords.chmod(0o600)
    monkeypatch.setenv("PGPASSFILE", str(passwords))
    config = station[0].with_name("config.yaml")
    config.write_text(CONFIG % "null")
    assert "nothing is sent" in succeed("forward", "--config", config).stderr
    config.write_text(CONFIG % server.address(user="owner", name="thermocald"))
    result = succeed("forward", "--config", config, "--once", "--json", "-")
    assert [count(server, t) for t in ("epoch", "frame", "station")] == [20, 2, 1]
    assert "secret" not in result.output


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(UsageError, match="give STORE and --to"):
        succeed("forward")
    with pytest.raises(StoreError):
        succeed("forward", tmp_path / "none.db", "--to", "postgresql://h/d", "--once")
