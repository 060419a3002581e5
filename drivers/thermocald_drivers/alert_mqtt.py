"""Alerts to an MQTT broker, announced to Home Assistant.

    outputs:
      - name: alarm
        driver: alert_mqtt
        host: broker.local
        port: 1883                                 # 8883 with TLS
        username: thermocald                       # and password_file: /etc/mqtt-password
        tls: true                                  # with ca, cert, key: files, as in `mqtt`
        topic: thermocald                          # thermocald/<device>/alert/<condition>
        discovery: homeassistant                   # null: none
        when:                                      # as in docs/how-to/alerts.md
          - {drift: c, px: 0.5}
        device: thermocald                         # the name of results that have none
        timeout_s: 5

Messages are retained with QoS 1: who connects later learns what is out.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from thermocald_drivers.alert import AlertOutput
from thermocald_drivers.mqtt import MqttLine, node_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock
    from thermocald_drivers.alert_conditions import Alert

__all__ = ["MqttAlert"]


class MqttAlert(AlertOutput):
    """One retained message for each change."""

    def __init__(
        self,
        *,
        clock: Clock,
        host: str,
        when: Sequence[Mapping[str, Any]],
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
        self.watch(when, device, timeout_s)
        self._line = MqttLine(
            host, port, username, password_file, self.timeout_s, tls=tls, ca=ca, cert=cert, key=key
        )
        self.where = self._line.where
        self.topic = topic.strip("/")
        self.discovery = discovery

    def reach(self) -> None:
        self._line.connect(None)

    def close(self) -> None:
        super().close()
        self._line.disconnect()

    def emit(self, result: Mapping[str, Any]) -> None:
        if self._opened:
            self._line.require_connected()
        super().emit(result)

    def deliver(self, alert: Alert) -> None:
        node = node_of(alert.device)
        state = f"{self.topic}/{node}/alert/{alert.condition}"
        if self.discovery:
            name = f"thermocald-{node}-alert-{node_of(alert.condition)}"
            document = {
                "name": f"Alert {alert.condition}",
                "unique_id": name,
                "state_topic": state,
                "value_template": "{{ value_json.state }}",
                "payload_on": "out",
                "payload_off": "in",
                "device_class": "problem",
                "json_attributes_topic": state,
                "device": {
                    "identifiers": [f"thermocald-{node}"],
                    "name": alert.device,
                    "manufacturer": "thermocald",
                },
            }
            config = f"{self.discovery}/binary_sensor/{name}/config"
            self._line.publish(config, json.dumps(document).encode(), retain=True)
        self._line.publish(state, json.dumps(alert.document()).encode(), retain=True)
