"""Line protocols over a real tty (a pseudo terminal), and each of their faults."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, closing

import pytest
from thermocald_drivers import serial_line

from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.laboratory import check_readings
from thermocald import errors
from thermocald.hal import SystemClock, open_device

PATTERN = r"T=(?P<temperature>[-+]?\d+\.\d+)"


@pytest.fixture
def instrument():
    with ExitStack() as stack:
        yield lambda answers=None: stack.enter_context(closing(Instrument(answers)))


def thermometer(far, **options):
    options = {"port": far.port, "timeout_s": 0.4, **options}
    return open_device("thermometer", "serial", options, SystemClock())


def asked(far, **options):
    return thermometer(far, **{"pattern": PATTERN, "command": "T?\r\n", **options})


# (instrument, command as sent, line as received, values): from the instruments' manuals
PROTOCOLS = [
    ("vaisala-hmp", b"SEND\r", b"RH= 43.0 %RH T= 21.0 'C Tdp= 8.0 'C\r\n", {"temperature": 21.0}),
    ("vaisala-hmp", b"SEND\r", b"T= -7.3 'C\r\n", {"temperature": -7.3}),
    ("lakeshore-218", b"KRDG?\r\n",
     b"+293.15,+294.15,+295.15,+273.15,+300.00,+301.00,+302.00,+303.15\r\n",
     dict(zip((f"input{k}" for k in range(1, 9)),
              (20.0, 21.0, 22.0, 0.0, 26.85, 27.85, 28.85, 30.0), strict=True))),
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
    with thermometer(far, instrument="papouch-tm", timeout_s=1.0) as device:
        # the first piece after opening is the rest of a line, even if it matches
        thread = later(lambda: far.send(b"+003.5C\r+021.5C\r"))
        assert device.read().values == {"temperature": 21.5}
        thread.join()
        far.send(b"+099.9C\r3.5C\r+0")  # in the queue before the call: an old line, and half a line
        time.sleep(0.05)
        sent = []
        thread = later(lambda: (far.send(b"22.5C\r"), sent.append(time.monotonic())))
        reading = device.read()
        thread.join()
        assert reading.values == {"temperature": 22.5}
        assert reading.monotonic == pytest.approx(sent[0], abs=0.04)  # the end of the line
        with pytest.raises(errors.DeviceTimeout, match=r"silent for 1 s"):
            device.read()  # a line is never used twice


# what is in the queue before the command, the answer, and its end, which comes later
ANSWERS = {
    "in pieces": (b"", b"T=2", b"0.50\r\n"),
    "an old answer in the queue": (b"T=99.00\r\n", b"T=20.50\r\n", b""),
    "an echo": (b"", b"T?\r\nT=20.50\r\n", b""),
    "in UTF-16": (b"", "T=20.50\r\n".encode("utf-16-le"), b""),
    "with a mark of the byte order": (b"", "\ufeffT=20.50\r\n".encode("utf-16-le"), b""),
    "the other byte order": (b"", "\ufeffT=20.50\r\n".encode("utf-16-be"), b""),
    "garbage": (b"", b"\xff\x00\x91~\r\nready\r\nT=20.50\r\n", b""),
    "one channel without a sensor": (b"", b"T=20.5;A=-127.0;B=nan\r\n", b""),
    "a prompt, which is no late line": (b"T=9.00\r\n> ", b"T=20.50\r\n> ", b""),
}
SEVERAL = r"(?:;A=(?P<a>\S+);B=(?P<b>\S+))?"


@pytest.mark.parametrize("case", ANSWERS)
def test_the_answer_to_the_command_is_taken(instrument, case):
    before, answer, end = ANSWERS[case]
    far = instrument({b"T?\r\n": answer})
    with asked(far, pattern=PATTERN + SEVERAL) as device:
        far.send(before)
        time.sleep(0.05)
        thread = later(lambda: far.send(end), 0.15)
        reading = device.read()
        assert (reading.values, {*reading.missing}) == ({"temperature": 20.5}, {"a", "b"})
        thread.join()
    assert far.received == [b"T?\r\n"]


@pytest.mark.parametrize(
    ("answer", "error", "said"),
    [
        *((rubbish, errors.BadReading, "check 9600 Bd 8N1")
          for rubbish in (b"\xf8\x80\x00\xfe" * 20, b"\xf8\x80\r\n" * 20, b"T=\r\n")),
        (b"U" * 3000, errors.BadReading, "'U{40}'"),  # an endless line does not grow
        (b"T=20.", errors.BadReading, r"'T=20\.'"),
        (b"", errors.DeviceTimeout, r"silent for 0\.2 s"),
    ],
)  # fmt: skip
def test_rubbish_half_a_line_and_silence_say_what_they_are(instrument, answer, error, said):
    far = instrument({b"T?\r\n": answer} if answer else {})
    with asked(far, timeout_s=0.2) as device, pytest.raises(error, match=said):
        device.read()


@pytest.mark.parametrize("line", [b"+023.5C\r", b"T=+023.5C\r\n", b"  21.75 C\r\n"])
@pytest.mark.parametrize("reopened", [False, True])
def test_the_rest_of_a_late_line_is_no_answer(instrument, line, reopened):
    """Cut at every other byte: the late part is discarded, and the answer to this command used."""
    number = r"(?:T=)?\s*(?P<temperature>[-+]?\d*\.\d+) ?C"
    for cut in range(2, len(line), 2):
        far = instrument()
        device = thermometer(far, pattern=number, command="?\r", timeout_s=0.6)
        device.open()
        far.send(line[:cut])
        if reopened:
            time.sleep(0.02)
            device.close()
            device.open()
        rest = b"" if reopened else line[cut:]  # the late part is lost while it is closed
        far.answers = {b"?\r": [rest + b"+018.25C\r", b"+018.25C\r", b"+018.25C\r"]}
        with closing(device):
            assert device.read().values["temperature"] == 18.25 or not line[:cut].strip()


def test_a_pattern_that_takes_a_part_of_a_number(instrument):
    for pattern, line, expected in (
        (r".*(?P<t>[-+]?\d+\.\d+).*", "T=21.55 C", "skips '2'"),  # 1.55: `.*` takes what it can
        (r".*?(?P<t>\d+\.\d+).*", "T=-5.25 C", "skips '-'"),
        (r".*?(?P<t>\d+).*", "T=21.55 C", r"skips '\.'"),
        (r"CH1-(?P<t>[-+]?\d+\.\d+)", "CH1-23.4", 23.4),
        (r".*(?P<t>[-+]\d+\.\d)C", "0R0+021.5C", 21.5),
    ):
        far = instrument({b"T?\r\n": line.encode() + b"\r\n"})
        with asked(far, pattern=pattern) as device:
            check_readings(device, lambda _: None, [(line, expected)])


def test_the_first_line_after_a_pause_is_whole(instrument, monkeypatch):
    monkeypatch.setattr(serial_line, "PAUSE_S", 0.2)  # of a logger with one line per ten minutes
    far = instrument()
    with thermometer(far, pattern=PATTERN, timeout_s=0.6) as device:
        far.send(b"\0")
        thread = later(lambda: far.send(b"T=21.50\r\n"), 0.4)
        assert device.read().values == {"temperature": 21.5}
        thread.join()


def test_a_port_that_another_program_holds(instrument):
    far = instrument()
    with asked(far), pytest.raises(errors.DeviceDenied, match="another program holds the port"):
        asked(far).open()


FEWER, ENDS = "fewer decimals than earlier lines", "begins or ends with its decimal point"
CUT = {
    "a decimal is lost": [("21.56", 21.56), ("21.57", 21.57), ("21.5", FEWER)],
    "all decimals are lost": [("21.5", 21.5), ("21.4", 21.4), ("21", FEWER)],
    "they end with the point": [("21.5", 21.5), ("21.", ENDS)],
    "the first digits are lost": [("21.5", 21.5), (".5", ENDS), ("-.5", ENDS)],
    "of a mantissa": [("2.156E+01", 21.56), ("2.15E+01", FEWER)],
    "again and again": [("21.50", 21.5), ("21.5", FEWER), ("21.4", FEWER), ("21.3", FEWER),
                        ("21.51", 21.51)],
    "trailing zeros are left out": [("21.56", 21.56), ("21.5", FEWER), ("21.4", FEWER),
                                    ("21", 21.0), ("21.3", 21.3)],
    "more decimals than before": [("9.5", 9.5), ("9.51", 9.51)],
    "another sign and size": [("9.5", 9.5), ("10.5", 10.5), ("-1.5", -1.5)],
}  # fmt: skip


@pytest.mark.parametrize("case", CUT)
def test_a_number_that_lost_digits_is_none(instrument, case):
    far = instrument({})

    def put(number):
        far.answers[b"T?\r\n"] = f"T={number}\r\n".encode()

    with asked(far, pattern=r"T=(?P<temperature>\S+)") as device:
        check_readings(device, put, CUT[case])
