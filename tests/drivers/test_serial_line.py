"""Line protocols over a real tty (a pseudo terminal), and each of their faults."""

from __future__ import annotations

import threading
import time

import pytest

from tests.drivers.fakes.pty_instrument import Instrument
from thermocald import errors
from thermocald.hal import SystemClock, open_device

PATTERN = r"T=(?P<temperature>[-+]?\d+\.\d+)"


@pytest.fixture
def instrument():
    made = []

    def make(answers=None):
        made.append(Instrument(answers))
        return made[-1]

    yield make
    for one in made:
        one.close()


def thermometer(far, **options):
    options = {"port": far.port, "timeout_s": 0.4, **options}
    return open_device("thermometer", "serial", options, SystemClock())


def asked(far, **options):
    return thermometer(far, **{"pattern": PATTERN, "command": "T?\r\n", **options})


# (instrument, command as sent, line as received, values): from the instruments' manuals
PROTOCOLS = [
    ("vaisala-hmp", b"SEND\r", b"RH= 43.0 %RH T= 21.0 'C Tdp= 8.0 'C\r\n", {"temperature": 21.0}),
    ("vaisala-hmp", b"SEND\r", b"T= -7.3 'C\r\n", {"temperature": -7.3}),
    (
        "lakeshore-218",
        b"KRDG?\r\n",
        b"+293.15,+294.15,+295.15,+273.15,+300.00,+301.00,+302.00,+303.15\r\n",
        {f"input{k}": celsius for k, celsius in enumerate(
            (20.0, 21.0, 22.0, 0.0, 26.85, 27.85, 28.85, 30.0), 1)},
    ),
    ("fluke-1522", b"read?\r", b"t: 25.587 C\r\n", {"temperature": 25.587}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "command", "line", "values"), PROTOCOLS)
def test_instruments_by_name(instrument, name, command, line, values):
    far = instrument({command: line})
    with thermometer(far, instrument=name) as device:
        assert device.read().values == pytest.approx(values, abs=1e-9)
    assert far.received == [command]


def later(action, seconds=0.05):
    thread = threading.Timer(seconds, action)
    thread.start()
    return thread


def test_an_instrument_that_speaks_by_itself(instrument):
    far = instrument()
    with thermometer(far, instrument="papouch-tm", timeout_s=2.0) as device:
        far.send(b"+099.9C\r3.5C\r+0")  # in the queue before the call: an old line, and half a line
        time.sleep(0.05)
        sent = []
        thread = later(lambda: (far.send(b"21.5C\r"), sent.append(time.monotonic())))
        reading = device.read()
        thread.join()
    assert reading.values == {"temperature": 21.5}
    assert reading.monotonic == pytest.approx(sent[0], abs=0.04)  # the end of the line


def test_the_rest_of_a_line_is_no_reading(instrument):
    """`3.5C` of `+023.5C`: the first piece after opening is discarded, even if it matches."""
    far = instrument()
    with thermometer(far, pattern=r"(?P<temperature>[-+]?\d+\.\d)C", timeout_s=1.0) as device:
        thread = later(lambda: far.send(b"3.5C\r+021.5C\r"))
        assert device.read().values == {"temperature": 21.5}
        thread.join()


def test_a_line_is_never_used_twice(instrument):
    far = instrument()
    with thermometer(far, instrument="papouch-tm", timeout_s=0.3) as device:
        thread = later(lambda: far.send(b"\r+021.5C\r"))
        device.read()
        thread.join()
        with pytest.raises(errors.DeviceTimeout, match=r"silent for 0\.3 s"):
            device.read()


def test_an_old_answer_in_the_queue_is_not_taken(instrument):
    far = instrument({b"T?\r\n": b"T=20.00\r\n"})
    with asked(far) as device:
        far.send(b"T=99.00\r\n")
        time.sleep(0.05)
        assert device.read().values == {"temperature": 20.0}


def test_an_answer_in_pieces(instrument):
    far = instrument({b"T?\r\n": b"T=2"})
    with asked(far) as device:
        thread = later(lambda: far.send(b"0.25\r\n"), 0.15)
        assert device.read().values == {"temperature": 20.25}
        thread.join()


@pytest.mark.parametrize("before", [b"T?\r\n", b"\xff\x00\x91~\r\nready\r\n"])
def test_echo_and_garbage_before_the_answer_are_skipped(instrument, before):
    far = instrument({b"T?\r\n": before + b"T=20.50\r\n"})
    with asked(far) as device:
        assert device.read().values == {"temperature": 20.5}


@pytest.mark.parametrize(
    ("answer", "error", "said"),
    [
        *((rubbish, errors.BadReading, "check 9600 Bd 8N1")
          for rubbish in (b"\xf8\x80\x00\xfe" * 20, b"\xf8\x80\r\n" * 20, b"T=\r\n")),
        (b"T=20.", errors.BadReading, r"'T=20\.'"),
        (b"", errors.DeviceTimeout, r"silent for 0\.2 s"),
    ],
)  # fmt: skip
def test_rubbish_half_a_line_and_silence_say_what_they_are(instrument, answer, error, said):
    far = instrument({b"T?\r\n": answer} if answer else {})
    with asked(far, timeout_s=0.2) as device, pytest.raises(error, match=said):
        device.read()


def test_an_endless_line_does_not_grow(instrument):
    far = instrument({b"T?\r\n": b"U" * 3000})
    with asked(far, timeout_s=0.2) as device:
        with pytest.raises(errors.BadReading):
            device.read()
        assert len(device._line) <= 1


CHECKED = PATTERN + r"\*(?P<checksum>[0-9A-F]{2})"


@pytest.mark.parametrize("kind", ["xor", "sum8", "nmea"])
def test_checksums(instrument, kind):
    text = b"T=20.50*"
    expected = {"xor": 0, "sum8": sum(text) % 256, "nmea": 0}
    for byte in text:
        expected["xor"] ^= byte
    for byte in text[:-1]:
        expected["nmea"] ^= byte
    answers = [b"T=20.50*%02X\r\n" % expected[kind], b"T=20.51*%02X\r\n" % expected[kind]]
    far = instrument({b"T?\r\n": answers})
    with asked(far, pattern=CHECKED, checksum=kind, timeout_s=0.2) as device:
        assert device.read().values == {"temperature": 20.5}
        with pytest.raises(errors.BadReading, match="checksum"):
            device.read()


def answer(instrument, line, **options):
    """Return the driver's °C of one line, or None if it is rejected."""
    far = instrument({b"T?\r\n": line + b"\r\n"})
    with asked(far, **{"timeout_s": 0.15, **options}) as device:
        try:
            return device.read().values["temperature"]
        except errors.BadReading:
            return None


DEGREES = r"(?P<temperature>[-+]?\d+\.\d+) ?°C"


@pytest.mark.parametrize("sign", ["°".encode(), b"\xb0", b"\xf8", b"\xdf", "º".encode()])
def test_degree_signs_of_other_encodings(instrument, sign):
    assert answer(instrument, b"27.0" + sign + b"C", pattern=DEGREES, timeout_s=2.0) == 27.0


def test_the_checksum_is_of_the_bytes(instrument):
    line = "T=20.50°C*".encode()
    total = sum(line) % 256
    pattern = r"T=(?P<temperature>[\d.]+)°C\*(?P<checksum>..)"
    checked = {"pattern": pattern, "checksum": "sum8", "timeout_s": 2.0}
    for text in (line + b"%02X", line + b"%02x"):
        assert answer(instrument, text % total, **checked) == 20.5


def test_one_channel_without_a_sensor_does_not_take_the_others_along(instrument):
    far = instrument({b"T?\r\n": b"20.5;-127.0;nan\r\n"})
    pattern = r"(?P<a>\S+);(?P<b>\S+);(?P<d>\S+)"
    with asked(far, pattern=pattern) as device:
        assert device.read().values == {"a": 20.5}


def test_no_such_port():
    options = {"port": "/dev/ttyNONE", "instrument": "papouch-tm"}
    device = open_device("thermometer", "serial", options, SystemClock())
    where = "^papouch-tm on /dev/ttyNONE: No such file or directory; check .* dialout$"
    with pytest.raises(errors.DeviceNotFound, match=where):
        device.open()


def test_a_port_that_another_program_holds(instrument):
    far = instrument()
    with asked(far), pytest.raises(errors.DeviceDenied, match="another program holds the port"):
        asked(far).open()


CUT = {
    "a decimal is lost": (["21.56", "21.57", "21.5"], [21.56, 21.57, None]),
    "all decimals are lost": (["21.5", "21.4", "21"], [21.5, 21.4, None]),
    "they end with the point": (["21.5", "21."], [21.5, None]),
    "the first digits are lost": (["21.5", ".5", "-.5"], [21.5, None, None]),
    "of a mantissa": (["2.156E+01", "2.15E+01"], [21.56, None]),
    "again and again": (["21.50", "21.5", "21.4", "21.3", "21.51"], [21.5, *[None] * 3, 21.51]),
    "trailing zeros are left out": (
        ["21.56", "21.5", "21.4", "21", "21.3"], [21.56, None, None, 21.0, 21.3]),
    "more decimals than before": (["9.5", "9.51"], [9.5, 9.51]),
    "another sign and size": (["9.5", "10.5", "-1.5"], [9.5, 10.5, -1.5]),
}  # fmt: skip


@pytest.mark.parametrize("case", CUT)
def test_a_number_that_lost_digits_is_none(instrument, case):
    lines, expected = CUT[case]
    far, found = instrument({}), []
    with asked(far, pattern=r"T=(?P<temperature>\S+)") as device:
        for line in lines:
            far.answers[b"T?\r\n"] = f"T={line}\r\n".encode()
            try:
                found.append(device.read().values["temperature"])
            except errors.BadReading:
                found.append(None)
    assert found == expected
