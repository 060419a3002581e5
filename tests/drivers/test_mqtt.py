"""MQTT with a broker on loopback, and each of its faults."""

from __future__ import annotations

import json
import re
import ssl
import time

import pytest
from thermocald_drivers.mqtt import discovery_messages, node_of

from tests.drivers.fakes.certificate import own_context
from tests.drivers.fakes.mqtt_broker import Broker
from thermocald.errors import DeviceDenied, DeviceGone, DeviceTimeout
from thermocald.hal import SystemClock, open_device

RESULT = {"device": "rpi/1", "state": "steady", "status": "ok", "temperature": 31.25, "c": 3.041}


@pytest.fixture
def broker():
    broker = Broker()
    yield broker
    broker.close()


def output(broker, **options):
    options = {"host": "127.0.0.1", "port": broker.port, "timeout_s": 0.5, **options}
    return open_device("output", "mqtt", options, SystemClock())


def topics(broker):
    return [topic for topic, _, _ in broker.messages]


def test_a_result_arrives_and_is_announced(broker):
    with output(broker) as device:
        device.emit(RESULT | {"sigma0": float("nan")})
        device.emit(RESULT)
    topic = "thermocald/rpi_1-a6a219/result"
    results = [json.loads(p) for t, p, _ in broker.messages if t == topic]
    assert results == [RESULT | {"sigma0": None}, RESULT]
    announced = [t for t in topics(broker) if t.startswith("homeassistant/")]
    assert len(announced) == 11 == len(set(announced))
    configuration = json.loads({t: p for t, p, _ in broker.messages}[announced[0]])
    assert configuration["state_topic"] == "thermocald/rpi_1-a6a219/result"
    assert configuration["unit_of_measurement"] == "°C"
    sent = {t: json.loads(p) for t, p, _ in broker.messages if t in announced}
    drift = next(m for t, m in sent.items() if "drift_x0_px" in t)
    assert (drift["unit_of_measurement"], drift["suggested_display_precision"]) == ("px", 2)
    # the last will is at `thermocald`: the device is available only together with it
    assert {a["topic"] for a in drift["availability"]} == {
        "thermocald/rpi_1-a6a219/available", "thermocald/thermocald/available"
    }  # fmt: skip
    available = [p for t, p, _ in broker.messages if t == "thermocald/rpi_1-a6a219/available"]
    assert available == [b"online", b"offline"]


def test_without_discovery(broker):
    with output(broker, discovery=None) as device:
        device.emit(RESULT)
    assert not [t for t in topics(broker) if t.startswith("homeassistant/")]


def test_username_and_password_file(broker, tmp_path):
    (tmp_path / "password").write_text("swordfish\n")
    with output(broker, username="me", password_file=str(tmp_path / "password")):
        pass
    assert broker.credentials == ("me", "swordfish")


@pytest.mark.parametrize(
    ("knobs", "error", "message"),
    [
        ({"refuse": 5}, DeviceDenied, "check username"),
        ({"refuse": 3}, DeviceGone, "Server unavailable"),  # it only starts: asked again
        ({"answer_connect": False}, DeviceTimeout, "no answer"),
    ],
)
def test_a_broker_that_lets_nobody_in(broker, knobs, error, message):
    vars(broker).update(knobs)
    with pytest.raises(error, match=message):
        output(broker).open()


def test_a_certificate_is_not_yet_valid_until_the_clock_is_set(broker, monkeypatch):
    """A Raspberry Pi without a battery boots before the certificate's time."""
    error = ssl.SSLCertVerificationError(1, "certificate verify failed")
    error.verify_code, error.verify_message = 9, "certificate is not yet valid"

    def refuse(*_, **__):
        raise error

    monkeypatch.setattr("paho.mqtt.client.Client.connect", refuse)
    with pytest.raises(DeviceGone, match="not yet valid"):
        output(broker, tls=True).open()
    error.verify_code = 10
    with pytest.raises(DeviceDenied, match="check ca"):
        output(broker, tls=True).open()


def test_a_broker_that_stops_to_acknowledge(broker):
    with output(broker) as device:
        device.emit(RESULT)
        broker.acknowledge = False
        begin = time.monotonic()
        with pytest.raises(DeviceTimeout, match="acknowledgement"):
            device.emit(RESULT)
        assert time.monotonic() - begin < 1.0
        broker.acknowledge = True


def test_a_line_that_breaks_leaves_the_will(broker):
    device = output(broker)
    device.open()
    device.emit(RESULT)
    broker.close()
    deadline = time.monotonic() + 2
    while device.connected and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(DeviceGone):
        device.emit(RESULT)
    device.close()
    assert broker.messages[-1] == ("thermocald/thermocald/available", b"offline", True)


# paho leaves the socket of a refused handshake to the garbage collector, which warns
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_tls(tmp_path):
    ca, context = own_context(tmp_path)
    broker = Broker(context=context)
    try:
        with output(broker, ca=str(ca), timeout_s=5) as device:
            device.emit(RESULT)
        assert "thermocald/rpi_1-a6a219/result" in topics(broker)
        with pytest.raises(DeviceDenied, match="not trusted"):
            output(broker, tls=True, timeout_s=5).open()
    finally:
        broker.close()


@pytest.mark.parametrize(
    ("one", "other"),
    [("cam.1", "cam_1"), ("a/b", "a_b"), ("a b", "a_b"), ("ä", "ö"), ("a+", "a#"), ("a.b", "a_b.")],
)
def test_two_devices_never_share_a_topic(one, other):
    topics = [{*discovery_messages("homeassistant", "t", name, "s")} for name in (one, other)]
    assert not topics[0] & topics[1]
    assert node_of(one) != node_of(other)
    assert re.fullmatch("[A-Za-z0-9_-]+", node_of(one))
