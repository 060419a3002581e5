"""Random options of drivers: taken, or rejected in one line."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drivers.test_contract import REGISTERED
from thermocald.errors import ConfigurationError
from thermocald.hal import VirtualClock, load_driver, open_device

SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
KEYED = st.dictionaries(st.text(max_size=5), SCALARS, max_size=2)
ANYTHING = SCALARS | KEYED | st.lists(SCALARS | KEYED | st.lists(SCALARS, max_size=3), max_size=3)


@pytest.mark.parametrize("amount", [5, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("kind", "name"), REGISTERED)
def test_any_option_is_taken_or_refused_in_one_line(kind, name, amount):
    fields = load_driver(kind, name).Options.model_fields
    required = {key: ANYTHING for key in fields if fields[key].is_required()}
    more = {key: ANYTHING for key in fields if key not in required}

    @settings(max_examples=amount, deadline=None, derandomize=True)
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
