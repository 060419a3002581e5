"""A broker on loopback; unplugging breaks its lines and stops it."""

from tests.drivers.fakes.mqtt_broker import Broker
from tests.drivers.laboratory.bench import on_loopback
from thermocald.hal import SystemClock

WHEN = {"host": "127.0.0.1", "when": [{"no_result": 2}], "timeout_s": 1.0}
output = on_loopback(Broker, WHEN, SystemClock)
