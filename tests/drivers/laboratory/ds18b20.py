"""A sensor in a sysfs tree; unplugging makes its folder vanish, as w1_therm does."""

from tests.drivers.fakes.sysfs import w1_slave
from tests.drivers.laboratory.bench import on_sysfs

ROM = "28-000000bfe244"
thermometer = on_sysfs(
    lambda tree, k: tree.w1(ROM, w1_slave(21.5 + 0.0625 * k)).parent,
    {"sensors": {"temperature": ROM}},
)
