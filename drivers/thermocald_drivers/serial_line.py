r"""Thermometers that send lines of text on a serial port.

    thermometers:
      - {name: air, driver: serial, port: /dev/ttyUSB0, instrument: vaisala-hmp}
      - name: probe
        driver: serial
        port: /dev/serial/by-id/usb-FTDI_FT232R_A50285BI-if00-port0   # the same after a re-plug
        baud: 9600
        framing: 8N1                            # data bits, parity (N, E, O), stop bits
        command: "T?\\r\\n"                      # sent for each reading; empty: sends unprompted
        pattern: 'T=(?P<temperature>[-+]?\\d+\\.\\d+)F\\*(?P<checksum>[0-9A-F]{2})'
        unit: F                                 # C (default), F, K; mA: of a 4 … 20 mA loop
        scale: 1.0                              # factor of the printed number
        offset: 0.0                             # added after the scale
        timeout_s: 2                            # without a command: more than between two lines
        minimum_c: -60                          # and maximum_c: 125; instruments: -100 … 300
        chip: sht31                             # the sensor behind the firmware, if known
        refuse_c: [-127, -50, -46.85, -45, 85]  # values that mean "no sensor"
        checksum: xor                           # of the text before it: xor, sum8, nmea

Each named group of `pattern` is a channel; its number is scaled, offset, and converted to °C by
`unit`. The pattern must match the **whole** line: the rest of a line that lost its start (`3.5C` of
`+023.5C`) is not a reading. A decimal comma is read as a point. A `°` in the pattern matches the
degree signs of UTF-8, UTF-16, Latin-1, code page 437 and LCD fonts. For named instruments see
INSTRUMENTS.

Firmware prints a fixed number if its sensor does not answer: −127 and 85 (DS18B20), −45 and −46.85
(SHT), −50 (an input at 0 V), −40 and 125 (ends of a scale); `chips` lists them. With `pattern` they
are rejected as **printed**, before scale and offset, rounded or truncated as in the line;
`refuse_c` replaces the list, and [] accepts all. Accepted only with a recent reading within 5 K are
0, words of all ones, the ends of displays and transmitters (-99.9, -200, 850), and with `chip` its
further idle values (25.00 of an LSM6DS3). A number is rejected as incomplete if it has fewer
decimals than earlier lines, begins or ends with its point, or if the pattern skips a digit, sign or
point beside it (`.*`). With `instrument`, the instrument's
own error texts serve instead. A loop current below 3.6 or above 21 mA means a broken loop (NAMUR
NE 43).

A line that was in the queue before the reading was requested is never used. With `command`, the
driver waits until the line is quiet, discards the end of an unfinished line and then repeats the
command; without it, the next line that *ends* after the call counts, the first after opening only
if a pause of 2 s precedes it. Echo, garbage and prompts are skipped until `timeout_s`; the error
then quotes what was received.
Source: the instruments' manuals, named with each.
"""

from __future__ import annotations

import contextlib
import os
import re
import termios
import time
from dataclasses import replace
from decimal import Decimal
from functools import partial, reduce
from operator import xor
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceTimeout
from thermocald.hal import DriverOptions, Found, Reading
from thermocald_drivers import chips, support

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

NUMBER = r"[-+]?\d+(?:\.\d+)?"
WHOLE_NUMBER = re.compile(r"[-+]?[0-9]+(?:[.,][0-9]+)?(?:[eE][-+]?[0-9]+)?")
FRAMING = "is not data bits, parity (N, E, O) and stop bits, such as 8N1"
LONGEST_LINE = 512
DEGREES = str.maketrans("ºø˚∘ß℃", "°°°°°°")
"""Degree signs of other encodings as Latin-1 text: masculine ordinal, 0xF8, 0xDF."""
PAUSE_S = 2.0
POLL_S = 0.05  # changing pyserial's time-out later would configure the port again
QUEUE = 4000
"""A queue of this many bytes may have overflowed the kernel's buffer (4096)."""
PROMPTS = b">#$%?]:"
NO_SENSOR_STEP_K = 0.006
LOOP_MA = (3.6, 21.0)
CORRECTION = (0.5, 2.0)
"""A scale within these bounds corrects a temperature; any other is the number's format."""
ENDS_OF_WORDS = {32767, 32768, 65535}
"""Digits of 16 bits at the end of their range, with the point anywhere (655.35)."""
FULL_SCALE = {-1.0, 1023.0, 4095.0, 16383.0, 32767.0, 65535.0}


# their own error texts report that nothing was measured, so that `refuse_c` is empty
INSTRUMENTS: Mapping[str, dict[str, Any]] = {
    # Papouch TM, TMU: sends unprompted every 10 s; lines end with CR alone.
    "papouch-tm": {"pattern": r"(?P<temperature>[-+]\d{3}\.\d)C", "timeout_s": 22.0},
    # Vaisala HMP230/240/260 series, user's guides, appendix "Serial commands".
    "vaisala-hmp": {
        "pattern": rf"(?:RH= *{NUMBER} *%RH +)?T= *(?P<temperature>{NUMBER}) *'C(?: .*)?",
        "command": "SEND\r", "baud": 4800, "framing": "7E1",
    },
    # Lake Shore 218, user's manual 6.2: eight inputs in one line; kelvin has no negative values.
    "lakeshore-218": {
        "pattern": ",".join(rf"(?P<input{k}>[-+]\d+\.\d+)" for k in range(1, 9)),
        "command": "KRDG?\r\n", "framing": "7O1", "unit": "K",
    },
    # Fluke 1522, user's guide 8.2.1; the unit is set at the instrument and must be C.
    "fluke-1522": {
        "pattern": r"t: *(?P<temperature>[-+]?\d+\.\d+) C", "command": "read?\r", "baud": 2400,
    },
}  # fmt: skip


CHECKSUMS: Mapping[str, Callable[[bytes], int]] = {
    "xor": lambda text: reduce(xor, text, 0),
    "sum8": lambda text: sum(text) & 0xFF,
    "nmea": lambda text: reduce(xor, text.strip(b"$*"), 0),
}
# °C = factor · (number − zero)
UNITS: Mapping[str, tuple[float, float]] = {
    "C": (1.0, 0.0), "F": (1 / 1.8, 32.0), "K": (1.0, 273.15), "mA": (1.0, 0.0),
}  # fmt: skip


class SerialThermometer(support.CheckedThermometer):
    """A thermometer with a line protocol, given by a pattern or an instrument's name."""

    device_classes = ("char-ttyUSB", "char-ttyACM", "char-ttyAMA", "char-ttyS")

    class Options(DriverOptions):
        """The options of `serial`; INSTRUMENTS has those of each instrument."""

        port: support.Text
        instrument: Literal["papouch-tm", "vaisala-hmp", "lakeshore-218", "fluke-1522"] | None = (
            None
        )
        pattern: support.Text
        command: Annotated[str, support.like(r"[\x00-\x7f]*", "holds more than ASCII")] = ""
        baud: Annotated[int, Field(ge=50, le=4_000_000)] = 9600
        framing: Annotated[str, support.like("[5-8][NEO][12]", FRAMING)] = "8N1"
        unit: Literal["C", "F", "K", "mA"] = "C"
        scale: Annotated[float, Field(ge=-1e6, le=1e6)] = 1.0
        offset: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
        checksum: Literal["none", "xor", "sum8", "nmea"] = "none"
        timeout_s: Annotated[float, Field(ge=0.01, le=3600.0)] = 2.0
        minimum_c: support.Celsius = -60.0
        maximum_c: support.Celsius = 125.0
        chip: support.Text | None = None
        refuse_c: list[support.Celsius] = Field(default=list(chips.FIRMWARE_C))

        @model_validator(mode="before")
        @classmethod
        def _of_the_instrument(cls, data: dict[str, Any]) -> dict[str, Any]:
            name = data.get("instrument")
            if (name is None) == (data.get("pattern") is None):
                raise ConfigurationError(
                    f"set either instrument: ({', '.join(INSTRUMENTS)}) or pattern:"
                )
            own = {}
            if isinstance(name, str) and name in INSTRUMENTS:
                own = {"minimum_c": -100.0, "maximum_c": 300.0, "refuse_c": [], **INSTRUMENTS[name]}
            return {**own, **{key: value for key, value in data.items() if value is not None}}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        self.where = f"{o.instrument or 'serial line'} on {o.port}"
        self.command = o.command.encode("ascii")
        if o.chip is not None and o.chip.lower() not in chips.BY_NAME:
            known = ", ".join(sorted(chips.BY_NAME))
            raise ConfigurationError(f"chip: {o.chip!r} is not one of {known}")
        if o.scale == 0.0:
            raise ConfigurationError("scale: 0 makes every number the same")
        if o.unit == "mA" and o.scale == 1.0:
            raise ConfigurationError("unit: mA needs scale: (K per mA) and offset: (°C at 0 mA)")
        self._corrects = CORRECTION[0] <= abs(o.scale) <= CORRECTION[1]
        try:
            self.pattern = re.compile(o.pattern, re.ASCII)  # not the digits of other scripts
        except re.error as error:
            raise ConfigurationError(f"pattern: {o.pattern!r}: {error}") from error
        self.channels = [name for name in self.pattern.groupindex if name != "checksum"]
        if not self.channels:
            raise ConfigurationError("pattern: name the value, such as (?P<temperature>[-+0-9.]+)")
        if o.checksum != "none" and "checksum" not in self.pattern.groupindex:
            raise ConfigurationError("pattern: a checksum needs a group (?P<checksum>…)")
        self._decimals: dict[str, tuple[int, bool, int]] = {}
        self._line = b""
        self._synchronous = False

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """List the serial ports by their permanent names; what is connected cannot be known."""
        ports = support.library("serial.tools.list_ports").comports(include_links=True)
        links = [p for p in ports if "/by-id/" in p.device]
        return [
            Found(
                {"port": p.device, "instrument": "papouch-tm"},
                f"{p.description}; set the instrument connected to it",
                certain=False,
            )
            for p in (links or [p for p in ports if p.hwid != "n/a"])
        ]

    def open(self) -> None:
        serial = support.library("serial")
        data_bits, parity, stop_bits = tuple(self.options.framing)
        try:
            self.handle = serial.Serial(
                self.options.port,
                self.options.baud,
                bytesize=int(data_bits),
                parity=parity,
                stopbits=int(stop_bits),
                timeout=POLL_S,
                write_timeout=self.options.timeout_s,
                exclusive=True,
            )
        except ValueError as error:
            raise ConfigurationError(f"{self.where}: {error}") from error
        except OSError as error:
            if "exclusively lock" in str(error):
                error = OSError(16, "another program holds the port")
            elif error.errno:  # pyserial's text quotes the port and the error once more
                error = OSError(error.errno, os.strerror(error.errno))
            hint = "check that it is plugged in and the user is in the group dialout"
            raise support.fault(error, self.where, seen=self.seen, hint=hint) from error
        self.seen = self._owed = True
        self._decimals.clear()
        if not self.command:
            self._line, self._synchronous = b"", False

    def named_channels(self) -> list[str]:
        return list(self.channels)

    def read(self) -> Reading:
        self.opened()
        try:
            if self.command:
                self._ask()
            else:
                self._skip_queue()
            start = self.clock.monotonic()
            match, ended = self._next_match()
            self._owed = False
        except (OSError, termios.error) as error:  # a termios.error is no OSError
            if isinstance(error, BadReading | DeviceTimeout):
                raise
            if isinstance(error, support.library("serial").SerialTimeoutException):
                raise DeviceTimeout(f"{self.where}: cannot send, flow control blocks it") from error
            # pyserial reports an unplug without an errno, or with EIO
            raise DeviceGone(f"{self.where}: unplugged ({error})") from error
        measures = {
            channel: (f"{self.where}, {channel}", partial(self._celsius, channel, match))
            for channel in self.channels
        }
        reading = self.reading(measures, start)
        if self.command:
            return reading
        monotonic, utc = support.on_clock(self.clock, ended)
        return replace(reading, monotonic=monotonic, utc=utc)

    def _received(self, least: int = 1) -> bytes:
        """Read what has come; CR, LF and CR LF all end a line, and empty lines are skipped."""
        return bytes(self.handle.read(max(least, self.handle.in_waiting))).replace(b"\r", b"\n")

    def _ask(self) -> None:
        """Wait for a quiet line, note whether its last line is unfinished, and send the command."""
        late, deadline = self._line, time.monotonic() + self.options.timeout_s
        while (self._owed or late or self.handle.in_waiting) and time.monotonic() < deadline:
            # the answer to an earlier command, or the rest of it, may still arrive
            if not (more := self._received()):
                break
            late += more
        rest = late.rpartition(b"\n")[2].strip(b" \0")
        # the rest of a late line would look like a whole line; a prompt does not
        self._synchronous = not rest or rest[-1:] in PROMPTS
        self._line, self._owed = b"", True
        self.handle.write(self.command)

    def _skip_queue(self) -> None:
        """Discard the complete lines received so far, but not the start of the current one."""
        waiting = self._received(0)
        if len(waiting) >= QUEUE:
            self._line, self._synchronous = b"", False  # bytes may be missing
            return
        _, ended, self._line = (self._line + waiting).rpartition(b"\n")
        self._synchronous |= bool(ended)

    def _next_match(self) -> tuple[re.Match[str], float]:
        """Return the next line that matches, and the machine's monotonic time at its end."""
        heard = time.monotonic()
        deadline = heard + self.options.timeout_s
        skipped: list[str] = []
        problem = ""
        while True:
            while b"\n" in self._line:
                line, self._line = self._line.split(b"\n", 1)
                whole, self._synchronous = self._synchronous, True
                if not whole and self.command:
                    self.handle.write(self.command)  # the answer may have been joined to it
                line = line.strip(b"\0")
                wide = re.sub(rb"\A(\xff\xfe|\xfe\xff\0)", b"", line)  # without a byte-order mark
                if len(wide) > 8 and not any(wide[1::2]):  # UTF-16
                    line = wide[::2]
                if not line or not whole or line.strip() == self.command.strip():
                    continue
                match = next(filter(None, map(self.pattern.fullmatch, _decodings(line))), None)
                if match is None:
                    skipped.append(line.decode("ascii", "backslashreplace"))
                    continue
                problem = self._checksum_problem(match, line)
                if not problem:
                    return match, time.monotonic()
                skipped.append(match.string)
            if len(self._line) > LONGEST_LINE:
                skipped.append(self._line[:40].decode("ascii", "backslashreplace"))
                self._line, self._synchronous = b"", False
            if time.monotonic() >= deadline:
                raise self._nothing(skipped, problem)
            if received := self._received():
                heard = time.monotonic()
            elif not self._line.strip(b"\0") and time.monotonic() - heard > PAUSE_S:
                self._synchronous = True  # what comes next is the start of a line
            self._line += received

    def _nothing(self, skipped: list[str], problem: str) -> BadReading | DeviceTimeout:
        """Return the error for a time-out, which names the fault of the lines received."""
        rest = self._line.decode("ascii", "backslashreplace")
        # the next reading's command discards the end of this line
        self._line, self._synchronous = self._line[-1:] if self.command else b"", False
        if problem:
            return BadReading(f"{self.where}: {problem}")
        if skipped or rest:
            o = self.options
            quoted = "; ".join(repr(text[:60]) for text in [*skipped, rest][:3] if text)
            return BadReading(
                f"{self.where}: no line matches the pattern in {o.timeout_s:g} s; received: "
                f"{quoted}; check {o.baud} Bd {o.framing}"
            )
        return DeviceTimeout(f"{self.where}: silent for {self.options.timeout_s:g} s")

    def _checksum_problem(self, match: re.Match[str], line: bytes) -> str:
        if self.options.checksum == "none":
            return ""
        given = match["checksum"] or ""
        if not re.fullmatch(r"[0-9A-Fa-f]{1,4}", given):
            return f"checksum {given!r} in {match.string!r} is not hexadecimal"
        # the checksum covers the bytes before it
        after = len(match.string[match.start("checksum") :].encode("latin-1", "replace"))
        computed = CHECKSUMS[self.options.checksum](line[: len(line) - after])
        if int(given, 16) == computed:
            return ""
        return f"checksum {given} in {match.string!r}, computed {computed:02X}"

    def _celsius(self, channel: str, match: re.Match[str]) -> float:
        """Convert a printed number to °C; BadReading if it means that nothing was measured."""
        text = match[channel] or ""
        if not text:
            raise BadReading(f"{self.where}, {channel}: {match.string!r} has no value of it")
        number = support.parse_number(text, comma=True)
        where = f"{self.where}, {channel}: {text}"
        if skipped := self._skipped(match, channel):
            raise BadReading(
                f"{where} may be a part of a number: the pattern skips {skipped!r} beside it; "
                "write what precedes and follows the number into the pattern"
            )
        exponent = Decimal(text.strip().replace(",", ".")).as_tuple().exponent
        decimals = max(0, -int(exponent))
        self._require_whole(channel, re.split("[eE]", text.strip())[0], where)
        factor, zero = UNITS[self.options.unit]
        celsius = factor * (number * self.options.scale + self.options.offset - zero)
        if self.options.unit == "mA" and not LOOP_MA[0] <= number <= LOOP_MA[1]:
            raise BadReading(f"{where} mA is a broken loop, not within 3.6 … 21 mA (NAMUR NE 43)")
        self.require_range(celsius, where)
        if any(
            self._printed(number, decimals, refused) or abs(celsius - refused) < NO_SENSOR_STEP_K
            for refused in self.options.refuse_c
        ):
            raise BadReading(
                f"{where} is what firmware prints without a sensor; if it is a temperature, set "
                "refuse_c: []"
            )
        idle = self._idle(number, decimals) if self.options.refuse_c else ""
        return self.judge(channel, where, celsius, idle)

    def _skipped(self, match: re.Match[str], channel: str) -> str:
        """Return a character of the number that the pattern skips, as `.*` does, or ""."""
        line, (begin, end) = match.string, match.span(channel)
        for number in WHOLE_NUMBER.finditer(line):
            for cut, beside in ((begin, begin - 1), (end, end)):
                blanked = f"{line[:beside]}\0{line[beside + 1 :]}"
                if number.start() < cut < number.end() and self.pattern.fullmatch(blanked):
                    return line[beside]
        return ""

    def _require_whole(self, channel: str, mantissa: str, where: str) -> None:
        """Raise BadReading for a number that lost digits, since firmware always prints as many.

        If trailing zeros are omitted (21.5 after 21.56), at most two readings are rejected.
        """
        whole, point, digits = mantissa.replace(",", ".").partition(".")
        if point and not (digits and whole.strip("+-")):
            raise BadReading(f"{where} begins or ends with its decimal point; the line may be cut")
        most, zeros, fewer = self._decimals.get(channel, (len(digits), False, 0))
        short = len(digits) < most
        zeros |= len(digits) >= max(most, 2) and digits.endswith("0")
        self._decimals[channel] = max(most, len(digits)), zeros, fewer + short
        if short and (zeros or fewer < 2):
            raise BadReading(f"{where} has fewer decimals than earlier lines; the line may be cut")

    def _printed(self, number: float, decimals: int, celsius: float) -> bool:
        """Return whether a number is a temperature before the offset, or before the scale."""
        factor, zero = UNITS[self.options.unit]
        scales = {self.options.scale, 1.0} if self._corrects else {self.options.scale}
        return any(chips.prints(number, decimals, (celsius / factor + zero) / s) for s in scales)

    def _idle(self, number: float, decimals: int) -> str:
        """Return why a number may be an idle value, in words, or ""."""
        idle = (0.0, *chips.ENDS_C, *chips.idle_celsius(self.options.chip or ""))
        if decimals >= 2:
            idle += (-0.0625, -0.0078125)
        if (
            number == 0.0
            or (number == -1.0 and not decimals)  # of a library that failed
            or round(abs(number) * 10**decimals) in ENDS_OF_WORDS
            or any(self._printed(number, decimals, one) for one in idle)
            or (not self._corrects and number in FULL_SCALE)
        ):
            return "what is printed without a sensor (refuse_c: [] accepts it)"
        return ""


def _decodings(line: bytes) -> Iterator[str]:
    """Yield a line as text: UTF-8 if valid, then Latin-1, each also with every degree sign as °."""
    for encoding in ("utf-8", "latin-1"):
        with contextlib.suppress(UnicodeDecodeError):
            text = line.decode(encoding)
            yield text
            yield text.translate(DEGREES)
