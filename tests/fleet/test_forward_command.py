"""`thermocald forward` with the daemon's configuration, as its unit starts it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.commands import answer as run
from tests.commands import succeed
from tests.fleet.conftest import count
from thermocald.config import load_config
from thermocald.errors import ConfigurationError
from thermocald.store.database.store import Store

CONFIG = """
store: {path: k.db}
frames: {folder: frames}
thermometers: [{name: air, driver: mock}]
forward:
  to: %s
  station: gauge7
  frames: events
"""


@pytest.fixture
def configured(tmp_path, head, field, make_epoch, make_result):
    """A folder with a store of three epochs; the second has no result and a frame."""
    with Store.open(tmp_path / "k.db", "append") as store:
        series = store.create_series(head, field)
        for number in (1, 2, 3):
            frame = Path(f"rpi/{number}.jpg")
            (tmp_path / "frames/rpi").mkdir(parents=True, exist_ok=True)
            (tmp_path / "frames" / frame).write_bytes(b"\xff\xd8" * 50)
            result = make_result(number, "no_targets" if number == 2 else "ok")
            store.append(series, replace(make_epoch(number), frame=frame), result)

    def write(to):
        path = tmp_path / "config.yaml"
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
    assert [count(server, t) for t in ("epoch", "frame", "station")] == [3, 1, 1]
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
