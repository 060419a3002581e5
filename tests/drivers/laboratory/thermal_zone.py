"""A zone in a sysfs tree; unplugging removes its folder."""

from tests.drivers.laboratory.bench import on_sysfs

thermometer = on_sysfs(
    lambda tree, k: tree.zone(2 * k, "cpu-thermal", ("48312", "47000")[k]), {"zone": "cpu-thermal"}
)
