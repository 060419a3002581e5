"""A 1-wire bus with DS18B20 probes behind a USB adapter DS9490R, plugged into the guest by QEMU.

QEMU's usb-redir device uses the USB redirection protocol on its socket. This module is the adapter
(a DS2490 bridge) with its probes; the guest's ds2490 and w1_therm drivers work as with real ones,
including 0.75 s per conversion.
Source: USB Network Redirection protocol 0.7; data sheets DS2490 and DS18B20 (19-7487).
"""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from thermocald_drivers.onewire import crc8

# USB redirection: packet types, capabilities
HELLO, CONNECT, INTERFACES, ENDPOINTS = 0, 1, 4, 5
SET_CONFIGURATION, GET_CONFIGURATION, CONFIGURATION = 6, 7, 8
SET_ALTERNATE, GET_ALTERNATE, ALTERNATE = 9, 10, 11
START_INTERRUPT, STOP_INTERRUPT, INTERRUPT_STATUS = 15, 16, 17
CONTROL, BULK, INTERRUPT = 100, 101, 103
# required by QEMU's xHCI: device version, largest packets, identities of 64 bits, lengths of 32
CAPABILITIES = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6
HEAD, BULK_HEAD = struct.Struct("<IIQ"), struct.Struct("<BBHIH")
STALL = 4

# the DS2490's endpoints and commands
STATUS, OUT, IN = 0x81, 0x02, 0x83
ENDPOINT_TABLE = {STATUS: (3, 1, 32), OUT: (2, 0, 64), IN: (2, 0, 64)}  # type, interval, packet
RESET_DEVICE = (0, 0)
COMMUNICATION = 1
BIT_IO, RESET, BYTE_IO, BLOCK_IO, SEARCH = 0x20, 0x42, 0x52, 0x74, 0xF4
KIND = 0xF6  # mask of a command word without its modifier bits
IDLE = 0x20


POWER_ON = bytes.fromhex("50054b467fff0c101c")  # 85 °C until the first conversion


@dataclass
class Probe:
    """A DS18B20: 12 bits, powered by its own line."""

    serial: int
    celsius: float = 20.0
    scratchpad: bytes = POWER_ON
    damage: int = 0  # XORed with the first byte read, like a disturbed line
    converts: bool = True
    selected: bool = field(default=False, init=False)
    _answer: list[int] = field(default_factory=list, init=False)

    @property
    def rom(self) -> bytes:
        body = b"\x28" + self.serial.to_bytes(6, "little")
        return body + bytes([crc8(body)])

    @property
    def name(self) -> str:
        """The kernel's name of the probe."""
        return f"28-{self.serial:012x}"

    def reset(self) -> None:
        self.selected, self._answer = False, []

    def command(self, byte: int) -> None:
        """Execute a function command; the probe is selected."""
        if byte == 0x44 and self.converts:
            raw = round(self.celsius * 16).to_bytes(2, "little", signed=True)
            body = raw + bytes.fromhex("4b467fff0c10")
            self.scratchpad = body + bytes([crc8(body)])
        elif byte == 0xBE:
            first, *rest = self.scratchpad
            self._answer = [first ^ self.damage, *rest]

    def answer(self) -> int:
        return self._answer.pop(0) if self._answer else 0xFF


class Wire:
    """The bus, which returns a byte for each byte written."""

    def __init__(self, probes: list[Probe]) -> None:
        self.probes = probes
        self._rom: list[int] | None = None
        self._addressed = False

    def reset(self) -> None:
        self._rom, self._addressed = None, False
        for probe in self.probes:
            probe.reset()

    def byte(self, out: int) -> int:
        if self._rom is not None:  # the address after MATCH ROM
            self._rom.append(out)
            if len(self._rom) == 8:
                self._select(lambda probe, rom=bytes(self._rom): probe.rom == rom)
            return out
        if not self._addressed:
            if out == 0x55:
                self._rom = []
            elif out == 0xCC:
                self._select(lambda _: True)
            return out
        chosen = [probe for probe in self.probes if probe.selected]
        if out != 0xFF:
            for probe in chosen:
                probe.command(out)
            return out
        level = 0xFF  # the wire is low if any probe pulls it low
        for probe in chosen:
            level &= probe.answer()
        return level

    def _select(self, whom) -> None:
        self._rom, self._addressed = None, True
        for probe in self.probes:
            probe.selected = whom(probe)


class Plugged:
    """A device at one of QEMU's sockets, which serves in its own thread while plugged in."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket: socket.socket | None = None

    def plug(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(self.path))
        self._thread = threading.Thread(target=self._run, args=(self._socket,), name="plugged")
        self._thread.start()

    def _run(self, line: socket.socket) -> None:
        with suppress(BrokenPipeError):  # pulled while it answers
            self._serve(line)

    def pull(self) -> None:
        if self._socket is not None:
            self._socket.shutdown(socket.SHUT_RDWR)
            self._thread.join()
            self._socket.close()
            self._socket = None


class Adapter(Plugged):
    """The adapter."""

    def __init__(self, path: Path, *probes: Probe) -> None:
        super().__init__(path)
        self.probes = list(probes)

    def plug(self) -> None:
        self._wire = Wire(self.probes)
        self._written, self._read = bytearray(), bytearray()
        self._waiting: list[bytes] = []
        self._listening = False
        self._alternate = 0
        super().plug()

    def _serve(self, line: socket.socket) -> None:
        # the greeting has the short header of the first versions
        hello = struct.pack("<64sI", b"laboratory", CAPABILITIES)
        line.sendall(struct.pack("<III", HELLO, len(hello), 0) + hello)
        with line.makefile("rb") as stream:
            stream.read(struct.unpack("<III", stream.read(12))[1])
            self._send_endpoints(line)
            connect = struct.pack("<BBBBHHH", 1, 0xFF, 0, 0, 0x04FA, 0x2490, 0x0002)
            self._send(line, CONNECT, 0, connect)
            while len(head := stream.read(HEAD.size)) == HEAD.size:
                kind, length, identity = HEAD.unpack(head)
                body = stream.read(length)
                if len(body) == length:
                    self._packet(line, kind, identity, body)

    @staticmethod
    def _send(line: socket.socket, kind: int, identity: int, body: bytes) -> None:
        line.sendall(HEAD.pack(kind, len(body), identity) + body)

    def _send_endpoints(self, line: socket.socket) -> None:
        one = bytes([0]).ljust(32, b"\0")
        self._send(
            line, INTERFACES, 0, struct.pack("<I", 1) + one + b"\xff".ljust(32, b"\0") + 2 * one
        )
        kinds, intervals, packets = [255] * 32, [0] * 32, [0] * 32
        kinds[0] = kinds[16] = 0
        packets[0] = packets[16] = 64
        for endpoint, (kind, interval, packet) in ENDPOINT_TABLE.items():
            at = (endpoint & 0x80) >> 3 | endpoint & 0x0F
            kinds[at], intervals[at], packets[at] = kind, interval, packet
        table = bytes(kinds) + bytes(intervals) + bytes(32) + struct.pack("<32H", *packets)
        self._send(line, ENDPOINTS, 0, table)

    def _packet(self, line: socket.socket, kind: int, identity: int, body: bytes) -> None:
        if kind in (SET_CONFIGURATION, GET_CONFIGURATION):
            self._send_endpoints(line)
            self._send(line, CONFIGURATION, identity, b"\0\1")
        elif kind in (SET_ALTERNATE, GET_ALTERNATE):
            if kind == SET_ALTERNATE:
                self._alternate = body[1]
            self._send_endpoints(line)
            self._send(line, ALTERNATE, identity, bytes([0, 0, self._alternate]))
        elif kind in (START_INTERRUPT, STOP_INTERRUPT):
            self._listening = kind == START_INTERRUPT
            self._send(line, INTERRUPT_STATUS, identity, bytes([0, STATUS]))
            self._send_status(line)
        elif kind == CONTROL:
            self._control(line, identity, body)
        elif kind == BULK:
            endpoint, _, length, stream, _ = BULK_HEAD.unpack(body[: BULK_HEAD.size])
            data = b""
            if endpoint & 0x80:
                data = bytes(self._read[:length])
                del self._read[:length]
                length = len(data)
            else:
                self._written += body[BULK_HEAD.size :]
            head = BULK_HEAD.pack(endpoint, 0, length, stream, 0)
            self._send(line, BULK, identity, head + data)

    def _control(self, line: socket.socket, identity: int, body: bytes) -> None:
        endpoint, request, kind, _, value, index, length = struct.unpack("<BBBBHHH", body[:10])
        data, status = b"", 0
        if kind == 0x80 and request == 6:
            data = descriptor(value)[:length]
            status = 0 if data else STALL
        elif kind == 0x40 and request == COMMUNICATION:
            self._command(value, index)
        elif kind == 0x40 and (request, value) == RESET_DEVICE:
            for buffer in (self._written, self._read, self._waiting):
                buffer.clear()
        head = struct.pack("<BBBBHHH", endpoint, request, kind, status, value, index, len(data))
        self._send(line, CONTROL, identity, head + data)
        self._send_status(line)

    def _command(self, value: int, index: int) -> None:
        """Execute a communication command, and queue the status for which the driver waits."""
        kind = value & KIND
        if kind == RESET:
            self._wire.reset()
            return
        if kind == BYTE_IO:
            self._read.append(self._wire.byte(index & 0xFF))
        elif kind == BIT_IO:
            self._read.append(1)
        elif kind == BLOCK_IO:
            self._read += bytes(self._wire.byte(byte) for byte in self._written[:index])
            del self._written[:index]
        elif kind == SEARCH:
            self._written.clear()  # the start of the search; this one begins at the first probe
            self._read += b"".join(probe.rom for probe in self.probes)
        else:
            return
        flags = bytes([0, 0, 0, 0, 0, 0, 0, 0, IDLE, 0, 0, 0, 0, min(len(self._read), 255), 0, 0])
        self._waiting.append(flags)

    def _send_status(self, line: socket.socket) -> None:
        while self._listening and self._waiting:
            data = self._waiting.pop(0)
            self._send(line, INTERRUPT, 0, struct.pack("<BBH", STATUS, 0, len(data)) + data)


def descriptor(value: int) -> bytes:
    """Return the descriptor of the device, or of its configuration with four equal settings."""
    kind = value >> 8
    if kind == 1:
        return struct.pack(
            "<BBHBBBBHHHBBBB", 18, 1, 0x0110, 0xFF, 0, 0, 64, 0x04FA, 0x2490, 0x0002, 0, 0, 0, 1
        )
    if kind != 2:
        return b""
    body = b""
    for alternate in range(4):
        body += struct.pack("<BBBBBBBBB", 9, 4, 0, alternate, len(ENDPOINT_TABLE), 0xFF, 0, 0, 0)
        for endpoint, (transfer, interval, packet) in ENDPOINT_TABLE.items():
            body += struct.pack("<BBBBHB", 7, 5, endpoint, transfer, packet, interval)
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 1, 1, 0, 0x80, 50) + body
