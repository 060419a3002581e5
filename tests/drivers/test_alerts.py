"""Alerts: one out, one in; delivered by program, web, mail and MQTT, also after an outage."""

from __future__ import annotations

import json
import math
import re
import time
from contextlib import ExitStack, closing

import pytest

from tests.drivers.fakes.alert_servers import MailServer, WebServer
from tests.drivers.fakes.certificate import own_context
from tests.drivers.fakes.mqtt_broker import Broker
from thermocald import errors
from thermocald.hal import SystemClock, VirtualClock, open_device

WHEN = [{"drift": "c", "px": 0.5}]


def results(series, **fixed):
    """Return results of which the columns have the values of `series`, {column: values}."""
    ((name, values),) = series.items()
    common = {"device": "cam", "status": "ok", **fixed}
    return [
        {**common, "epoch": k, "frame_time": 1.6e9 + 10 * k, name: value}
        for k, value in enumerate(values)
    ]


def output(driver, **options):
    return open_device("output", f"alert_{driver}", {"when": WHEN, **options}, VirtualClock())


NAN = math.nan
PX = {"drift": "c", "px": 0.5}
DRIFTS = [0.1, 0.49, 0.51, 0.48, 0.52, NAN, 0.41, 0.39, 0.45, -0.6]
HOT = {"temperature": "temperature", "above_c": 60, "below_c": -10}
LENS = {"sd_c": 1e-5, "pixel_pitch": 0.001}
# (condition, results, [(epoch, state)])
CHANGES = {
    # 0.48 and 0.41 are below the threshold but not clearly back
    "a drift": (PX, results({"drift_c_px": DRIFTS}), [(2, "out"), (7, "in"), (9, "out")]),
    "in standard deviations": (
        {"drift": "x0", "sds": 5}, results({"drift_x0_px": [0.3, 0.6]}, sd_drift_x0_px=0.1),
        [(1, "out")]),
    "from a value": (
        {"drift": "c", "px": 0.1, "from_mm": 3.04}, results({"c": [3.04, 3.0412]}, **LENS),
        [(1, "out")]),
    "a temperature": (
        HOT, results({"temperature": [20, 61, 59.5, 58, -11, -9.5, -8]}),
        [(1, "out"), (3, "in"), (4, "out"), (6, "in")]),
    "no result": (
        {"no_result": 3}, results({"status": ["ok", "bad", "bad", "bad", "bad", "ok"]}),
        [(3, "out"), (5, "in")]),
    "a full disk": ({"free_disk_gb": 1e6}, results({"c": [3.0]}), [(0, "out")]),
    "an empty disk": ({"free_disk_gb": 1e-6}, results({"c": [3.0]}), []),
    "lost": (
        {"lost": 1}, results({"lost": [0, 0, 1, 1, 4, 4]}),
        [(2, "out"), (3, "in"), (4, "out"), (5, "in")]),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_a_change_is_told_once(case):
    when, given, expected = CHANGES[case]
    device = output("exec", command=["true"], when=[when])
    alerts = [alert for one in given for alert in device.changes(one, "cam")]
    assert [(alert.epoch, alert.state) for alert in alerts] == expected
    if case == "a full disk":  # it is back at a tenth more
        assert device._conditions[0].measure({}, 0, 0).back == pytest.approx(1e5)
    if case == "lost":
        assert (alerts[2].text[-20:], alerts[2].threshold) == ("not stored (limit 1)", 1)


def test_a_condition_that_is_never_compared_is_a_warning(tmp_path):
    """Of a channel that is spelt wrongly, or a folder that is not there, no alert ever came."""
    when = [{"temperature": "housng", "above_c": 60}, {"temperature": "housing", "above_c": 60},
            {"free_disk_gb": 1e-6, "path": str(tmp_path / "away")}, PX]  # fmt: skip
    device = output("exec", command=["true"], when=when)
    for one in results({"drift_c_px": [NAN] * 10 + [0.1] * 10}, housing=20.0):
        assert device.warnings() == []
        device.changes(one, "cam")
    assert [text.split(": ")[1] for text in device.warnings()] == ["housng", "free_disk"]


OUT, IN = results({"drift_c_px": [0.8, 0.1]})


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "hook"
    path.touch(0o755)
    return path


def test_a_program_that_hangs_is_killed(script):
    script.write_text("#!/bin/sh\nsleep 60\n")
    with output("exec", command=[str(script)], timeout_s=0.3) as device:
        begin = time.monotonic()
        for _ in range(2):  # tried again, although the result is the same
            with pytest.raises(errors.DeviceTimeout):
                device.emit(OUT)
        assert time.monotonic() - begin < 10
        assert not device.warnings()
        device.emit(OUT)  # dropped after three tries
        assert "not finished in 0.3 s; the alert is dropped" in device.warnings()[0]
        script.write_text("#!/bin/sh\n")
        device.emit(IN)
        assert not device.warnings()


def test_a_program_gets_it_without_a_shell_and_a_few_variables_only(script, tmp_path, monkeypatch):
    monkeypatch.setenv("DATABASE_PASSWORD", "SECRET")
    monkeypatch.setenv("LANG", "C.UTF-8")
    log, told = tmp_path / "log", tmp_path / "told"
    program = f'#!/bin/sh\nenv > {log}\necho "$1 $THERMOCALD_STATE" >> {told}\ncat >> {told}'
    script.write_text(program)
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


@pytest.fixture
def start():
    """class → its server on loopback, which is closed after the test."""
    with ExitStack() as stack:
        yield lambda server, **options: stack.enter_context(closing(server(**options)))


SECRET = "SECRET"


@pytest.fixture
def hook(start, tmp_path):
    """A web server, and the output to it; its address and token are secrets."""
    server = start(WebServer)
    (tmp_path / "token").write_text(f"{SECRET}\n")
    url = f"http://127.0.0.1:{server.port}/{SECRET}?key={SECRET}"
    return server, output("webhook", url=url, token_file=str(tmp_path / "token"), timeout_s=1.0)


def test_a_webhook_and_an_outage(hook, tmp_path):
    server, device = hook
    server.answer = 503
    with device, pytest.raises(errors.DeviceError, match="503"):
        device.emit(OUT)
    server.answer = 204
    with device:  # as the daemon does before it tries again
        device.emit(IN)
    (path, headers, kept), (_, _, back) = server.posts[1:]
    assert (path, headers["Authorization"]) == (f"/{SECRET}?key={SECRET}", f"Bearer {SECRET}")
    assert (kept["state"], kept["condition"], kept["epoch"]) == ("out", "drift_c_px", 0)
    assert back["state"] == "in"
    for token in ("two\nlines", "naïve", "a\x00b"):
        (tmp_path / "token").write_text(token)
        with pytest.raises(errors.ConfigurationError, match="is not one line") as wrong:
            device.open()
        assert token not in str(wrong.value)


@pytest.mark.parametrize("answer", [500, 403, 404, 302, None])
def test_a_secret_is_never_quoted(answer, hook, caplog):
    """Neither of the address nor of the token, whatever the server or library answers."""
    server, device = hook
    with device:
        server.answer = answer or 204
        if answer is None:
            server.close()
        denied = answer in (403, 404)
        with pytest.raises(errors.DeviceDenied if denied else errors.DeviceError) as error:
            device.emit(OUT)
    assert SECRET not in f"{error.value} {caplog.text} {dict(device.identity())} {device.where}"
    assert error.value.__cause__ is None  # a log with its causes would quote the library


def test_a_webhook_with_tls_and_a_redirection_into_this_network(start, tmp_path, monkeypatch):
    ca, context = own_context(tmp_path)
    server, inner = start(WebServer, context=context), start(WebServer)
    options = {"url": f"https://127.0.0.1:{server.port}/SECRET", "timeout_s": 5.0}
    with output("webhook", **options) as device:
        with pytest.raises(errors.DeviceError, match="not trusted") as error:
            device.emit(OUT)
        assert "SECRET" not in str(error.value)
    monkeypatch.setenv("SSL_CERT_FILE", str(ca))
    with output("webhook", **options) as device:  # from Python 3.12 on it reads them when built
        device.emit(OUT)
        assert [post[2]["state"] for post in server.posts] == ["out"]
        server.answer, server.location = 302, f"http://127.0.0.1:{inner.port}/meta-data"
        with pytest.raises(errors.DeviceError, match="302"):
            device.emit(IN)
    assert inner.posts == []


def test_a_letter_by_starttls(start, tmp_path):
    ca, context = own_context(tmp_path)
    server = start(MailServer, context=context)
    (tmp_path / "password").write_text("swordfish\n")
    options = {"host": "127.0.0.1", "port": server.port, "sender": "pi@example.org",
               "recipients": ["me@example.org"], "username": "pi",
               "password_file": str(tmp_path / "password")}  # fmt: skip
    with output("mail", **options, ca=str(ca)) as device:
        device.emit(OUT)
    (letter,) = server.letters
    assert "Subject: [thermocald] alert: cam: c is 0.8 px from the start" in letter
    assert [secure for _, secure in server.logins] == [True] * len(server.logins) != []
    for answer, error in (("454 later", errors.DeviceGone), ("535 no", errors.DeviceDenied)):
        server.login_answer = answer
        with pytest.raises(error, match="password"):
            device.open()
    for security, message in (("starttls", "certificate|CERTIFICATE"), ("tls", "mail server")):
        with pytest.raises(errors.DeviceError, match=message) as failed:
            output("mail", **options, security=security).open()
        assert "swordfish" not in str(failed.value)


def test_mqtt_retains_what_is_out(start):
    broker = start(Broker)
    channels = ["a/b", "lens #2", "#", "+"]  # none may become a level or a wildcard of a topic
    when = [*WHEN, *({"temperature": name, "above_c": 60} for name in channels)]
    options = {"host": "127.0.0.1", "port": broker.port, "when": when, "timeout_s": 2}
    with open_device("output", "alert_mqtt", options, SystemClock()) as device:
        device.emit(OUT | dict.fromkeys(channels, 61.0))
    topics = {message[0] for message in broker.messages if "/alert/" in message[0]}
    assert len(topics) == 5
    assert all(re.fullmatch(r"thermocald/cam/alert/[\w-]+", topic) for topic in topics)
    (config, announced, _), (topic, state, retained) = broker.messages[:2]
    assert config.startswith("homeassistant/binary_sensor/")
    assert topic == json.loads(announced)["state_topic"] == "thermocald/cam/alert/drift_c_px"
    assert (json.loads(state)["state"], retained) == ("out", True)
