"""No password of an address reaches a log, a status, an event or a message."""

from __future__ import annotations

import io
import logging
import os
import stat
import subprocess
import sys

import pytest
import yaml

from tests.commands import call
from thermocald.acquisition.device_loop import Link
from thermocald.addresses import CleanFormatter, without_secrets
from thermocald.errors import ConfigurationError, DeviceDenied, DeviceGone, UsageError
from thermocald.hal import Device, SystemClock, VirtualClock, open_device
from thermocald.store.server.connection import ServerAddress

SECRET = "hunter2"
ADDRESSES = [
    f"http://user:{SECRET}@example.org/hook",
    f"https://{SECRET}@example.org",
    f"http://user:{SECRET}/x@example.org:80/hook",  # where a parser finds a port that is none
    f"postgresql:/owner:{SECRET}@db.example/thermocald",
    f"postgresql://db.example/thermocald?user=a&password={SECRET}",
    f"mqtt+ssl://a:{SECRET}@broker:8883",
    f"https://example.org/hook?token={SECRET}&x=1",
    f"example.org with PGPASSWORD={SECRET}",
    f"example.org, password='{SECRET} and more'",
    f"host=db.example sslpassword={SECRET} dbname=x",
    f"example.org/?access_token={SECRET}",
    f"example.org {{'api-key': '{SECRET}', 'pwd': \"{SECRET}\"}}",
    f'example.org {{"password": "{SECRET}"}}',
    f"example.org, Authorization: Bearer {SECRET}",
    f"example.org, {{'Authorization': 'Basic {SECRET}=='}}",
    f"//user:{SECRET}@example.org/x",
    f"user:{SECRET}@example.org:5432",
    f"(user:{SECRET}@[::1]:5432) broker",
]


@pytest.mark.parametrize("address", ADDRESSES)
def test_an_address_is_cleaned_and_still_says_where(address):
    said = without_secrets(f"cannot reach {address}: refused")
    assert SECRET not in said
    assert "example" in said or "broker" in said
    assert said.endswith("refused")


@pytest.mark.parametrize(
    "text",
    [
        "https://medium.com/@user",
        "http://host:8080/@x",
        "a@b.example",
        "ratio 3:/1@2",
        "",
        "dashboard.token: must be 16 characters or more",
        "password: unknown key",
        "epoch 3: 12 targets @ 21 °C",
        "mailto:a@b.example",
        "at 12:30 bob@x wrote",
    ],
)
def test_what_is_no_secret_stays(text):
    assert without_secrets(text) == text


@pytest.mark.parametrize("address", ADDRESSES[:3])
def test_a_webhook_refuses_a_user_and_quotes_nothing(tmp_path, address):
    options = {"url": address, "when": [{"no_result": 3}]}
    with pytest.raises(ConfigurationError, match="url: ") as told:
        open_device("output", "alert_webhook", options, VirtualClock())
    assert SECRET not in str(told.value)
    document = {
        "thermometers": [{"name": "t", "driver": "mock"}],
        "outputs": [{"name": "hook", "driver": "alert_webhook", **options}],
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    for command in (["check"], ["check", "--probe"], ["run", "--config"]):
        done = call(*command, tmp_path / "config.yaml", folder=tmp_path)
        assert done.returncode == 2
        assert SECRET not in done.stderr + done.stdout


@pytest.mark.parametrize(
    "to",
    [
        f"mysql://u:{SECRET}@h/db", f"postgresql://u:{SECRET}@h/db", f"postgresql://u:{SECRET}/x@h",
        f"postgres://h/db?password={SECRET}", f"http://{SECRET}@h",
    ],
)  # fmt: skip
def test_the_configuration_does_not_quote_it(tmp_path, to):
    document = {"thermometers": [{"name": "t", "driver": "mock"}], "forward": {"to": to}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    done = call("check", tmp_path / "config.yaml")
    assert done.returncode == 2
    assert "forward.to" in done.stderr
    assert SECRET not in done.stderr


@pytest.mark.parametrize(
    "address", [f"postgresql://u:{SECRET}@h:port/db", f"postgresql://u:{SECRET}@h/db?x", "sqlite:x"]
)
def test_a_wrong_address_of_a_server_is_not_quoted_with_it(address):
    with pytest.raises(UsageError) as told:
        ServerAddress.parse(address)
    assert SECRET not in str(told.value)
    assert SECRET not in call("study", address).stderr


def test_a_cursor_knows_the_whole_address_but_not_the_password():
    one = "postgresql://u:hunter2@h:5433/db?sslmode=require&host=/run/a"
    places = {
        ServerAddress.parse(text).place
        for text in (
            one, one.replace("/run/a", "/run/b"), one.replace("/db", "/other"),
            one.replace("u:", "v:"), one.replace("@h", "@g"), one.replace("5433", "5434"),
        )
    }  # fmt: skip
    assert len(places) == 6
    assert ServerAddress.parse(one).place == ServerAddress.parse(one.replace(SECRET, "x")).place
    assert not [place for place in places if SECRET in place]


@pytest.mark.parametrize("kind", [DeviceGone, DeviceDenied, ValueError])
def test_what_a_library_says_is_clean_in_status_event_and_log(caplog, kind):
    class Quoting(Device):
        def open(self) -> None:
            raise kind(f"nonnumeric port: '{SECRET}' in http://user:{SECRET}@example.org")

    events = []
    link = Link(
        "output", "hook", Quoting(clock=SystemClock()), SystemClock(), on_event=events.append
    )
    link.call(lambda: True)
    told = [link.why, *(event.text for event in events)]
    assert told
    assert not [text for text in told if f"user:{SECRET}" in text]
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(CleanFormatter("%(message)s"))
    logging.getLogger("x").addHandler(handler)
    try:
        raise ValueError(f"http://user:{SECRET}@example.org")
    except ValueError:
        logging.getLogger("x").exception("failed")
    logging.getLogger("x").removeHandler(handler)
    assert "Traceback" in stream.getvalue()
    assert f"user:{SECRET}" not in stream.getvalue().splitlines()[-1]


def test_a_program_of_the_user_gets_a_few_named_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("DATABASE_PASSWORD", SECRET)
    script = tmp_path / "alarm"
    script.write_text(f"#!/bin/sh\nenv > {tmp_path}/environment\n")
    script.chmod(0o755)
    options = {"command": [str(script)], "when": [{"no_result": 1}]}
    with open_device("output", "alert_exec", options, SystemClock()) as output:
        output.emit({"device": "cam", "series": "a", "epoch": 1, "status": "failed"})
    names = {
        line.split("=")[0] for line in (tmp_path / "environment").read_text().splitlines() if line
    }
    assert {"THERMOCALD_STATE", "THERMOCALD_TEXT", "PATH"} <= names
    assert "DATABASE_PASSWORD" not in names


@pytest.mark.parametrize("umask", [0o000, 0o777, 0o277, 0o002, 0o077])
def test_no_file_is_everybody_s_or_nobody_s(tmp_path, umask):
    subprocess.run(
        [
            sys.executable, "-m", "thermocald", "testfield", "import", "--chessboard", "9x6",
            "--square", "30", "--out", tmp_path / "new/t.csv",
        ],
        check=True, capture_output=True, umask=umask, env={**os.environ},
    )  # fmt: skip
    for path in (tmp_path / "new", tmp_path / "new/t.csv"):
        mode = stat.S_IMODE(path.stat().st_mode)
        assert not mode & 0o002
        assert mode & 0o600 == 0o600


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp437", "ascii:strict", "utf-16"])
def test_the_encoding_of_the_terminal_is_no_traceback(encoding):
    done = subprocess.run(
        [sys.executable, "-m", "thermocald", "simulate", "--list"], capture_output=True,
        check=False, env={**os.environ, "PYTHONIOENCODING": encoding},
    )  # fmt: skip
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr
    assert len(done.stdout) > 100
