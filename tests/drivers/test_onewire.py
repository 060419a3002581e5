"""DS18B20: real w1_slave files, and the sensor's faults."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest
from thermocald_drivers.onewire import decode

from tests.drivers.fakes.sysfs import scratchpad, w1_slave
from tests.drivers.laboratory import check_readings
from thermocald.errors import BadReading, DeviceNotFound, DeviceTimeout
from thermocald.hal import SystemClock, VirtualClock, open_device

ROM = "28-000000bfe244"
CRC_NO = "ff ff ff ff ff ff ff ff ff : crc=c9 NO\n46 01 4b 46 7f ff 0a 10 85 t=-62"


def thermometer(sysfs, clock=None, **options):
    options = {"sensors": {"temperature": ROM}, "sysfs": str(sysfs.root), **options}
    return open_device("thermometer", "ds18b20", options, clock or VirtualClock())


def test_every_real_block_is_judged_rightly(shared):
    text = (shared / "data/onewire/w1_slave_real.txt").read_text()
    believed, refused = [], []
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if line and not line.startswith("#")]
        family = "10" if "a DS18S20 (family 10)" in block else "28"
        if len(lines) == 2:
            try:
                believed.append(decode("\n".join(lines), "w1", family)[0])
            except BadReading as error:
                refused.append(str(error))
    # by hand from the file: two power-on values (checked later, by context), six good readings
    assert believed == [85.0, 85.0, 23.562, 25.812, 25.187, 3.937, 21.875, 20.875]
    assert sum("CRC error" in text for text in refused) == 4  # three NO, one forged
    assert sum("all zeros" in text for text in refused) == 1
    assert len(refused) == 5


NEAR, HOT = w1_slave(21.5), w1_slave(84.9375)
POWER_ON = scratchpad("50 05 4b 46 7f ff 0c 10", 85000)
COUNTERFEIT = scratchpad("90 01 55 05 7f 7e 81 66", 25000)  # family D2 of C. Petrich's survey
NEAR_10 = scratchpad("a8 00 4b 46 ff ff 0c 10", 84000)
POWER_ON_10 = scratchpad("aa 00 4b 46 ff ff 0c 10", 85000)
GX20MH01 = scratchpad("50 05 4b 46 ff ff 0c 10", 85046)  # 14 bits
IDLE = "power-on value"
# (family, [(content and s before it, reading)]): a power-on value is accepted only near a recent
# reading of another value
AT_POWER_ON = {
    "without a neighbour": ("28", [((NEAR, 0), 21.5), ((POWER_ON, 0), IDLE)]),
    "on a ramp": ("28", [((HOT, 0), 84.937), ((POWER_ON, 0), 85.0)]),
    "long after a neighbour": ("28", [((HOT, 0), 84.937), ((POWER_ON, 61), IDLE)]),
    "vouching for itself": (
        "28", [((HOT, 0), 84.937), ((POWER_ON, 40), 85.0), ((POWER_ON, 40), IDLE)]),
    "25 °C": ("28", [((COUNTERFEIT, 0), IDLE), ((NEAR, 0), 21.5), ((COUNTERFEIT, 0), 25.0)]),
    "more bits": ("28", [((GX20MH01, 0), IDLE), ((HOT, 0), 84.937), ((GX20MH01, 0), 85.046)]),
    "DS18S20": ("10", [((POWER_ON_10, 0), IDLE), ((NEAR_10, 0), 84.0), ((POWER_ON_10, 0), 85.0)]),
    **{f"family {family}": (
        family, [((POWER_ON, 0), IDLE), ((HOT, 0), 84.937), ((POWER_ON, 0), 85.0)])
       for family in ("22", "42", "3b")},
}  # fmt: skip


@pytest.mark.parametrize("case", AT_POWER_ON)
def test_the_power_on_value_needs_a_neighbour(sysfs, case):
    family, steps = AT_POWER_ON[case]
    rom, clock = f"{family}-000000bfe244", VirtualClock()

    def put(step):
        sysfs.w1(rom, step[0])
        clock.sleep_until(clock.monotonic() + step[1])

    sysfs.w1(rom, NEAR)
    with thermometer(sysfs, clock, sensors={"temperature": rom}) as device:
        check_readings(device, put, steps)


def test_a_crc_error_is_read_once_more(sysfs, monkeypatch):
    answers = iter([CRC_NO, NEAR])
    sysfs.w1(ROM, "")
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: next(answers))
    with thermometer(sysfs, attempts=2) as device:
        assert device.read().values == {"temperature": 21.5}


@pytest.mark.parametrize("content", [CRC_NO, None])
def test_one_dead_or_missing_sensor_does_not_take_the_others_along(sysfs, content):
    sysfs.w1("28-00000a1b2c3d", w1_slave(-10.125))
    if content is None:
        with pytest.raises(DeviceNotFound, match="there is 28-00000a1b2c3d"):
            thermometer(sysfs).open()
    else:
        sysfs.w1(ROM, content)
    sensors = {"camera": ROM, "air": "28-00000a1b2c3d"}
    with thermometer(sysfs, sensors=sensors) as device:
        reading = device.read()
    assert reading.values == {"air": -10.125}
    assert ("CRC" if content else "is not on the bus") in reading.missing["camera"]


def feed(path, content, delay):
    """A FIFO in place of the file that answers after `delay` s, like a conversion."""
    path.unlink()
    os.mkfifo(path)

    def answer():
        time.sleep(delay)
        with path.open("w") as pipe:
            pipe.write(content + "\n")

    thread = threading.Thread(target=answer)
    thread.start()
    return thread


def test_slow_sensors_are_read_in_parallel(sysfs):
    """Linux 6.1 converts one after the other: the last has four times the patience of one."""
    sensors = {f"t{k}": f"28-0000000000{k:02x}" for k in range(4)}
    threads = [
        feed(sysfs.w1(rom, ""), w1_slave(20.0 + k), 0.15 + 0.15 * k)
        for k, rom in enumerate(sensors.values())
    ]
    with thermometer(sysfs, SystemClock(), sensors=sensors, timeout_s=0.3) as device:
        begin = time.monotonic()
        reading = device.read()
        took = time.monotonic() - begin
    [thread.join() for thread in threads]
    assert reading.values == {"t0": 20.0, "t1": 21.0, "t2": 22.0, "t3": 23.0}
    assert took < 1.2  # one after the other would take 1.5 s


def test_a_hanging_bus_times_out_and_its_late_answer_is_dropped(sysfs):
    path = sysfs.w1(ROM, "")
    thread = feed(path, w1_slave(99.0), 0.4)
    with thermometer(sysfs, SystemClock(), timeout_s=0.1) as device:
        with pytest.raises(DeviceTimeout, match=r"no answer in 0\.1 s"):
            device.read()
        thread.join()
        while any(t.name == "w1-temperature" for t in threading.enumerate()):
            time.sleep(0.01)
        path.unlink()
        sysfs.w1(ROM, w1_slave(20.0))
        assert device.read().values == {"temperature": 20.0}
