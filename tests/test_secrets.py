"""No password of an address reaches a log, a status, an event or a message."""

from __future__ import annotations

import json
import logging
import os
import stat
import subprocess
import sys
import time
from urllib.parse import quote, quote_plus

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.commands import call, finish
from tests.daemon.conftest import make_recording
from thermocald import addresses
from thermocald.acquisition.device_loop import Link
from thermocald.addresses import CleanFormatter, hide_secrets, without_secrets
from thermocald.errors import ConfigurationError, DeviceDenied, DeviceGone
from thermocald.hal import Device, DriverOptions, SystemClock

SECRET = "hunter2"
ADDRESSES = [
    text.format(SECRET)
    for text in (
        "http://user:{}@example.org/hook", "https://{}@example.org",
        "http://user:{}/x@example.org:80/hook",  # where a parser finds an invalid port
        "postgresql:/owner:{}@db.example/thermocald", "mqtt+ssl://a:{}@broker:8883",
        "postgresql://db.example/thermocald?user=a&password={}", "//user:{}@example.org/x",
        "https://example.org/hook?token={}&x=1", "example.org/?access_token={}",
        "example.org with PGPASSWORD={}", "example.org, password='{} and more'",
        "host=db.example sslpassword={} dbname=x", "example.org, Authorization: Bearer {}",
        "example.org {{'api-key': '{0}', 'pwd': \"{0}\"}}", 'example.org {{"password": "{}"}}',
        "example.org, {{'Authorization': 'Basic {}=='}}", "user:{}@example.org:5432",
        "(user:{}@[::1]:5432) broker",
    )
]  # fmt: skip
KEYS = ("password", "passwort", "access-key", "X-Api-Key", "secret")
SHORT_KEYS = ("MQTT_PASSWORD", "Pwd", "AccountKey", "psk", "jwt", "MY_SECRET_KEY", "client-key",
              "session_id", "signature", "bearer")  # fmt: skip
FREE = [
    text.format(SECRET)
    for text in (
        *(f"{key}: {{}}, user: a" for key in KEYS),
        *(f"Server=x;{key}={{}};Path=/" for key in SHORT_KEYS),
        # of a password in free text
        'secret: "{}', "password=x {}; connection refused", "(password=two {} words)",
        r"password=a\ {} host=x", "password = {} host=x", "b'password={}'", "password == '{}'",
        "{{'password': b'{}'}}", r'password="a\"{}" x', r"password='a\'{}' x", "password: '''{}'''",
        'token "{}" was refused', "password is '{}'", "wrong password {}",
        "curl --password {0} --token={0}", "password -> {}", ':password=>"{}"', "password%3D{}",
        "<password>{}</password>", "the wifi password is {}",
        "password%3A%20{}", "{{'passwords': ['a', '{}']}}",
        "credentials=('u', '{}')", 'tokens: ("{}", "b")', 'password: "a\n{}" x',
        "password:\n  {}\nx: 1",
        # of an address
        "http://user%3A{}%40example.org/x", "http://user:{}%40example.org/x",
        "https://example.org/?next=http%3A%2F%2Fu%3A{}%40h%2Fx", "mqtt://:{}@broker",
        "https://example.org/#access_token={}&x=1", "https://example.org/?sig={} answers 500",
        "error:amqp://a:b:{}@broker", "redis://{}@broker:99999/x",
        "https://a.example/x?X-Amz-Signature={}&x=1", "https://hooks.slack.com/services/T0/B0/{}",
        "https://api.telegram.org/bot123456:{}/sendMessage",
        "https://discord.com/api/webhooks/123/{}: refused",
        "https://a.webhook.office.com/webhookb2/{}@b/x",
        # of a header or a file
        'Proxy-Authorization: Digest username="a", response="{}"', "'Authorization': 'Token {}'",
        "curl -H 'Authorization: Bearer {}' failed", "Bearer {}", "'Cookie': 'a=1; s={}'",
        "Set-Cookie: a=1; session={}; Path=/",
        "-----BEGIN PRIVATE KEY-----{}-----END PRIVATE KEY-----",
    )
]  # fmt: skip


@pytest.mark.parametrize("text", FREE)
def test_a_secret_that_nobody_knows_is_left_out_of_a_free_text(text):
    assert SECRET not in without_secrets(text)
    assert SECRET not in without_secrets(f"camera a: {text}")


@given(st.text(min_size=4, max_size=30), st.data())
@settings(max_examples=60, deadline=None)
def test_a_known_secret_is_left_out_wherever_and_however_it_is_written(value, data):
    """Its ends would show if a part of it remained."""
    value = f"bait{value}tiab"
    addresses._known.clear()
    hide_secrets({"broker": [{"password": value}]})
    writings = [
        value, repr(value), ascii(value), json.dumps(value), repr(repr(value)), str([value]),
        json.dumps([{"a": value}], ensure_ascii=False), json.dumps(json.dumps(value)),
        repr(value.encode()), quote(value), quote_plus(value), " ".join(value.split()),
    ]  # fmt: skip
    frames = ["{}", "a: {}: b", "x{}y", "refused '{}'", "http://h/{}?a", "[{}]", "\n{}\n", "k={}&b"]
    for text in writings:
        said = without_secrets(data.draw(st.sampled_from(frames)).format(text))
        assert "bait" not in said
        assert "tiab" not in said


@pytest.mark.parametrize("value", ["hunter2 and more", "a1", {"a": 1234567}, ["hunter3-xy"]])
def test_a_secret_option_is_not_quoted_where_it_is_wrong(value):
    class Options(DriverOptions):
        api_key: float
        password_file: str = "x"

    with pytest.raises(ConfigurationError, match="api_key: is a secret; ") as told:
        Options.read({"api_key": value})
    assert str(value) not in str(told.value)
    with pytest.raises(ConfigurationError, match="password_file: is 5"):
        Options.read({"api_key": 3.0, "password_file": 5})


@pytest.mark.slow
def test_hostile_texts_take_no_time():
    parts = ["password='", "token=a ", "http://", "a:b", "%2F%40:", "a\\", "://@", "Bearer a", "y",
             "y."]  # fmt: skip
    begin = time.process_time()
    for part in parts:
        without_secrets(part * 20000)
    assert time.process_time() - begin < 30.0  # 2 s


@pytest.mark.parametrize("address", ADDRESSES)
def test_an_address_is_cleaned_and_still_says_where(address):
    said = without_secrets(f"cannot reach {address}: refused")
    assert SECRET not in said
    assert "example" in said or "broker" in said
    assert said.endswith("refused")


NO_SECRETS = [
    "https://medium.com/@user", "http://host:8080/@x", "a@b.example", "ratio 3:/1@2", "",
    "dashboard.token: must be 16 characters or more", "password: unknown key",
    "epoch 3: 12 targets @ 21 °C", "mailto:a@b.example", "at 12:30 bob@x wrote",
    "outputs[0].password: unknown; neither a key of an output", "unexpected token '('",
    "token_file /x/y: is not one line of text", "session: M1", "pass 3 of 4: 12 targets",
    "username and password_file: one needs the other", "pass: band of the filter",
    "security: a password is not sent without TLS", "secret: 16 bytes are needed",
    "the token has 5 characters; at least 16 are needed", "signature: 3 values (°C)",
    "token > 5 of 7", "3 secrets are hidden", "a cookie is set", "https://discord.com/channels/1/2",
    'password authentication failed for user "owner"',
]  # fmt: skip


@pytest.mark.parametrize("text", NO_SECRETS)
def test_what_is_no_secret_stays(text):
    assert without_secrets(text) == text


WHEN = {"when": [{"no_result": 3}]}
HOOKS = [
    *ADDRESSES[:3], f"http://a:{SECRET}/hook", f"ftp://user:{SECRET}@example.org",
    f"http://[{SECRET}/hook", f"http://example.org/{SECRET} hook", f"http://example.org/{SECRET}é",
    SECRET, f"http://:{SECRET}@:80", f"https://u:{SECRET}@h:99999",
]  # fmt: skip
SERVERS = [
    f"mysql://u:{SECRET}@h/db", f"postgresql://u:{SECRET}@h/db", f"postgresql://u:{SECRET}/x@h",
    f"postgres://h/db?password={SECRET}", f"http://{SECRET}@h",
]  # fmt: skip
CONFIGURED = [
    *(("url: ", "outputs", [{"name": "h", "driver": "alert_webhook", "url": url, **WHEN}])
      for url in HOOKS),
    *(("forward.to", "forward", {"to": to}) for to in SERVERS),
]  # fmt: skip


@pytest.mark.parametrize(("key", "section", "stanza"), CONFIGURED)
def test_a_wrong_address_in_the_configuration_is_not_quoted(tmp_path, key, section, stanza):
    document = {"thermometers": [{"name": "t", "driver": "mock"}], section: stanza}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    done = call("check", tmp_path / "config.yaml", folder=tmp_path)
    assert done.returncode == 2
    assert key in done.stderr
    assert SECRET not in done.stderr + done.stdout


@pytest.mark.parametrize("end", ["@h:port/db", "@h/db?x"])
def test_a_wrong_address_of_a_server_is_not_quoted_with_it(end):
    done = call("study", f"postgresql://u:{SECRET}{end}")
    assert done.returncode == 2
    assert SECRET not in done.stderr


@pytest.mark.parametrize("kind", [DeviceGone, DeviceDenied, ValueError])
def test_what_a_library_says_is_clean_in_status_event_and_log(kind):
    quoted = kind(f"nonnumeric port: '{SECRET}' in http://user:{SECRET}@example.org")

    class Quoting(Device):
        def open(self) -> None:
            raise quoted

    events, clock = [], SystemClock()
    link = Link(
        "output", "hook", Quoting(clock=clock), clock, on_event=lambda *event: events.append(event)
    )
    link.do(lambda: True)
    assert link.why
    assert f"user:{SECRET}" not in f"{link.why} {events}"
    record = logging.LogRecord("x", 40, "", 1, "failed", (), (kind, quoted, None))
    shown = CleanFormatter("%(message)s").format(record)
    assert "nonnumeric port" in shown
    assert f"user:{SECRET}" not in shown


WRITING = {
    "testfield": "testfield import --chessboard 9x6 --square 30 --out new/t.csv",
    "a recording": "simulate --preset rpi-v2.1-heating --out new/M",
    "a store, by the daemon": "run --recording {recording} --fast --store t.db",
    "a store": "replay {recording} --store t.db --json new/t.json",
    "a report": "study {recording} --sets 200 --report new/r.html --json new/r.json",
    "models": "fit {recording} -o new/c.yaml --code new/c",
    "Parquet": "export {recording} --format parquet -o new/t.parquet",
}
QUICK = {(0o777, "a store"), (0o000, "a recording"), (0o000, "Parquet")}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("recording") / "small", 16)


@pytest.mark.parametrize(
    ("umask", "what"),
    [
        *((umask, "testfield") for umask in (0o000, 0o777, 0o277, 0o002, 0o077)),
        *(pytest.param(umask, what, marks=() if (umask, what) in QUICK else pytest.mark.slow)
          for umask in (0o000, 0o777) for what in WRITING if what != "testfield"),
    ],
)  # fmt: skip
def test_no_file_is_everybody_s_or_nobody_s(tmp_path, recording, umask, what):
    command = WRITING[what].format(recording=recording).split()
    program = [sys.executable, "-m", "thermocald"]
    before = os.umask(umask)
    try:
        if command[0] == "run":  # in a process of its own, with threads and signals
            subprocess.run([*program, *command], cwd=tmp_path, check=True, capture_output=True)
        else:
            finish(*command, folder=tmp_path)
    finally:
        os.umask(before)
    found = list(tmp_path.rglob("*"))
    assert found
    for path in found:
        mode = stat.S_IMODE(path.stat().st_mode)
        assert not mode & 0o002
        assert mode & (0o700 if path.is_dir() else 0o600) in (0o700, 0o600)
        assert umask != 0o077 or not mode & 0o077
