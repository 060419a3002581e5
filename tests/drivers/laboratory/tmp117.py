"""A chip on a fake SMBus adapter; unplugging takes it off its address."""

from tests.drivers.laboratory.bench import on_i2c

thermometer = on_i2c("tmp117")
