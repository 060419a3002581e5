r"""Thermometers on a serial line that send lines of text.

    thermometers:
      - {name: air, driver: serial, port: /dev/ttyUSB0, instrument: vaisala-hmp}
      - name: probe
        driver: serial
        port: /dev/serial/by-id/usb-FTDI_FT232R_A50285BI-if00-port0   # the same after a re-plug
        baud: 9600
        framing: 8N1                            # data bits, parity (N, E, O), stop bits
        command: "T?\\r\\n"                      # sent for each reading; empty: it sends by itself
        pattern: 'T=(?P<temperature>[-+]?\\d+\\.\\d+)F\\*(?P<checksum>[0-9A-F]{2})'
        unit: F                                 # C (default), F, K
        scale: 1.0                              # times the number, then
        offset: 0.0                             # added
        timeout_s: 2
        minimum_c: -60                          # and maximum_c: 125; instruments: -100 … 300
        refuse_c: [-127, -50, -46.85, -45, -40, 85, 125]   # values that mean "no sensor"
        checksum: xor                           # of the text before it: xor, sum8, nmea

Each named group of `pattern` is a channel, scaled and offset, then converted to °C by `unit`. The
pattern must match the **whole** line: the rest of a line whose start was lost (`3.5C` of `+023.5C`)
is not a reading. A decimal comma is read as a point. A `°` in the pattern matches the degree signs
of UTF-8, Latin-1, code page 437 and LCD fonts. Instruments by name: see
`serial_instruments`.

Firmware prints a fixed number where its sensor does not answer: −127 and 85 (DS18B20), −45 and
−46.85 (SHT), −50 (an input at 0 V), −40 and 125 (ends of a scale). With `pattern` these are refused
(`refuse_c`; [] accepts all), with `instrument` the instrument's own error texts are known.

A line that was in the queue before the reading was requested is never used: with `command` the
queue is emptied first, without it the next line that *ends* after the call counts. Echo and
garbage are skipped until `timeout_s`; the error then quotes what was received.
"""

from __future__ import annotations

import contextlib
import re
import termios
import time
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceTimeout
from thermocald.hal import Found, Reading, Thermometer
from thermocald_drivers import support
from thermocald_drivers.serial_instruments import (
    CHECKSUMS,
    INSTRUMENTS,
    NO_SENSOR_C,
    UNITS,
    Instrument,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from thermocald.hal import Clock

__all__ = ["SerialThermometer"]

LONGEST_LINE = 512
NO_SENSOR_STEP_K = 0.006
DEGREES = str.maketrans("ºø˚∘ß℃", "°°°°°°")
"""What a degree sign of another encoding becomes in Latin-1: masculine ordinal, 0xF8, 0xDF."""
POLL_S = 0.05  # changing pyserial's time-out later would configure the port again
QUEUE = 4000
"""Bytes that may have waited before the kernel's buffer (4096) could have lost some."""


def _one_end(received: bytes) -> bytes:
    """CR, LF and CR LF all end a line; empty lines are skipped anyway."""
    return received.replace(b"\r", b"\n")


class SerialThermometer(Thermometer):
    """A line protocol by a pattern, or an instrument by its name."""

    device_classes = ("char-ttyUSB", "char-ttyACM", "char-ttyAMA", "char-ttyS")

    def __init__(
        self,
        *,
        clock: Clock,
        port: str,
        instrument: str | None = None,
        pattern: str | None = None,
        command: str | None = None,
        baud: int | None = None,
        framing: str | None = None,
        unit: str | None = None,
        scale: float | None = None,
        offset: float | None = None,
        checksum: str | None = None,
        timeout_s: float | None = None,
        minimum_c: float | None = None,
        maximum_c: float | None = None,
        refuse_c: Sequence[float] | None = None,
    ) -> None:
        self.clock = clock
        self.port = support.text("port", port)
        if (instrument is None) == (pattern is None):
            raise ConfigurationError(
                f"write either instrument: ({', '.join(INSTRUMENTS)}) or pattern:"
            )
        if instrument is not None:
            base = INSTRUMENTS[support.choice("instrument", instrument, list(INSTRUMENTS))]
        else:
            base = Instrument(
                support.text("pattern", pattern), range_c=(-60.0, 125.0), refuse_c=NO_SENSOR_C
            )
        self.name = instrument or "serial line"
        self.command = (base.command if command is None else command).encode("ascii")
        self.baud = int(support.number("baud", baud or base.baud, 50, 4_000_000, "Bd", whole=True))
        self.framing = framing or base.framing
        if not re.fullmatch(r"[5-8][NEO][12]", self.framing):
            raise ConfigurationError(f"framing: {self.framing!r} is not such as 8N1 or 7E1")
        self.unit = support.choice("unit", unit or base.unit, list(UNITS))
        self.scale = support.number("scale", base.scale if scale is None else scale, -1e6, 1e6)
        self.offset = support.number("offset", base.offset if offset is None else offset, -1e6, 1e6)
        self.checksum = support.choice("checksum", checksum or base.checksum, list(CHECKSUMS))
        wait = base.timeout_s if timeout_s is None else timeout_s
        self.timeout_s = support.number("timeout_s", wait, 0.01, 600, "s")
        low = base.range_c[0] if minimum_c is None else minimum_c
        high = base.range_c[1] if maximum_c is None else maximum_c
        self.minimum_c = support.number("minimum_c", low, -273.15, 3000, "°C")
        self.maximum_c = support.number("maximum_c", high, -273.15, 3000, "°C")
        refused = base.refuse_c if refuse_c is None else refuse_c
        self.refuse_c = [support.number("refuse_c", v, -273.15, 3000, "°C") for v in refused]
        try:
            self.pattern = re.compile(base.pattern, re.ASCII)  # other scripts have digits too
        except re.error as error:
            raise ConfigurationError(f"pattern: {base.pattern!r}: {error}") from error
        self.channels = [name for name in self.pattern.groupindex if name != "checksum"]
        if not self.channels:
            raise ConfigurationError("pattern: name the value, such as (?P<temperature>[-+0-9.]+)")
        if self.checksum != "none" and "checksum" not in self.pattern.groupindex:
            raise ConfigurationError("pattern: a checksum needs a group (?P<checksum>…)")
        self._serial: Any = None
        self._seen = False
        self._neighbours: dict[str, support.Neighbour] = {}
        self._line = b""
        self._synchronous = False

    @property
    def where(self) -> str:
        """The device as the user knows it."""
        return f"{self.name} on {self.port}"

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> list[Found]:  # noqa: ARG003
        """Serial ports by their permanent names; what is connected cannot be known."""
        ports = support.library("serial.tools.list_ports").comports(include_links=True)
        links = [p for p in ports if "/by-id/" in p.device]
        return [
            Found(
                {"port": p.device, "instrument": "papouch-tm"},
                f"{p.description}; write the instrument that is on it",
                certain=False,
            )
            for p in (links or [p for p in ports if p.hwid != "n/a"])
        ]

    def open(self) -> None:
        serial = support.library("serial")
        data_bits, parity, stop_bits = tuple(self.framing)
        try:
            self._serial = serial.Serial(
                self.port,
                self.baud,
                bytesize=int(data_bits),
                parity=parity,
                stopbits=int(stop_bits),
                timeout=POLL_S,
                write_timeout=self.timeout_s,
                exclusive=True,
            )
        except ValueError as error:
            raise ConfigurationError(f"{self.where}: {error}") from error
        except OSError as error:
            if "exclusively lock" in str(error):
                error = OSError(16, "another program holds the port")
            hint = "is it plugged in, and the user in the group dialout?"
            raise support.fault(error, self.where, seen=self._seen, hint=hint) from error
        self._seen = True
        self._line, self._synchronous = b"", False
        self._neighbours.clear()

    def close(self) -> None:
        port, self._serial = self._serial, None
        if port is not None:
            port.close()

    def identity(self) -> Mapping[str, str]:
        return {"instrument": self.name, "port": self.port}

    def read(self) -> Reading:
        if self._serial is None:
            raise DeviceGone(f"{self.where}: not open")
        start = self.clock.monotonic()
        try:
            if self.command:
                self._serial.reset_input_buffer()
                self._line, self._synchronous = b"", True
                self._serial.write(self.command)
            else:
                self._skip_queue()
            values, ended, line = self._next_values()
        except (OSError, termios.error) as error:  # a termios.error is no OSError
            if isinstance(error, BadReading | DeviceTimeout):
                raise
            raise self._lost(error) from error
        if self.command:
            return support.middle_reading(self.clock, values, start, {"line": line})
        monotonic, utc = support.on_clock(self.clock, ended)
        return Reading(values=values, monotonic=monotonic, utc=utc, metadata={"line": line})

    def _lost(self, error: Exception) -> Exception:
        """Pyserial reports an unplug without an errno, or with EIO."""
        if isinstance(error, support.library("serial").SerialTimeoutException):
            return DeviceTimeout(f"{self.where}: cannot send, the line is held")
        return DeviceGone(f"{self.where}: unplugged ({error})")

    def _skip_queue(self) -> None:
        """Discard what came before now, but keep the start of the current line."""
        waiting = self._serial.read(self._serial.in_waiting)
        if len(waiting) >= QUEUE:
            self._line, self._synchronous = b"", False  # bytes may be missing in the middle
            return
        head, mark, tail = (self._line + _one_end(waiting)).rpartition(b"\n")
        if mark:
            self._synchronous = True
        self._line = tail if mark else head + tail

    def _match(self, line: bytes) -> re.Match[str] | None:
        """The line against the pattern, in each encoding that it may have."""
        matches = (self.pattern.fullmatch(text) for text in _decodings(line))
        return next((match for match in matches if match is not None), None)

    def _next_values(self) -> tuple[dict[str, float], float, str]:
        """Channels, the machine's monotonic time, and the text of the next matching line."""
        deadline = time.monotonic() + self.timeout_s
        skipped: list[str] = []
        problem = ""
        while True:
            while b"\n" in self._line:
                line, self._line = self._line.split(b"\n", 1)
                whole, self._synchronous = self._synchronous, True
                line = line.strip(b"\0")
                if not line or not whole or line.strip() == self.command.strip():
                    continue
                match = self._match(line)
                if match is None:
                    skipped.append(line.decode("ascii", "backslashreplace"))
                    continue
                problem = self._checksum_problem(match, line)
                if not problem:
                    return self._values(match), time.monotonic(), match.string
                skipped.append(match.string)
            if len(self._line) > LONGEST_LINE:
                skipped.append(self._line[:40].decode("ascii", "backslashreplace"))
                self._line, self._synchronous = b"", False
            if time.monotonic() >= deadline:
                raise self._nothing(skipped, problem)
            self._line += _one_end(self._serial.read(max(1, self._serial.in_waiting)))

    def _nothing(self, skipped: list[str], problem: str) -> BadReading | DeviceTimeout:
        """The error for a time-out: what was wrong with the lines that came."""
        rest = self._line.decode("ascii", "backslashreplace")
        self._line, self._synchronous = b"", False
        if problem:
            return BadReading(f"{self.where}: {problem}")
        if skipped or rest:
            quoted = "; ".join(repr(text[:60]) for text in [*skipped, rest][:3] if text)
            return BadReading(
                f"{self.where}: no line fits the pattern in {self.timeout_s:g} s, but {quoted}; "
                f"is {self.baud} Bd {self.framing} right?"
            )
        return DeviceTimeout(f"{self.where}: silent for {self.timeout_s:g} s")

    def _checksum_problem(self, match: re.Match[str], line: bytes) -> str:
        if self.checksum == "none":
            return ""
        given = match["checksum"] or ""
        if not re.fullmatch(r"[0-9A-Fa-f]{1,4}", given):
            return f"checksum {given!r} in {match.string!r} is not hexadecimal"
        # the checksum is of bytes: those before it are the line without what follows
        after = len(match.string[match.start("checksum") :].encode("latin-1", "replace"))
        computed = CHECKSUMS[self.checksum](line[: len(line) - after])
        if int(given, 16) == computed:
            return ""
        return f"checksum {given} in {match.string!r}, computed {computed:02X}"

    def _values(self, match: re.Match[str]) -> dict[str, float]:
        """{channel: °C} of a line; a channel without a usable number is absent."""
        values, problems = {}, []
        for channel in self.channels:
            if match[channel] is None:
                continue
            try:
                values[channel] = self._celsius(channel, match[channel])
            except ValueError as error:
                problems.append(f"{self.where}, {channel}: {error}")
            except BadReading as error:
                problems.append(str(error))
        if not values:
            raise BadReading("; ".join(problems) or f"{self.where}: {match.string!r} has no value")
        return values

    def _celsius(self, channel: str, text: str) -> float:
        value = support.parse_number(text, comma=True) * self.scale + self.offset
        where = f"{self.where}, {channel}"
        celsius = support.believable(UNITS[self.unit](value), self.minimum_c, self.maximum_c, where)
        if any(abs(celsius - refused) < NO_SENSOR_STEP_K for refused in self.refuse_c):
            raise BadReading(
                f"{where}: {celsius:g} °C is what firmware prints without a sensor; if it is a "
                "temperature, write refuse_c: []"
            )
        neighbour = self._neighbours.setdefault(channel, support.Neighbour(self.clock))
        if value != 0.0 or not self.refuse_c:
            neighbour.measured(celsius)
        elif not neighbour.supports(celsius):
            raise BadReading(
                f"{where}: 0 is what firmware prints without a sensor, and no recent reading was "
                "near it; if it is a temperature, write refuse_c: []"
            )
        return celsius


def _decodings(line: bytes) -> Iterator[str]:
    """The line as text: UTF-8 if it is, Latin-1, and Latin-1 with every degree sign as °."""
    with contextlib.suppress(UnicodeDecodeError):
        text = line.decode("utf-8")
        yield text
        yield text.translate(DEGREES)
    yield line.decode("latin-1")
    yield line.decode("latin-1").translate(DEGREES)
