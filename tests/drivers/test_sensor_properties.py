"""Random outputs of devices: right, or rejected in one line.

What chips and firmware print without having measured is in the tables of `test_chip_outputs`.
"""

from __future__ import annotations

import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from thermocald_drivers import chips
from thermocald_drivers.kernel import HwmonThermometer

from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.fakes.sysfs import Sysfs
from thermocald.errors import BadReading, ConfigurationError
from thermocald.hal import SystemClock, VirtualClock, driver_names, open_device

MANY = {"max_examples": 3000, "deadline": None, "derandomize": True,
        "suppress_health_check": [HealthCheck.function_scoped_fixture]}  # fmt: skip
FEW, MORE = {**MANY, "max_examples": 5}, {**MANY, "max_examples": 200}  # for each driver


# --- files of the kernel ------------------------------------------------------------------


def one_line(error):
    assert len(str(error).splitlines()) == 1


def kernel_read(folder, name, text):
    Sysfs(folder).hwmon(0, name, temp1_input=text)
    with HwmonThermometer(clock=VirtualClock(), chip=name, sysfs=str(folder)) as device:
        try:
            return device.read().values["temperature"]
        except BadReading as error:
            one_line(error)
            return None


@pytest.mark.slow
def test_any_content_of_sysfs_is_right_or_refused(tmp_path):
    content = st.one_of(
        st.integers(-300_000, 3_000_000).map(str),
        st.text(alphabet="0123456789-+. eEx_\tNaif٢", max_size=9),
    )

    @settings(**MANY)
    @given(content, st.sampled_from(["lm75", "it87", "sht3x", "anychip", "k10temp"]))
    def check(text, name):
        found = kernel_read(tmp_path, name, text)
        if found is not None:
            assert found == pytest.approx(float(text) / 1000.0)
            assert -55.0 <= found <= 125.0
            assert not chips.is_idle(name, found)

    check()


# --- units that switch --------------------------------------------------------------------


@pytest.mark.parametrize("unit", [None, "thousandths"])
@pytest.mark.parametrize("after", ["45", "450", "46", "447"])
def test_a_zone_that_switches_its_unit(unit, after, tmp_path):
    sysfs, read = Sysfs(tmp_path), []
    sysfs.zone(0, "skin", "45000")
    options = {"zone": "skin", "sysfs": str(tmp_path)} | ({"unit": unit} if unit else {})
    device = open_device("thermometer", "thermal_zone", options, VirtualClock())
    for number in ("45000", "45200", after, after, "45100"):
        sysfs.zone(0, "skin", number)
        device.open()
        try:
            read.append(device.read().values["temperature"])
        except BadReading:
            read.append(None)
            device.close()  # as the daemon does after each fault
    device.close()
    assert read == [45.0, 45.2, None, None, 45.1]


# --- half a late line ---------------------------------------------------------------------

LINES = [b"+023.5C\r", b"T=+023.5C\r\n", b"  21.75 C\r\n"]


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("reopened", [False, True])
def test_the_rest_of_a_late_line_is_no_answer(line, reopened):
    """Cut at every other byte: the late part is discarded, and the answer to this command used."""
    number = r"(?:T=)?\s*(?P<temperature>[-+]?\d*\.\d+) ?C"
    for cut in range(2, len(line), 2):
        far = Instrument()
        options = {"port": far.port, "pattern": number, "command": "?\r", "timeout_s": 0.6}
        device = open_device("thermometer", "serial", options, SystemClock())
        device.open()
        far.send(line[:cut])
        if reopened:
            time.sleep(0.02)
            device.close()
            device.open()
        rest = b"" if reopened else line[cut:]  # the late part is lost while it is closed
        far.answers = {b"?\r": [rest + b"+018.25C\r", b"+018.25C\r", b"+018.25C\r"]}
        try:
            assert device.read().values["temperature"] == 18.25 or not line[:cut].strip()
        finally:
            device.close()
            far.close()


def test_a_prompt_is_no_late_line():
    far = Instrument({b"?\r": [b"21.5 C\r\n> ", b"21.6 C\r\n> ", b"21.7 C\r\n> "]})
    options = {"port": far.port, "pattern": r"(?P<t>[\d.]+) C", "command": "?\r", "timeout_s": 0.5}
    with open_device("thermometer", "serial", options, SystemClock()) as device:
        assert [device.read().values["t"] for _ in range(3)] == [21.5, 21.6, 21.7]
    far.close()


# --- options ------------------------------------------------------------------------------

SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
KEYED = st.dictionaries(st.text(max_size=5), SCALARS, max_size=2)
ANYTHING = SCALARS | KEYED | st.lists(SCALARS | KEYED | st.lists(SCALARS, max_size=3), max_size=3)


@pytest.mark.parametrize(
    "amount", [pytest.param(FEW, id="few"), pytest.param(MORE, id="more", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, name) for kind in ("camera", "thermometer", "output") for name in driver_names(kind)],
)
def test_any_option_is_taken_or_refused_in_one_line(kind, name, amount):
    from thermocald.hal import load_driver

    fields = load_driver(kind, name).Options.model_fields
    required = {key: ANYTHING for key in fields if fields[key].is_required()}
    more = {key: ANYTHING for key in fields if key not in required}

    @settings(**amount)
    @given(st.fixed_dictionaries(required, optional=more))
    def check(options):
        try:
            device = open_device(kind, name, options, VirtualClock())
        except ConfigurationError as error:
            message = str(error)
        else:
            device.close()
            return
        assert message.startswith(f"{kind} driver {name!r}: ")
        assert "Traceback" not in message

    check()
