"""gpiozero's mock pins; unplugging takes the pins away from the machine."""

from tests.drivers.laboratory.bench import on_pins

output = on_pins({"pin": 27, "limit_c": 60, "programme": [{"seconds": 1000, "hold_c": 45.0}]})
