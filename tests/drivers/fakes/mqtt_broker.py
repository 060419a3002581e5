"""A broker with the part of MQTT 3.1.1 that one publisher needs, which fails on demand.

`make hil` uses a real broker; this one can withhold an acknowledgement or break a connection.
"""

from __future__ import annotations

import socket
import ssl
from typing import BinaryIO

from tests.drivers.fakes.line_server import LineServer


class Broker(LineServer):
    """A broker; `messages` holds (topic, payload, retain), also of a broken connection's will."""

    def __init__(self, port: int = 0, context: ssl.SSLContext | None = None) -> None:
        self._context = context
        self.messages: list[tuple[str, bytes, bool]] = []
        self.refuse = 0
        self.acknowledge = True
        self.answer_connect = True
        self.credentials: tuple[str, str] | None = None
        super().__init__("broker", port)

    def _serve(self, line: socket.socket) -> None:
        will: tuple[str, bytes, bool] | None = None
        try:
            if self._context is not None:
                line = self._context.wrap_socket(
                    line, server_side=True, do_handshake_on_connect=False
                )
                self._lines.append(line)
                line.do_handshake()
            stream = line.makefile("rb")
            while packet := self._packet(stream):
                kind, flags, body = packet
                if kind == 1:
                    will = self._connect(line, body)
                elif kind == 3:
                    size = int.from_bytes(body[:2], "big")
                    topic, rest = body[2 : 2 + size].decode(), body[2 + size :]
                    self.messages.append((topic, rest[2:], bool(flags & 1)))
                    if self.acknowledge:
                        line.sendall(b"\x40\x02" + rest[:2])
                elif kind == 12:
                    line.sendall(b"\xd0\x00")
                elif kind == 14:
                    will = None
        except OSError:
            pass
        finally:
            if will:
                self.messages.append(will)
            line.close()

    def _connect(self, line: socket.socket, body: bytes) -> tuple[str, bytes, bool] | None:
        flags, fields, at = body[7], [], 10
        while at < len(body):
            size = int.from_bytes(body[at : at + 2], "big")
            fields.append(body[at + 2 : at + 2 + size])
            at += 2 + size
        fields.pop(0)  # client id
        will = (fields.pop(0).decode(), fields.pop(0), True) if flags & 4 else None
        if flags & 0x80:
            self.credentials = (fields.pop(0).decode(), fields.pop(0).decode())
        if self.answer_connect:
            line.sendall(bytes([0x20, 2, 0, self.refuse]))
        return None if self.refuse else will

    @staticmethod
    def _packet(stream: BinaryIO) -> tuple[int, int, bytes] | None:
        head = stream.read(1)
        if not head:
            return None
        size = shift = 0
        more = True
        while more:
            (byte,) = stream.read(1)
            size |= (byte & 0x7F) << shift
            shift, more = shift + 7, bool(byte & 0x80)
        return head[0] >> 4, head[0] & 15, stream.read(size)
