"""Debian's MQTT broker with TLS: its retained messages, their topics, and who may connect."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time

import pytest

from tests.drivers.fakes.certificate import own_certificate
from thermocald.hal import SystemClock, open_device

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")
pytestmark = pytest.mark.skipif(MOSQUITTO is None, reason="no mosquitto: apt-get install mosquitto")
paho = pytest.importorskip("paho.mqtt.client")


class Mosquitto:
    """The broker in a separate process on loopback, with TLS and a password."""

    def __init__(self, folder):
        self.ca, key = own_certificate(folder)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        (folder / "password").write_text("sword fish\n")
        (folder / "users").write_text("")
        subprocess.run(
            ["mosquitto_passwd", "-b", folder / "users", "pi", "sword fish"],
            check=True, capture_output=True,
        )  # fmt: skip
        (folder / "mosquitto.conf").write_text(
            f"listener {self.port} 127.0.0.1\ncafile {self.ca}\ncertfile {self.ca}\n"
            f"keyfile {key}\nallow_anonymous false\npassword_file {folder / 'users'}\n"
            "persistence false\nuser root\n"
        )
        self.folder = folder
        self.start()

    def start(self):
        self._process = subprocess.Popen(
            [MOSQUITTO, "-c", self.folder / "mosquitto.conf"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            try:
                socket.create_connection(("127.0.0.1", self.port), 0.2).close()
            except OSError:
                time.sleep(0.05)
            else:
                return
        raise AssertionError("mosquitto does not start")

    def stop(self):
        self._process.terminate()
        self._process.wait(20)

    def options(self, **more):
        return {"host": "127.0.0.1", "port": self.port, "ca": str(self.ca), "username": "pi",
                "password_file": str(self.folder / "password"), "timeout_s": 9, **more}  # fmt: skip

    def retained(self):
        """Return {topic: payload} of the messages that a new client receives."""
        found = {}
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.username_pw_set("pi", "sword fish")
        client.tls_set(str(self.ca))
        client.on_connect = lambda c, *_: c.subscribe("#", qos=1)
        client.on_message = lambda _c, _d, message: found.update({message.topic: message.payload})
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        seen, deadline = -1, time.monotonic() + 10
        while time.monotonic() < deadline and (not found or len(found) != seen):
            seen = len(found)
            time.sleep(0.1)
        client.disconnect()
        client.loop_stop()
        return found


@pytest.fixture
def broker(tmp_path):
    if shutil.which("mosquitto_passwd") is None:
        pytest.skip("no mosquitto_passwd")
    running = Mosquitto(tmp_path)
    yield running
    running.stop()


def mqtt(broker, driver="mqtt", **more):
    return open_device("output", driver, broker.options(**more), SystemClock())


def test_two_cameras_are_two_devices(broker):
    with mqtt(broker) as output:
        for name in ("cam.1", "cam_1"):
            output.emit({"device": name, "status": "ok", "c": 3.04, "temperature": 21.5})
        kept = broker.retained()
    states = {json.loads(payload)["state_topic"] for topic, payload in kept.items()
              if topic.startswith("homeassistant/") and topic.endswith("/c/config")}  # fmt: skip
    identities = [json.loads(payload)["unique_id"] for topic, payload in kept.items()
                  if topic.startswith("homeassistant/")]  # fmt: skip
    assert len(states) == 2
    assert len(identities) == len(set(identities)) == 22
    online = [topic for topic, payload in kept.items() if payload == b"online"]
    assert len(online) == 3  # the two, and the device of the last will
    assert set(broker.retained().values()) & {b"offline"}


def test_an_alert_is_retained_whatever_the_channel_is_called(broker):
    channels = ["temperature", "a/b", "lens #2", "#", "+"]
    when = [{"temperature": channel, "above_c": 60} for channel in channels]
    with mqtt(broker, "alert_mqtt", when=when) as output:
        output.emit({"device": "cam.1", "epoch": 1, "status": "ok"} | dict.fromkeys(channels, 61.0))
    alerts = [json.loads(p) for topic, p in broker.retained().items() if "/alert/" in topic]
    told = sorted((alert["condition"], alert["state"]) for alert in alerts)
    assert told == sorted((channel, "out") for channel in channels)
