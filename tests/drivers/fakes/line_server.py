"""A server on loopback with a thread per connection, the base of fake network devices."""

from __future__ import annotations

import contextlib
import socket
import threading


class LineServer:
    """A server at `port`; a subclass serves each connection in `_serve`."""

    def __init__(self, name: str, port: int = 0) -> None:
        self._name = name
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = self._server.getsockname()[1]
        self._lines: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept, name=name)]
        self._threads[0].start()

    def _serve(self, line: socket.socket) -> None:
        raise NotImplementedError

    def _accept(self) -> None:
        while True:
            try:
                line, _ = self._server.accept()
            except OSError:
                return
            self._lines.append(line)
            thread = threading.Thread(target=self._serve, args=(line,), name=f"{self._name}-line")
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """End all connections and threads; may be called twice."""
        if self._server.fileno() < 0:
            return
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for line in self._lines:
            with contextlib.suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(2.0)
