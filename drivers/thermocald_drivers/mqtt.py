"""Results and alerts published to an MQTT broker and announced to Home Assistant.

    outputs:
      - name: home
        driver: mqtt
        host: broker.local
        port: 1883                           # 8883 with TLS
        username: thermocald                 # with password_file: /etc/thermocald/mqtt-password
        tls: true                            # encrypted; the server's certificate is verified
        ca: /etc/thermocald/ca.pem           # for a broker with a private certificate
        cert: /etc/thermocald/client.pem     # with key: client.key; if the broker requires one
        topic: thermocald                    # thermocald/<device>/result and …/available
        discovery: homeassistant             # null: no announcement
        device: thermocald                   # for results that name no device
        timeout_s: 5
      - name: alarm
        driver: alert_mqtt                   # thermocald/<device>/alert/<condition>; as above, and
        host: broker.local
        when: [{drift: c, px: 0.5}]          # as in docs/how-to/alerts.md

Each result is one JSON object with QoS 1. `emit` waits at most `timeout_s` for the broker's
acknowledgement, so that a loss is noticed. Alerts are retained: a client that connects later
receives the current state. The last will sets the device to `offline`. ca, cert and key imply
`tls`. A name with characters that a topic or identifier excludes is changed and gets a suffix:
cam.1 becomes cam_1-66498b, so that it differs from cam_1.
Source: paho-mqtt 2 (callback API 2), Home Assistant "MQTT discovery".
"""

from __future__ import annotations

import hashlib
import json
import re
import ssl
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from thermocald.errors import (
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceTimeout,
)
from thermocald.hal import DriverOptions, Output
from thermocald_drivers import support
from thermocald_drivers.alert import AlertOptions, AlertOutput, secret
from thermocald_drivers.jsonl import encode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald_drivers.alert import Alert

_NOT_YET_VALID = 9  # OpenSSL's X509_V_ERR_CERT_NOT_YET_VALID
_UNAVAILABLE = 136  # MQTT's reason code of a broker that starts or is busy
SENSORS: Mapping[str, tuple[str, str | None, str | None, int | None]] = {
    # column of the result: (name, unit, Home Assistant's device class, decimals shown)
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
    """Return a device's name for topics and identifiers; different names stay different."""
    node = re.sub(r"[^A-Za-z0-9_-]", "_", device)
    if node != device:  # `cam.1` must not become `cam_1`
        node += "-" + hashlib.sha256(device.encode()).hexdigest()[:6]
    return node


def discovery_messages(
    prefix: str, topic: str, device: str, speaker: str
) -> dict[str, dict[str, Any]]:
    """Return {topic: configuration} from which Home Assistant shows the device's sensors.

    speaker: the device of the last will. A connection has only one, so all devices count as
    available only while it is.
    """
    node = node_of(device)
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
            "device": _about(device),
            "unit_of_measurement": unit,
            "state_class": unit and "measurement",
            "suggested_display_precision": decimals,
            "device_class": kind,
        }
        known = {name: value for name, value in message.items() if value is not None}
        messages[f"{prefix}/sensor/thermocald-{node}/{key}/config"] = known
    return messages


# neither wildcards nor the broker's own topics
Topic = Annotated[
    str,
    AfterValidator(lambda topic: topic.strip("/")),
    support.like(r"(?!\$)[^+#\0]+", "is not a topic: leave out +, # and a leading $"),
]


class BrokerOptions(DriverOptions):
    """The options of a broker; port None: 1883, with TLS 8883; discovery None: not announced."""

    host: support.Text
    port: support.Port | None = None
    username: support.Text | None = None
    password_file: support.Text | None = None
    tls: bool = False
    ca: support.Text | None = None
    cert: support.Text | None = None
    key: support.Text | None = None
    topic: Topic = "thermocald"
    discovery: Topic | None = "homeassistant"
    device: support.Text = "thermocald"
    timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 5.0


class _Broker(Output):
    """A connection to a broker, kept alive by the library's thread."""

    Options: ClassVar[type[DriverOptions]] = BrokerOptions

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        self.tls = o.tls or bool(o.ca or o.cert)
        self.port = o.port or (8883 if self.tls else 1883)
        if o.password_file and not o.username:
            raise ConfigurationError("password_file: needs a username")
        if o.key and not o.cert:
            raise ConfigurationError("key: needs its certificate, cert")
        self.where = f"MQTT broker {o.host}:{self.port}"

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        return self.handle is not None and bool(self.handle.is_connected())

    def connect(self, will: str | None) -> None:
        """Connect; will: the topic that is set to `offline` when the connection breaks."""
        mqtt = support.library("paho.mqtt.client", "mqtt")
        answered: Future[Any] = Future()

        def on_connect(_client: Any, _data: Any, _flags: Any, code: Any, _more: Any) -> None:
            if not answered.done():  # the library reconnects by itself
                answered.set_result(code)

        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.connect_timeout = self.options.timeout_s
        client.on_connect = on_connect
        if will is not None:
            client.will_set(will, "offline", qos=1, retain=True)
        if self.options.username:
            password = secret("password_file", self.options.password_file)
            client.username_pw_set(self.options.username, password)
        if self.tls:
            client.tls_set_context(self._context())
        try:
            client.connect(self.options.host, self.port, keepalive=30)
        except ssl.SSLCertVerificationError as error:
            # a clock without a battery is before the certificate's time until it is set
            kind = DeviceGone if error.verify_code == _NOT_YET_VALID else DeviceDenied
            raise kind(f"{self.where}: {support.reason(error)}; check ca") from error
        except (OSError, ValueError) as error:
            raise DeviceGone(f"{self.where}: cannot connect ({support.reason(error)})") from error
        self.handle = client
        client.loop_start()
        try:
            code = answered.result(self.options.timeout_s)
        except TimeoutError:
            _Broker.close(self)
            raise DeviceTimeout(f"{self.where}: no answer in {self.timeout_s:g} s") from None
        if code.is_failure:
            _Broker.close(self)
            if code.value == _UNAVAILABLE:
                raise DeviceGone(f"{self.where}: {code}")
            why = f"refused the connection ({code}); check username and password_file"
            raise DeviceDenied(f"{self.where}: {why}")

    def close(self) -> None:
        client, self.handle = self.handle, None
        if client is not None:
            client.disconnect()
            client.loop_stop()

    def opened(self) -> Any:
        """Return the connection; DeviceGone while it is closed or down."""
        client = super().opened()
        if not self.connected:
            raise DeviceGone(f"{self.where}: the connection is down")
        return client

    def publish(self, topic: str, payload: bytes, *, retain: bool) -> None:
        """Publish with QoS 1 and wait for the broker's acknowledgement; raises a DeviceError."""
        info = self.opened().publish(topic, payload, qos=1, retain=retain)
        try:
            info.wait_for_publish(self.options.timeout_s)
        except (RuntimeError, ValueError) as error:
            raise DeviceGone(f"{self.where}: {support.reason(error)}") from error
        if not info.is_published():
            raise DeviceTimeout(f"{self.where}: no acknowledgement in {self.options.timeout_s:g} s")

    def _context(self) -> ssl.SSLContext:
        try:
            context = ssl.create_default_context(cafile=self.options.ca)
            if self.options.cert:
                context.load_cert_chain(self.options.cert, self.options.key)
        except ssl.SSLError as error:
            raise ConfigurationError(
                f"ca, cert, key: do not belong together ({error.reason or 'not readable'})"
            ) from error
        except OSError as error:
            raise support.fault(error, "ca, cert or key", seen=False) from error
        return context


class MqttOutput(_Broker):
    """An output that publishes each result; a device is announced with its first."""

    def open(self) -> None:
        self._announced: set[str] = set()
        self.connect(self._available_topic(self.options.device))

    def close(self) -> None:
        if self.connected:
            with suppress(DeviceError):  # the connection broke: the broker sends the last will
                for device in self._announced or {self.options.device}:
                    self.publish(self._available_topic(device), b"offline", retain=True)
        super().close()

    def emit(self, result: Mapping[str, Any]) -> None:
        self.opened()
        device = str(result.get("device", self.options.device))
        o = self.options
        if device not in self._announced:
            found = (
                discovery_messages(o.discovery, o.topic, device, o.device) if o.discovery else {}
            )
            for topic, message in found.items():
                self.publish(topic, json.dumps(message).encode(), retain=True)
            for name in dict.fromkeys((o.device, device)):
                self.publish(self._available_topic(name), b"online", retain=True)
            self._announced |= {o.device, device}
        self.publish(f"{o.topic}/{node_of(device)}/result", encode(result), retain=False)

    def _available_topic(self, device: str) -> str:
        return f"{self.options.topic}/{node_of(device)}/available"


class MqttAlert(_Broker, AlertOutput):
    """An output that publishes a retained message for each alert."""

    class Options(BrokerOptions, AlertOptions):
        """The options of a broker and of an alert."""

    def open(self) -> None:
        self.connect(None)

    def deliver(self, alert: Alert) -> None:
        node, condition = node_of(alert.device), node_of(alert.condition)
        state = f"{self.options.topic}/{node}/alert/{condition}"
        if self.options.discovery:
            name = f"thermocald-{node}-alert-{condition}"
            document = {
                "name": f"Alert {alert.condition}",
                "unique_id": name,
                "state_topic": state,
                "value_template": "{{ value_json.state }}",
                "payload_on": "out",
                "payload_off": "in",
                "device_class": "problem",
                "json_attributes_topic": state,
                "device": _about(alert.device),
            }
            config = f"{self.options.discovery}/binary_sensor/{name}/config"
            self.publish(config, json.dumps(document).encode(), retain=True)
        self.publish(state, json.dumps(alert.document()).encode(), retain=True)


def _about(device: str) -> dict[str, Any]:
    """Return the device under which Home Assistant groups the sensors."""
    identifiers = [f"thermocald-{node_of(device)}"]
    return {"identifiers": identifiers, "name": device, "manufacturer": "thermocald"}
