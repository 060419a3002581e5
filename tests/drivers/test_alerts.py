"""Alerts: one out, one in; delivered by program, web, mail and MQTT, also after an outage."""

from __future__ import annotations

import json
import math
import re
import time

import pytest

from tests.drivers.fakes.alert_servers import MailServer, WebServer
from tests.drivers.fakes.certificate import own_context
from tests.drivers.fakes.mqtt_broker import Broker
from thermocald.errors import (
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceTimeout,
)
from thermocald.hal import SystemClock, VirtualClock, open_device

WHEN = [{"drift": "c", "px": 0.5}]


def result(epoch, **values):
    return {"device": "cam", "series": "watch", "epoch": epoch, "status": "ok",
            "frame_time": 1.6e9 + 10 * epoch, **values}  # fmt: skip


def output(driver, **options):
    return open_device("output", f"alert_{driver}", {"when": WHEN, **options}, VirtualClock())


def alerts(when, results):
    """Return all changes of results by one condition."""
    device = output("exec", command=["true"], when=[when])
    return [alert for one in results for alert in device.changes(one, "cam")]


def told(when, results):
    """Return (epoch, state) of all changes."""
    return [(alert.epoch, alert.state) for alert in alerts(when, results)]


def test_a_drift_is_out_once_and_in_once():
    drifts = [0.1, 0.49, 0.51, 0.48, 0.52, math.nan, 0.41, 0.39, 0.45, -0.6]
    results = [result(i, drift_c_px=d) for i, d in enumerate(drifts)]
    # 0.48 and 0.41 are below the threshold but not clearly back
    assert told({"drift": "c", "px": 0.5}, results) == [(2, "out"), (7, "in"), (9, "out")]


def test_a_drift_in_standard_deviations_and_from_a_reference():
    results = [result(i, drift_x0_px=d, sd_drift_x0_px=0.1) for i, d in enumerate([0.3, 0.6])]
    assert told({"drift": "x0", "sds": 5}, results) == [(1, "out")]
    results = [result(i, c=c, sd_c=1e-5, pixel_pitch=0.001) for i, c in enumerate([3.04, 3.0412])]
    assert told({"drift": "c", "px": 0.1, "from_mm": 3.04}, results) == [(1, "out")]


def test_temperature_disk_and_epochs_without_result_or_lost(tmp_path):
    results = [result(i, temperature=t) for i, t in enumerate([20, 61, 59.5, 58, -11, -9.5, -8])]
    when = {"temperature": "temperature", "above_c": 60, "below_c": -10}
    assert told(when, results) == [(1, "out"), (3, "in"), (4, "out"), (6, "in")]
    words = ["ok", "bad", "bad", "bad", "bad", "ok"]
    results = [result(i, status=word) for i, word in enumerate(words)]
    assert told({"no_result": 3}, results) == [(3, "out"), (5, "in")]
    assert told({"free_disk_gb": 1e6, "path": str(tmp_path)}, results) == [(0, "out")]
    assert told({"free_disk_gb": 1e-6, "path": str(tmp_path)}, results) == []
    results = [result(i, lost=lost) for i, lost in enumerate([0, 0, 1, 1, 4, 4])]
    assert told({"lost": 1}, results) == [(2, "out"), (3, "in"), (4, "out"), (5, "in")]
    words = "cam: 3 epochs were taken but not stored (limit 1)"
    assert alerts({"lost": 1}, results)[2].text == words


def test_a_condition_that_is_never_compared_is_a_warning(tmp_path):
    """Of a channel that is spelt wrongly, or a folder that is not there, no alert ever came."""
    when = [{"temperature": "housng", "above_c": 60}, {"temperature": "housing", "above_c": 60},
            {"free_disk_gb": 1e-6, "path": str(tmp_path / "away")}, *WHEN]  # fmt: skip
    device = output("exec", command=["true"], when=when)
    for k in range(20):
        assert device.warnings() == []
        drift = {"drift_c_px": 0.1 if k >= 10 else math.nan}
        device.changes(result(k, housing=20.0, **drift), "cam")
    assert [text.split(": ")[1] for text in device.warnings()] == ["housng", "free_disk"]


OUT, IN = result(1, drift_c_px=0.8), result(2, drift_c_px=0.1)


def test_a_program_that_hangs_is_killed(tmp_path):
    script = tmp_path / "hook"
    script.write_text("#!/bin/sh\nsleep 60\n")
    script.chmod(0o755)
    with output("exec", command=[str(script)], timeout_s=0.3) as device:
        begin = time.monotonic()
        with pytest.raises(DeviceTimeout):
            device.emit(OUT)
        assert time.monotonic() - begin < 10
        with pytest.raises(DeviceTimeout):  # tried again, although the result is the same
            device.emit(OUT)
        assert not device.warnings()
        device.emit(OUT)  # dropped after three tries
        assert "not finished in 0.3 s; the alert is dropped" in device.warnings()[0]
        device.emit(OUT)
        script.write_text("#!/bin/sh\n")
        device.emit(IN)
        assert not device.warnings()


@pytest.fixture
def start():
    """class → its server on loopback, which is closed after the test."""
    started = []

    def make(server, **options):
        started.append(server(**options))
        return started[-1]

    yield make
    for server in started:
        server.close()


def test_a_webhook_and_an_outage(start, tmp_path):
    server = start(WebServer)
    (tmp_path / "token").write_text("swordfish\n")
    url = f"http://127.0.0.1:{server.port}/hook?a=1"
    device = output("webhook", url=url, token_file=str(tmp_path / "token"))
    device.open()
    server.answer = 503
    with pytest.raises(DeviceError, match="503"):
        device.emit(OUT)
    device.close()  # as the daemon does before it tries again
    server.answer = 204
    device.open()
    device.emit(IN)
    device.close()
    _, kept, back = server.posts
    assert kept[2]["state"] == "out"
    assert back[2]["state"] == "in"
    assert kept[0] == "/hook?a=1"
    assert kept[1]["Authorization"] == "Bearer swordfish"
    assert kept[2]["condition"] == "drift_c_px"
    assert kept[2]["epoch"] == 1
    server.answer = 403
    device.open()
    with pytest.raises(DeviceDenied):
        device.emit(result(3, drift_c_px=0.9))
    device.close()


def test_a_letter_by_starttls(start, tmp_path):
    ca, context = own_context(tmp_path)
    server = start(MailServer, context=context)
    (tmp_path / "password").write_text("swordfish\n")
    options = {"host": "127.0.0.1", "port": server.port, "sender": "pi@example.org",
               "recipients": ["me@example.org"], "username": "pi", "ca": str(ca),
               "password_file": str(tmp_path / "password")}  # fmt: skip
    with output("mail", **options) as device:
        device.emit(OUT)
    (letter,) = server.letters
    assert "Subject: [thermocald] alert: cam: c is 0.8 px from the start" in letter
    assert all(secure for _, secure in server.logins)
    assert server.logins
    for answer, error in (("454 later", DeviceGone), ("535 no", DeviceDenied)):
        server.login_answer = answer
        with pytest.raises(error, match="password"):
            device.open()
    del options["ca"]
    for security, message in (("starttls", "certificate|CERTIFICATE"), ("tls", "mail server")):
        device = output("mail", **options, security=security)
        with pytest.raises(DeviceError, match=message) as failed:
            device.open()
        assert "swordfish" not in str(failed.value)


def test_mqtt_retains_what_is_out(start):
    broker = start(Broker)
    channels = ["a/b", "lens #2", "#", "+"]  # none may become a level or a wildcard of a topic
    when = [*WHEN, *({"temperature": name, "above_c": 60} for name in channels)]
    options = {"host": "127.0.0.1", "port": broker.port, "when": when, "timeout_s": 2}
    with open_device("output", "alert_mqtt", options, SystemClock()) as device:
        device.emit(OUT | dict.fromkeys(channels, 61.0))
    broker.close()
    topics = [message[0] for message in broker.messages if "/alert/" in message[0]]
    assert len(set(topics)) == 5
    assert all(re.fullmatch(r"thermocald/cam/alert/[\w-]+", topic) for topic in topics)
    configuration, state = broker.messages[:2]
    assert configuration[0].startswith("homeassistant/binary_sensor/")
    assert state[0] == "thermocald/cam/alert/drift_c_px"
    assert json.loads(configuration[1])["state_topic"] == state[0]
    assert json.loads(state[1])["state"] == "out"
    assert state[2]


@pytest.mark.parametrize(
    "url",
    ["http://user:SECRET@example.org/hook", "https://SECRET@example.org/", "http://a:SECRET/hook",
     "ftp://user:SECRET@example.org", "http://[SECRET/hook", "http://example.org/SECRET hook",
     "http://example.org/SECRET\u00e9", "SECRET", "http://:SECRET@:80", "https://u:SECRET@h:99999"],
)  # fmt: skip
def test_an_address_with_a_secret_is_refused_and_not_quoted(url):
    with pytest.raises(ConfigurationError, match="url") as error:
        output("webhook", url=url)
    assert "SECRET" not in f"{error.value} {error.value!r}"


@pytest.mark.parametrize("answer", [500, 404, 302, None])
def test_a_secret_is_never_quoted(answer, start, tmp_path, caplog):
    """Neither of the address nor of the token, whatever the server or library answers."""
    server = start(WebServer)
    (tmp_path / "token").write_text("SECRET\n")
    url = f"http://127.0.0.1:{server.port}/SECRET?key=SECRET"
    device = output("webhook", url=url, token_file=str(tmp_path / "token"), timeout_s=1.0)
    device.open()
    server.answer = answer or 204
    if answer is None:
        server.close()
    with pytest.raises(DeviceError) as error:
        device.emit(OUT)
    device.close()
    assert "SECRET" not in f"{error.value} {caplog.text} {dict(device.identity())} {device.where}"
    assert error.value.__cause__ is None  # a log with its causes would quote the library


@pytest.mark.parametrize("token", ["two\nlines", "naïve", "a\x00b"])
def test_a_token_that_no_header_can_hold(token, tmp_path):
    (tmp_path / "token").write_text(token)
    device = output("webhook", url="http://127.0.0.1:9/", token_file=str(tmp_path / "token"))
    with pytest.raises(ConfigurationError, match="is not one line") as error:
        device.open()
    assert token not in str(error.value)


def test_a_program_gets_it_without_a_shell_and_a_few_variables_only(tmp_path, monkeypatch):
    monkeypatch.setenv("DATABASE_PASSWORD", "SECRET")
    monkeypatch.setenv("LANG", "C.UTF-8")
    script, log, told = tmp_path / "hook", tmp_path / "log", tmp_path / "told"
    script.write_text(
        f'#!/bin/sh\nenv > {log}\necho "$1 $THERMOCALD_STATE" >> {told}\ncat >> {told}'
    )
    script.chmod(0o755)
    with output("exec", command=[str(script), "$HOME;ls"]) as device:
        for one in (OUT, OUT, IN):
            device.emit({**one, "device": "cam\x00era"})
    assert told.read_text().count("$HOME;ls out") == told.read_text().count("$HOME;ls in") == 1
    assert '"value": 0.8' in told.read_text()
    names = {line.partition("=")[0] for line in log.read_text().splitlines()}
    assert "SECRET" not in log.read_text()
    assert {"PATH", "LANG", "THERMOCALD_STATE", "THERMOCALD_TEXT"} <= names
    allowed = {"PATH", "HOME", "LANG", "LC_ALL", "TZ", "PWD", "OLDPWD", "SHLVL", "_"}
    assert all(name in allowed or name.startswith("THERMOCALD_") for name in names)


def test_a_webhook_with_tls_and_a_redirection_into_this_network(start, tmp_path, monkeypatch):
    ca, context = own_context(tmp_path)
    server, inner = start(WebServer, context=context), start(WebServer)
    options = {"url": f"https://127.0.0.1:{server.port}/SECRET", "timeout_s": 5.0}
    with output("webhook", **options) as device:
        with pytest.raises(DeviceError, match="not trusted") as error:
            device.emit(OUT)
        assert "SECRET" not in str(error.value)
    monkeypatch.setenv("SSL_CERT_FILE", str(ca))
    with output("webhook", **options) as device:  # from Python 3.12 on it reads them when built
        device.emit(OUT)
        assert [post[2]["state"] for post in server.posts] == ["out"]
        server.answer, server.location = 302, f"http://127.0.0.1:{inner.port}/meta-data"
        with pytest.raises(DeviceError, match="302"):
            device.emit(IN)
    assert inner.posts == []
