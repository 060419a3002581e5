"""The contract of `thermocald.hal`, for every registered driver, each on its laboratory's bench.

The drivers are those of the entry points, not of a list here: a registered driver without a
laboratory fails.
"""

from __future__ import annotations

import inspect
import itertools
import math
import re
import sys
import time

import numpy as np
import pytest

from tests.drivers.laboratory import LABORATORY
from thermocald.errors import ConfigurationError, DeviceError, TransientDeviceError
from thermocald.hal import Camera, DriverOptions, Output, Thermometer, driver_names, load_driver

OURS = ("thermocald", "thermocald_drivers")
KINDS = {"camera": Camera, "thermometer": Thermometer, "output": Output}
REGISTERED = [(kind, name) for kind in KINDS for name in driver_names(kind)]

RESULT = {"epoch": 1, "device": "river", "state": "drifting", "status": "ok", "sd_c": None}


def use(kind, device):
    """Take one frame or reading, or emit one result."""
    if kind == "camera":
        return device.capture()
    if kind == "thermometer":
        return device.read()
    return device.emit(RESULT)


def test_every_driver_has_a_laboratory_and_every_laboratory_a_driver():
    """Without entry points, the tests below would be empty."""
    assert set(REGISTERED) == set(LABORATORY), "see tests/drivers/laboratory.py"


each_driver = pytest.mark.parametrize("driver", REGISTERED, ids="-".join)


@each_driver
def test_driver_is_what_it_is_registered_as_and_explains_its_stanza(driver):
    kind, name = driver
    made = load_driver(kind, name)
    assert issubclass(made.Options, DriverOptions)
    assert all(c.startswith("char-") for c in made.device_classes)
    if kind == "output":  # a session replaces the programme of a heating output
        assert made.heats == ("programme" in made.Options.model_fields)
    module = sys.modules[made.__module__]
    text = module.__doc__ or ""
    assert f"driver: {name}" in text
    for option in made.Options.model_fields:
        assert option in text, f"option {option} is not explained at the top of the file"
    # at its top, it imports no device's library
    source = inspect.getsource(module)
    top = re.findall(r"^(?:import|from) (\w+)(?:[.\w]*$|.* import )", source, re.M)
    assert set(top) <= {*sys.stdlib_module_names, "numpy", "pydantic", *OURS}


@each_driver
def test_a_device_is_opened_twice_unplugged_and_back(driver, bench):
    kind, _ = driver
    with pytest.raises(ConfigurationError):
        bench.device(no_such_option=1)
    device = bench.device()
    for _ in range(2):
        with pytest.raises(DeviceError):
            use(kind, device)
        with device:
            CHECKS[kind](device, bench.clock)
            identity = dict(device.identity())
        device.close()
    assert all(isinstance(part, str) for item in identity.items() for part in item)
    assert all(isinstance(text, str) for text in device.warnings())
    device.open()
    use(kind, device)
    bench.unplug()
    with pytest.raises((TransientDeviceError, bench.gone), match=bench.says):
        use_until_it_fails(kind, device)
    device.close()
    with pytest.raises(bench.gone):
        device.open()
    bench.plug()
    with device:
        use(kind, device)


def use_until_it_fails(kind, device):
    """Use the device until it raises; a few buffered results may come first."""
    for _ in range(3):
        use(kind, device)
        device.close()
        device.open()


def check_frames(camera, clock):
    frames = [camera.capture() for _ in range(3)]
    for frame in frames:
        assert frame.image is not None or frame.encoded or frame.observations
        if frame.image is not None:
            assert frame.image.ndim == 2
            assert frame.image.dtype in (np.uint8, np.uint16)
            assert not frame.image.flags.writeable
            assert camera.frame_size() in (None, frame.image.shape[::-1])
        assert frame.monotonic <= clock.monotonic() + 1e-6
        assert frame.exposure is None or frame.exposure > 0
    instants = [frame.monotonic for frame in frames]
    assert instants == sorted(set(instants)), "every frame has its own, later instant"
    numbers = [frame.sequence for frame in frames if frame.sequence is not None]
    assert numbers == sorted(set(numbers))


def check_readings(thermometer, clock):
    readings = [thermometer.read() for _ in range(3)]
    assert all(-100 < value < 200 for reading in readings for value in reading.values.values())
    # The system's times are converted to a virtual clock that stands still within some µs.
    instants = [reading.monotonic for reading in readings]
    assert all(b > a - 1e-3 for a, b in itertools.pairwise(instants))
    assert instants[-1] <= clock.monotonic() + 1e-6


def check_outputs(output, _clock):
    begin = time.monotonic()
    for result in (RESULT, {**RESULT, "c": math.nan, "status": "too_few_targets"}, {}):
        output.emit(result)
    assert time.monotonic() - begin < 3 * getattr(output.options, "timeout_s", 5.0)


CHECKS = {"camera": check_frames, "thermometer": check_readings, "output": check_outputs}
