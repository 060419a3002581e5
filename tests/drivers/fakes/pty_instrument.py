"""An instrument at the other end of a pseudo terminal: a real tty for the driver."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty


class Instrument:
    """An instrument that answers with `answers[command]` (bytes, or a list of successive ones)."""

    def __init__(self, answers: dict[bytes, bytes | list[bytes]] | None = None) -> None:
        self.answers = answers or {}
        self.received: list[bytes] = []
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="instrument")
        self._thread.start()

    def send(self, text: bytes) -> None:
        os.write(self.master, text)

    def _serve(self) -> None:
        pending = b""
        while True:
            ready, _, _ = select.select([self.master, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            try:
                pending += os.read(self.master, 256)
            except OSError:
                return
            for command, answer in self.answers.items():
                if pending.endswith(command):
                    self.received.append(command)
                    pending = b""
                    self.send(answer.pop(0) if isinstance(answer, list) else answer)

    def unplug(self) -> None:
        """Remove the tty, as when a USB adapter is unplugged."""
        os.write(self._stop_write, b"x")
        self._thread.join()
        for descriptor in (self.master, self.slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def close(self) -> None:
        if self._thread.is_alive():
            self.unplug()
        for descriptor in (self._stop_read, self._stop_write):
            os.close(descriptor)
