"""gpiozero's mock pins; unplugging takes the pins away from the machine."""

from tests.drivers.laboratory.bench import on_pins

output = on_pins({"pin": 17})
