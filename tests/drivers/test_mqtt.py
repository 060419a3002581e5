"""MQTT with a broker on loopback: each row of docs/how-to/laboratory.md's table for outputs."""

from __future__ import annotations

import json
import socket
import time

import pytest

from tests.drivers.fakes.mqtt_broker import Broker
from thermocald.errors import ConfigurationError, DeviceDenied, DeviceGone, DeviceTimeout
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
    results = [json.loads(p) for t, p, _ in broker.messages if t == "thermocald/rpi_1/result"]
    assert results == [RESULT | {"sigma0": None}, RESULT]
    announced = [t for t in topics(broker) if t.startswith("homeassistant/")]
    assert len(announced) == 8 == len(set(announced))
    configuration = json.loads({t: p for t, p, _ in broker.messages}[announced[0]])
    assert configuration["state_topic"] == "thermocald/rpi_1/result"
    assert configuration["unit_of_measurement"] == "°C"
    available = [p for t, p, _ in broker.messages if t == "thermocald/rpi_1/available"]
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


def test_no_broker():
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    options = {"host": "127.0.0.1", "port": port, "timeout_s": 0.5}
    with pytest.raises(DeviceGone, match="cannot connect"):
        open_device("output", "mqtt", options, SystemClock()).open()


def test_a_wrong_password(broker):
    broker.refuse = 5
    with pytest.raises(DeviceDenied, match="check username"):
        output(broker).open()


def test_a_broker_that_hangs_at_the_beginning(broker):
    broker.answer_connect = False
    with pytest.raises(DeviceTimeout):
        output(broker).open()


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
    while device._client.is_connected() and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(DeviceGone):
        device.emit(RESULT)
    device.close()
    assert broker.messages[-1] == ("thermocald/thermocald/available", b"offline", True)


def test_a_password_needs_a_name():
    with pytest.raises(ConfigurationError, match="username"):
        open_device("output", "mqtt", {"host": "x", "password_file": "y"}, SystemClock())
