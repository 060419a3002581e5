"""A broker on loopback; unplugging breaks its lines and stops it."""

from tests.drivers.fakes.mqtt_broker import Broker
from tests.drivers.laboratory.bench import on_loopback
from thermocald.hal import SystemClock

output = on_loopback(Broker, {"host": "127.0.0.1", "timeout_s": 1.0}, SystemClock)
