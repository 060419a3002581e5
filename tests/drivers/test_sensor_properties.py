"""Random outputs of devices: right, or rejected in one line.

What chips and firmware print without having measured is in the tables of `test_chip_outputs`.
"""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from thermocald_drivers import chips

from tests.drivers.fakes.sysfs import Sysfs
from thermocald.errors import BadReading, ConfigurationError
from thermocald.hal import VirtualClock, driver_names, load_driver, open_device

MANY = {"max_examples": 3000, "deadline": None, "derandomize": True,
        "suppress_health_check": [HealthCheck.function_scoped_fixture]}  # fmt: skip
FEW, MORE = {**MANY, "max_examples": 5}, {**MANY, "max_examples": 200}  # for each driver


@pytest.mark.slow
def test_any_content_of_sysfs_is_right_or_refused(tmp_path):
    content = st.one_of(
        st.integers(-300_000, 3_000_000).map(str),
        st.text(alphabet="0123456789-+. eEx_\tNaif٢", max_size=9),
    )

    @settings(**MANY)
    @given(content, st.sampled_from(["lm75", "it87", "sht3x", "anychip", "k10temp"]))
    def check(text, name):
        Sysfs(tmp_path).hwmon(0, name, temp1_input=text)
        options = {"chip": name, "sysfs": str(tmp_path)}
        with open_device("thermometer", "hwmon", options, VirtualClock()) as device:
            try:
                found = device.read().values["temperature"]
            except BadReading:
                return
        assert found == pytest.approx(float(text) / 1000.0)
        assert -55.0 <= found <= 125.0
        assert not chips.is_idle(name, found)

    check()


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
