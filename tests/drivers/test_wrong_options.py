"""Stanzas that are rejected when they are read, with the option and its fault."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drivers.test_contract import REGISTERED
from thermocald.errors import ConfigurationError, DriverMissing
from thermocald.hal import VirtualClock, load_driver, open_device

SIZE = {"width": 96, "height": 64}
V4L2 = {"device": "/dev/video0", **SIZE}
PHONE = {"serial": "X"}
PATTERN = r"T=(?P<temperature>[-+]?\d+\.\d+)"
HEAT = {"limit_c": 60, "programme": [{"seconds": 1000, "hold_c": 45.0}]}
OPEN = {"host": "x", "sender": "a@b", "recipients": ["a@b"], "when": [{"drift": "c", "px": 0.5}],
        "username": "u", "password_file": "p", "security": "none"}  # fmt: skip
# {driver: (options of all its rows, [(further options, message)])}
WRONG = {
    ("camera", "v4l2"): (V4L2, [
        ({"device": None}, "either device"), ({"serial": "x"}, "either device"),
        ({"pixel_format": "PNG"}, "'PNG' is not one of"),
        ({"focus": "manual"}, "neither a number nor auto"),
        ({"exposure_s": "long", "gain": "high"}, r"exposure_s.*\(and 1 more\)"),
    ]),
    ("camera", "picamera2"): ({}, [
        ({"colour_gains": [1.0]}, "colour_gains"), ({"colour_gains": "warm"}, "colour_gains")]),
    ("camera", "android"): ({**PHONE, **SIZE}, [({"trigger": "tap"}, "tap")]),
    ("camera", "replay"): ({}, [({}, "recording: is missing")]),
    ("thermometer", "android"): (PHONE, [
        ({"sensors": {"skin": "thermal:y"}, "units": {"skin": "degC"}}, "units"),
        *(({"sensors": {"temperature": source}}, "neither battery")
          for source in ("batery", "thermal", "zone:", "battery:x")),
    ]),
    **{("thermometer", chip): ({}, [({"address": 0x50}, "0x50 is not an address of a")])
       for chip in ("bme280", "lm75", "mcp9808", "sht3x", "tmp117")},
    ("thermometer", "ds18b20"): ({}, [
        ({"sensors": {"camera": "28-1", "air": "28-1"}}, "sensors: 28-1 is given twice")]),
    ("thermometer", "thermal_zone"): ({}, [
        ({"zone": "pm8150b-vbat-lvl0"}, "set unit: thousandths")]),
    ("thermometer", "serial"): ({"port": "/dev/null"}, [
        ({}, "either instrument"), ({"pattern": "("}, "pattern"),
        ({"pattern": r"\d+"}, "name the value"),
        ({"pattern": PATTERN, "checksum": "xor"}, "needs a group"),
        ({"pattern": PATTERN, "framing": "9N1"}, "framing: '9N1' is not data bits, parity"),
        ({"instrument": "acme"}, "instrument: is 'acme'; must be 'papouch-tm'"),
        ({"pattern": PATTERN, "unit": "mA"}, "mA needs scale"),
        ({"pattern": PATTERN, "scale": 0.0}, "0 makes every number the same"),
        ({"pattern": PATTERN, "chip": "sht99"}, "chip: 'sht99' is not one of"),
        ({"pattern": PATTERN, "command": "T°"}, "command"),
        ({"pattern": PATTERN, "minimum_c": 200}, "minimum_c 200 is not below maximum_c 125"),
    ]),
    ("thermometer", "mock"): ({}, [
        ({"programme": [[0, 20], [0, 30]]}, "times must increase"),
        ({"programme": [0, 20]}, "must be a list"), ({"programme": [[0, 20, 3]]}, "list of"),
        ({"programme": [[0, -300]]}, "programme"),  # an impossible temperature
        ({"channels": {"t": {"lag": 3}}}, "channels.t.lag: unknown; is 'lag_s' meant"),
        ({"seed": 1.5}, "seed: is 1.5; must be a whole nu"),
    ]),
    ("output", "mock"): ({}, [
        *(({"faults": [{"kind": "timeout", **plan}]}, message) for plan, message in [
            ({"kind": "explode"}, r"faults\[0\].kind: is 'explode'; must be 'timeout'"),
            ({"at": 3, "for_s": 2}, r"faults\[0\]: .*belong together"),
            ({"at": 3, "at_s": 1, "for_s": 2}, "either `at`"),
        ]),
        ({"faults": ["timeout"]}, r"faults\[0\]: is 'timeout'"),
    ]),
    ("output", "relay"): ({"pin": 27, **HEAT}, [
        ({"limit_c": 45}, "hold_c: 45 °C is not below the limit"), ({"pin": 99}, "pin"),
        ({"programme": []}, "must list at least 1"),
    ]),
    # a limit above what a battery survives
    ("output", "android_load"): ({**PHONE, **HEAT}, [({}, "limit_c: is 60; must be at most")]),
    ("output", "mqtt"): ({"host": "x"}, [
        ({"password_file": "y"}, "username"), ({"key": "y"}, "cert"),
        *(({"topic": topic}, "is not a topic") for topic in ("", "/$SYS", "a/#"))]),
    ("output", "alert_mail"): (OPEN, [
        ({}, "without TLS"), ({"username": None}, "one needs the other"),
        ({"recipients": ["x"]}, r"recipients\[0\]: 'x' is not an e-mail")]),
    ("output", "alert_exec"): ({"command": ["true"]}, [
        ({"when": [when]}, "when") for when in (
            {}, {"drift": "c"}, {"drift": "c", "px": 1, "sds": 2}, {"temperature": "t"},
            {"no_result": 1, "px": 2}, {"temperature": "t", "above_c": 5, "below_c": 4})
    ] + [({"when": [{"no_result": 1}] * 2}, "no_result is given twice")]),
    ("output", "jsonl"): ({}, [({"path": ""}, "path: '' is empty or holds a NUL")]),
}  # fmt: skip
MISSING = [
    ("v4l2", {**V4L2, "backend": "linuxpy"}, "linuxpy.video.device", r"thermocald\[v4l2\]"),
    ("android", {**PHONE, **SIZE}, "adbutils", r"thermocald\[android\]"),
    ("picamera2", {}, "picamera2", "'picamera2' is not installed"),
]


@pytest.mark.parametrize("driver", WRONG, ids="-".join)
def test_a_wrong_option_is_named(driver):
    common, rows = WRONG[driver]
    for options, message in rows:
        with pytest.raises(ConfigurationError, match=message):
            open_device(*driver, {**common, **options}, VirtualClock())


@pytest.mark.parametrize(("name", "options", "module", "message"), MISSING)
def test_a_library_that_is_missing_is_named(name, options, module, message, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DriverMissing, match=message):
        open_device("camera", name, options, VirtualClock()).open()


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
