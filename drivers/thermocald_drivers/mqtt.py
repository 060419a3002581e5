"""Results to an MQTT broker, announced to Home Assistant.

    outputs:
      - name: home
        driver: mqtt
        host: broker.local
        port: 1883                           # 8883 with TLS
        username: thermocald                 # and password_file: /etc/thermocald/mqtt-password
        tls: true                            # encrypted; the server's certificate is verified
        ca: /etc/thermocald/ca.pem           # of a broker with a certificate of its own
        cert: /etc/thermocald/client.pem     # and key: client.key; where the broker asks for it
        topic: thermocald                    # thermocald/<device>/result and …/available
        discovery: homeassistant             # null: none
        device: thermocald                   # the name of results that have none
        timeout_s: 5

ca, cert and key imply `tls`. Each result is one JSON object with QoS 1. `emit` waits for the
broker's acknowledgement, at most `timeout_s`, so that a loss is noticed. The last will sets the
device to `offline`.
Source: paho-mqtt 2 (callback API 2), Home Assistant "MQTT discovery".
"""

from __future__ import annotations

import json
import re
import ssl
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import (
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceTimeout,
)
from thermocald.hal import Output
from thermocald_drivers import support
from thermocald_drivers.jsonl import encode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock

__all__ = ["MqttLine", "MqttOutput", "discovery_messages", "node_of"]

SENSORS: Mapping[str, tuple[str, str | None, str | None, int | None]] = {
    # key of the result: (name, unit, Home Assistant's device class, decimals it shows)
    "temperature": ("Temperature", "°C", "temperature", 2),
    "c": ("Principal distance", "mm", None, 5),
    "x0": ("Principal point x0", "mm", None, 5),
    "y0": ("Principal point y0", "mm", None, 5),
    "drift_c_px": ("Drift of c", "px", None, 2),
    "drift_x0_px": ("Drift of x0", "px", None, 2),
    "drift_y0_px": ("Drift of y0", "px", None, 2),
    "sigma0": ("Sigma 0", None, None, 2),
    "n_observations": ("Observations", None, None, None),
    "state": ("State", None, None, None),
    "status": ("Status", None, None, None),
}


def node_of(device: str) -> str:
    """A device's name as topics and identifiers may hold it."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", device)


def discovery_messages(
    prefix: str, topic: str, device: str, speaker: str
) -> dict[str, dict[str, Any]]:
    """{topic: configuration} with which Home Assistant shows the device's sensors.

    speaker: the name under which the last will is left: a connection has one, so that all devices
    are available only while it is.
    """
    node = node_of(device)
    about = {"identifiers": [f"thermocald-{node}"], "name": device, "manufacturer": "thermocald"}
    messages = {}
    for key, (name, unit, kind, decimals) in SENSORS.items():
        message: dict[str, Any] = {
            "name": name,
            "unique_id": f"thermocald-{node}-{key}",
            "state_topic": f"{topic}/{node}/result",
            "value_template": f"{{{{ value_json.{key} }}}}",
            "availability": [
                {"topic": f"{topic}/{name}/available"}
                for name in dict.fromkeys((node_of(speaker), node))
            ],
            "availability_mode": "all",
            "device": about,
        }
        if unit:
            message |= {"unit_of_measurement": unit, "state_class": "measurement"}
        if decimals is not None:
            message["suggested_display_precision"] = decimals
        if kind:
            message["device_class"] = kind
        messages[f"{prefix}/sensor/thermocald-{node}/{key}/config"] = message
    return messages


class MqttLine:
    """A connection to a broker, kept alive by the library's thread.

    port None: 1883, with TLS 8883. Raises ConfigurationError for options that do not go together.
    """

    def __init__(
        self,
        host: str,
        port: int | None,
        username: str | None,
        password_file: str | None,
        timeout_s: float,
        *,
        tls: bool = False,
        ca: str | None = None,
        cert: str | None = None,
        key: str | None = None,
    ) -> None:
        self.host = support.text("host", host)
        if not isinstance(tls, bool):
            raise ConfigurationError(f"tls: {tls!r} is neither true nor false")
        self.tls = tls or bool(ca or cert)
        port = (8883 if self.tls else 1883) if port is None else port
        self.port = int(support.number("port", port, 1, 65535, whole=True))
        if password_file and not username:
            raise ConfigurationError("password_file: needs a username")
        if key and not cert:
            raise ConfigurationError("key: needs its certificate, cert")
        self.username, self.password_file = username, password_file
        self.ca, self.cert, self.key = ca, cert, key
        self.timeout_s = timeout_s
        self._client: Any = None
        self._answered = threading.Event()
        self._refusal = ""

    @property
    def where(self) -> str:
        """The broker as the user knows it."""
        return f"MQTT broker {self.host}:{self.port}"

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        return self._client is not None and bool(self._client.is_connected())

    def connect(self, will: str | None) -> None:
        """Connect; will: the topic that says `offline` once the connection breaks."""
        mqtt = support.library("paho.mqtt.client", "mqtt")
        self._answered.clear()
        self._refusal = ""
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.connect_timeout = self.timeout_s
        client.on_connect = self._on_connect
        if will is not None:
            client.will_set(will, "offline", qos=1, retain=True)
        if self.username:
            client.username_pw_set(self.username, self._password())
        if self.tls:
            client.tls_set_context(self._context())
        try:
            client.connect(self.host, self.port, keepalive=30)
        except ssl.SSLCertVerificationError as error:
            raise DeviceDenied(
                f"{self.where}: its certificate is not trusted ({error.verify_message}); check ca"
            ) from error
        except OSError as error:
            raise DeviceGone(f"{self.where}: cannot connect ({error})") from error
        self._client = client
        client.loop_start()
        if not self._answered.wait(self.timeout_s):
            self.disconnect()
            raise DeviceTimeout(f"{self.where}: no answer in {self.timeout_s:g} s")
        if self._refusal:
            self.disconnect()
            raise DeviceDenied(f"{self.where}: {self._refusal}; check username and password_file")

    def disconnect(self) -> None:
        """End the connection; may be called twice."""
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            client.loop_stop()

    def require_connected(self) -> None:
        """Raise DeviceGone unless the connection is up."""
        if self._client is None:
            raise DeviceGone(f"{self.where}: not open")
        if not self.connected:
            raise DeviceGone(f"{self.where}: the connection is down")

    def publish(self, topic: str, payload: bytes, *, retain: bool) -> None:
        """Publish with QoS 1 and wait for the broker's acknowledgement; raises a DeviceError."""
        self.require_connected()
        info = self._client.publish(topic, payload, qos=1, retain=retain)
        try:
            info.wait_for_publish(self.timeout_s)
        except (RuntimeError, ValueError) as error:
            raise DeviceGone(f"{self.where}: {error}") from error
        if not info.is_published():
            raise DeviceTimeout(f"{self.where}: no acknowledgement in {self.timeout_s:g} s")

    def _context(self) -> ssl.SSLContext:
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.cert:
                context.load_cert_chain(self.cert, self.key)
        except ssl.SSLError as error:
            raise ConfigurationError(
                f"ca, cert, key: not certificates and key that belong together ({error})"
            ) from error
        except OSError as error:
            raise support.fault(error, "ca, cert or key", seen=False) from error
        return context

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


class MqttOutput(Output):
    """Every result as a message; devices are announced with their first."""

    def __init__(
        self,
        *,
        clock: Clock,
        host: str,
        port: int | None = None,
        username: str | None = None,
        password_file: str | None = None,
        tls: bool = False,
        ca: str | None = None,
        cert: str | None = None,
        key: str | None = None,
        topic: str = "thermocald",
        discovery: str | None = "homeassistant",
        device: str = "thermocald",
        timeout_s: float = 5.0,
    ) -> None:
        self.clock = clock
        self.topic = support.text("topic", topic).strip("/")
        self.discovery = discovery
        self.device = support.text("device", device)
        self.timeout_s = support.number("timeout_s", timeout_s, 0.05, 60, "s")
        self._line = MqttLine(
            host, port, username, password_file, self.timeout_s, tls=tls, ca=ca, cert=cert, key=key
        )
        self._announced: set[str] = set()

    def open(self) -> None:
        self._announced = set()
        self._line.connect(self._available_topic(self.device))

    def close(self) -> None:
        if self._line.connected:
            for device in self._announced or {self.device}:
                try:
                    self._line.publish(self._available_topic(device), b"offline", retain=True)
                except DeviceError:
                    break  # the connection broke: the broker sends the last will
        self._line.disconnect()

    def emit(self, result: Mapping[str, Any]) -> None:
        self._line.require_connected()
        device = str(result.get("device", self.device))
        if device not in self._announced:
            self._announce(device)
        self._line.publish(f"{self._base(device)}/result", encode(result), retain=False)

    def _announce(self, device: str) -> None:
        if self.discovery:
            messages = discovery_messages(self.discovery, self.topic, device, self.device)
            for topic, message in messages.items():
                self._line.publish(topic, json.dumps(message).encode(), retain=True)
        for name in dict.fromkeys((self.device, device)):
            self._line.publish(self._available_topic(name), b"online", retain=True)
        self._announced |= {self.device, device}

    def _base(self, device: str) -> str:
        return f"{self.topic}/{node_of(device)}"

    def _available_topic(self, device: str) -> str:
        return f"{self._base(device)}/available"
