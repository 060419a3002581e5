"""MQTT with a broker on loopback, and each of its faults."""

from __future__ import annotations

import json
import re
import ssl
from contextlib import closing

import pytest
from thermocald_drivers.mqtt import discovery_messages, node_of

from tests.drivers.fakes.certificate import own_context
from tests.drivers.fakes.mqtt_broker import Broker
from thermocald.errors import DeviceDenied, DeviceGone

DRIVER = ("output", "mqtt")
NODE = "thermocald/rpi_1-a6a219"
RESULT = {"device": "rpi/1", "state": "steady", "status": "ok", "temperature": 31.25, "c": 3.041}


def test_a_result_arrives_and_is_announced(bench, tmp_path):
    (tmp_path / "password").write_text("swordfish\n")
    with bench.device(username="me", password_file=str(tmp_path / "password")) as device:
        device.emit(RESULT | {"sigma0": float("nan")})
        device.emit(RESULT)
    assert bench.fake.credentials == ("me", "swordfish")
    by_topic = {}
    for topic, payload, retained in bench.fake.messages:
        by_topic.setdefault(topic, []).append(payload)
        assert retained != topic.endswith("/result")
    sent = [json.loads(payload) for payload in by_topic[f"{NODE}/result"]]
    assert sent == [RESULT | {"sigma0": None}, RESULT]
    assert by_topic[f"{NODE}/available"] == [b"online", b"offline"]
    announced = {t: json.loads(p[0]) for t, p in by_topic.items() if t.startswith("homeassistant/")}
    assert len(announced) == 11
    first = next(iter(announced.values()))
    assert (first["state_topic"], first["unit_of_measurement"]) == (f"{NODE}/result", "°C")
    drift = next(m for t, m in announced.items() if "drift_x0_px" in t)
    assert (drift["unit_of_measurement"], drift["suggested_display_precision"]) == ("px", 2)
    # the last will is at `thermocald`: the device is available only together with it
    topics = {a["topic"] for a in drift["availability"]}
    assert topics == {f"{NODE}/available", "thermocald/thermocald/available"}
    bench.fake.messages.clear()
    with bench.device(discovery=None) as device:
        device.emit(RESULT)
    assert not [t for t, *_ in bench.fake.messages if t.startswith("homeassistant/")]


def test_a_certificate_is_not_yet_valid_until_the_clock_is_set(bench, monkeypatch):
    """A Raspberry Pi without a battery boots before the certificate's time."""
    error = ssl.SSLCertVerificationError(1, "certificate verify failed")
    error.verify_code, error.verify_message = 9, "certificate is not yet valid"

    def refuse(*_, **__):
        raise error

    monkeypatch.setattr("paho.mqtt.client.Client.connect", refuse)
    with pytest.raises(DeviceGone, match="not yet valid"):
        bench.device(tls=True).open()
    error.verify_code = 10
    with pytest.raises(DeviceDenied, match="check ca"):
        bench.device(tls=True).open()


def test_a_line_that_breaks_leaves_the_will(bench):
    with bench.device() as device:
        device.emit(RESULT)
        bench.unplug()
    assert bench.fake.messages[-1] == ("thermocald/thermocald/available", b"offline", True)


# paho leaves the socket of a refused handshake to the garbage collector, which warns
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_tls(bench, tmp_path):
    ca, context = own_context(tmp_path)
    with closing(Broker(context=context)) as broker:
        bench.options |= {"port": broker.port, "timeout_s": 5}
        with bench.device(ca=str(ca)) as device:
            device.emit(RESULT)
        assert f"{NODE}/result" in [topic for topic, *_ in broker.messages]
        with pytest.raises(DeviceDenied, match="not trusted"):
            bench.device(tls=True).open()


@pytest.mark.parametrize(
    ("one", "other"),
    [("cam.1", "cam_1"), ("a/b", "a_b"), ("a b", "a_b"), ("ä", "ö"), ("a+", "a#"), ("a.b", "a_b.")],
)
def test_two_devices_never_share_a_topic(one, other):
    topics = [{*discovery_messages("homeassistant", "t", name, "s")} for name in (one, other)]
    assert not topics[0] & topics[1]
    assert node_of(one) != node_of(other)
    assert re.fullmatch("[A-Za-z0-9_-]+", node_of(one))
