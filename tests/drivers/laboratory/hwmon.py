"""A chip in a sysfs tree; unplugging removes its folder."""

from tests.drivers.laboratory.bench import on_sysfs

thermometer = on_sysfs(
    lambda tree, k: tree.hwmon(k, "lm75", temp1_input=("21062", "21125")[k]), {"chip": "lm75"}
)
