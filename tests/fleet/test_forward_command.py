"""`thermocald forward` with the daemon's configuration, as its unit starts it."""

from __future__ import annotations

import pytest

from tests.commands import answer as run
from tests.commands import succeed
from tests.fleet.conftest import count
from thermocald.config import load_config
from thermocald.errors import ConfigurationError

CONFIG = """
store: {path: small.db}
frames: {folder: frames}
thermometers: [{name: air, driver: mock}]
forward:
  to: %s
  station: gauge7
  frames: events
"""


@pytest.fixture
def configured(station):
    """address → the configuration of a station that sends its store there."""

    def write(to):
        path = station[0].with_name("config.yaml")
        path.write_text(CONFIG % to)
        return path

    return write


def test_everything_comes_from_the_configuration(configured, server, tmp_path, monkeypatch):
    passwords = tmp_path / "pgpass"
    passwords.write_text("127.0.0.1:*:*:owner:secret\n")
    passwords.chmod(0o600)
    monkeypatch.setenv("PGPASSFILE", str(passwords))
    config = configured(server.address(user="owner", name="thermocald"))
    result = succeed("forward", "--config", config, "--once", "--json", "-")
    assert [count(server, t) for t in ("epoch", "frame", "station")] == [20, 2, 1]
    assert "secret" not in result.output


def test_nothing_configured_is_no_error(configured):
    result = succeed("forward", "--config", configured("null"))
    assert "nothing is sent" in result.stderr


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("postgresql://a:b@host/db", r"forward\.to: holds a password; .*pgpass"),
        ("postgresql://host/db?password=b", r"forward\.to: holds a password; .*pgpass"),
        ("mysql://host/db", r"forward\.to"),
    ],
)
def test_a_password_or_another_address_is_refused(configured, to, words):
    with pytest.raises(ConfigurationError, match=words):
        load_config(configured(to))


def test_what_is_missing_is_said():
    assert "give STORE and --to" in str(run("forward").exception)
