"""A chip in a sysfs tree; unplugging removes its folder."""

from tests.drivers.laboratory.bench import on_sysfs

FILES = {"in_temp_raw": "1344", "in_temp_scale": "15.625"}
thermometer = on_sysfs(lambda tree, _: tree.iio(0, "tmp117", **FILES), {"chip": "tmp117"})
