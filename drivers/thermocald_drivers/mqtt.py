"""Results to an MQTT broker, announced to Home Assistant.

    outputs:
      - name: home
        driver: mqtt
        host: broker.local
        port: 1883
        username: thermocald                 # and password_file: /etc/thermocald/mqtt-password
        topic: thermocald                    # thermocald/<device>/result and …/available
        discovery: homeassistant             # null: none
        device: thermocald                   # the name of results that have none
        timeout_s: 5

Each result is one JSON object with QoS 1. `emit` waits for the broker's acknowledgement, at most
`timeout_s`, so that a loss is noticed. The last will sets the device to `offline`.
Source: paho-mqtt 2 (callback API 2), Home Assistant "MQTT discovery".
"""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError, DeviceDenied, DeviceGone, DeviceTimeout
from thermocald.hal import Output
from thermocald_drivers import support
from thermocald_drivers.jsonl import encode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock

__all__ = ["MqttOutput", "discovery_messages"]

SENSORS: Mapping[str, tuple[str, str | None, str | None]] = {
    # key of the result: (name, unit, Home Assistant's device class)
    "temperature": ("Temperature", "°C", "temperature"),
    "c": ("Principal distance", "mm", None),
    "x0": ("Principal point x0", "mm", None),
    "y0": ("Principal point y0", "mm", None),
    "sigma0": ("Sigma 0", None, None),
    "n_observations": ("Observations", None, None),
    "state": ("State", None, None),
    "status": ("Status", None, None),
}


def discovery_messages(prefix: str, topic: str, device: str) -> dict[str, dict[str, Any]]:
    """{topic: configuration} with which Home Assistant shows the device's sensors."""
    node = re.sub(r"[^A-Za-z0-9_-]", "_", device)
    about = {"identifiers": [f"thermocald-{node}"], "name": device, "manufacturer": "thermocald"}
    messages = {}
    for key, (name, unit, kind) in SENSORS.items():
        message: dict[str, Any] = {
            "name": name,
            "unique_id": f"thermocald-{node}-{key}",
            "state_topic": f"{topic}/{node}/result",
            "value_template": f"{{{{ value_json.{key} }}}}",
            "availability_topic": f"{topic}/{node}/available",
            "device": about,
        }
        if unit:
            message |= {"unit_of_measurement": unit, "state_class": "measurement"}
        if kind:
            message["device_class"] = kind
        messages[f"{prefix}/sensor/thermocald-{node}/{key}/config"] = message
    return messages


class MqttOutput(Output):
    """One connection, kept alive by the library's thread."""

    def __init__(
        self,
        *,
        clock: Clock,
        host: str,
        port: int = 1883,
        username: str | None = None,
        password_file: str | None = None,
        topic: str = "thermocald",
        discovery: str | None = "homeassistant",
        device: str = "thermocald",
        timeout_s: float = 5.0,
    ) -> None:
        self.clock = clock
        self.host = support.text("host", host)
        self.port = int(support.number("port", port, 1, 65535, whole=True))
        self.username = username
        self.password_file = password_file
        if password_file and not username:
            raise ConfigurationError("password_file: needs a username")
        self.topic = support.text("topic", topic).strip("/")
        self.discovery = discovery
        self.device = support.text("device", device)
        self.timeout_s = support.number("timeout_s", timeout_s, 0.05, 60, "s")
        self._client: Any = None
        self._announced: set[str] = set()
        self._answered = threading.Event()
        self._refusal = ""

    @property
    def where(self) -> str:
        """The broker as the user knows it."""
        return f"MQTT broker {self.host}:{self.port}"

    def open(self) -> None:
        mqtt = support.library("paho.mqtt.client", "mqtt")
        self._answered.clear()
        self._refusal, self._announced = "", set()
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.connect_timeout = self.timeout_s
        client.on_connect = self._on_connect
        client.will_set(self._available_topic(self.device), "offline", qos=1, retain=True)
        if self.username:
            client.username_pw_set(self.username, self._password())
        try:
            client.connect(self.host, self.port, keepalive=30)
        except OSError as error:
            raise DeviceGone(f"{self.where}: cannot connect ({error})") from error
        self._client = client
        client.loop_start()
        if not self._answered.wait(self.timeout_s):
            self.close()
            raise DeviceTimeout(f"{self.where}: no answer in {self.timeout_s:g} s")
        if self._refusal:
            self.close()
            raise DeviceDenied(f"{self.where}: {self._refusal}; check username and password_file")

    def close(self) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        if client.is_connected():
            for device in self._announced or {self.device}:
                info = client.publish(self._available_topic(device), "offline", qos=1, retain=True)
                try:
                    info.wait_for_publish(self.timeout_s)
                except (RuntimeError, ValueError):
                    break  # the connection broke: the broker sends the last will
        client.disconnect()
        client.loop_stop()

    def emit(self, result: Mapping[str, Any]) -> None:
        if self._client is None:
            raise DeviceGone(f"{self.where}: not open")
        device = str(result.get("device", self.device))
        if device not in self._announced:
            self._announce(device)
        self._publish(f"{self._base(device)}/result", encode(result), retain=False)

    def _announce(self, device: str) -> None:
        if self.discovery:
            messages = discovery_messages(self.discovery, self.topic, device)
            for topic, message in messages.items():
                self._publish(topic, json.dumps(message).encode(), retain=True)
        self._publish(self._available_topic(device), b"online", retain=True)
        self._announced.add(device)

    def _publish(self, topic: str, payload: bytes, *, retain: bool) -> None:
        if not self._client.is_connected():
            raise DeviceGone(f"{self.where}: the connection is down")
        info = self._client.publish(topic, payload, qos=1, retain=retain)
        try:
            info.wait_for_publish(self.timeout_s)
        except (RuntimeError, ValueError) as error:
            raise DeviceGone(f"{self.where}: {error}") from error
        if not info.is_published():
            raise DeviceTimeout(f"{self.where}: no acknowledgement in {self.timeout_s:g} s")

    def _base(self, device: str) -> str:
        return f"{self.topic}/{re.sub(r'[^A-Za-z0-9_-]', '_', device)}"

    def _available_topic(self, device: str) -> str:
        return f"{self._base(device)}/available"

    def _password(self) -> str | None:
        if self.password_file is None:
            return None
        try:
            return Path(self.password_file).read_text().strip()
        except OSError as error:
            raise support.fault(error, f"password_file {self.password_file}", seen=False) from error

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, code: Any, _more: Any) -> None:
        if code.is_failure:
            self._refusal = f"refused the connection ({code})"
        self._answered.set()
