"""The page's server, which silent or slow clients can neither block nor exhaust.

A connection that sends no complete request, or reads nothing of its answer, is closed after some
seconds. Beyond a number of connections or of simultaneous costly requests, the answer is 503.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
from typing import TYPE_CHECKING, Any

import uvicorn
from starlette.responses import JSONResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from thermocald.errors import ConfigurationError, ThermocaldError
from thermocald.names import PAGE_OF

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Receive, Scope, Send

log = logging.getLogger(__name__)

_CONNECTIONS = 100
_LOOK_EVERY_S = 2.0
_REQUEST_S = 10.0  # for a request's head to arrive
_END_S = 1.0  # for answers to be completed when the server stops
_STUCK_S = 20.0  # for a client to read 64 kB
_SEND_BUFFER_BYTES = 131_072  # of an answer in the kernel, otherwise up to 4 MB per connection
# path → (requests served at once, requests that may wait)
_COSTLY = {
    "/api/series.csv": (4, 0),
    "/api/columns": (2, 20),
    "/api/stream": (20, 0),
    "/api/events": (2, 20),
    "/api/series": (2, 20),
}


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket; ConfigurationError if the address cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        # the kernel's limit for a client that reads nothing; every connection inherits it
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * _STUCK_S))
        listening.bind((host, port))
        listening.listen()  # before the page is announced
    except OSError as error:
        listening.close()
        if error.errno == errno.EADDRINUSE:
            why = "it is in use by another program; choose another dashboard.port"
        else:
            why = error.strerror or str(error)
        raise ConfigurationError(f"the page cannot use {host}, port {port}: {why}") from error
    return listening


def run_server(application: Starlette, listening: socket.socket) -> None:
    """Serve until a signal stops it; answers under way have a second to be completed."""
    config = uvicorn.Config(
        application, http=_Connection, ws="none", log_level="warning", access_log=False,
        lifespan="off", server_header=False, backlog=64, limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=2,
    )  # fmt: skip
    server = _Server(config)
    application.state.ends = lambda: server.should_exit
    server.run(sockets=[listening])


class _Server(uvicorn.Server):
    """A server that, when it stops, closes the connections of clients still reading an answer.

    Cancelling their requests instead would put a traceback into the journal. It also stops when
    the daemon that started it was killed: the port is free for the next daemon's page.
    """

    async def on_tick(self, counter: int) -> bool:
        self.should_exit |= os.environ.get(PAGE_OF, str(os.getppid())) != str(os.getppid())
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        hang_up = asyncio.get_running_loop().call_later(_END_S, self._hang_up)
        await super().shutdown(sockets)
        hang_up.cancel()

    def _hang_up(self) -> None:
        for connection in list(self.server_state.connections):
            connection.transport.abort()


class _Connection(H11Protocol):
    """A connection that is closed if its client neither sends a request nor reads the answer."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._progress_at = self.loop.time()
        self._watching = self.loop.call_later(_LOOK_EVERY_S, self._watch)

    def connection_lost(self, exc: Exception | None) -> None:
        self._watching.cancel()
        super().connection_lost(exc)

    def _watch(self) -> None:
        now = self.loop.time()
        answering = self.cycle is not None and not self.cycle.response_complete
        if answering and not self.flow.write_paused:
            self._progress_at = now
        if now - self._progress_at > (_STUCK_S if answering else _REQUEST_S):
            self.transport.abort()
            return
        self._watching = self.loop.call_later(_LOOK_EVERY_S, self._watch)


class Limits:
    """A limit on simultaneous costly requests: some wait, the rest are answered with 503."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._slots = {path: asyncio.Semaphore(most) for path, (most, _) in _COSTLY.items()}
        self._asked = dict.fromkeys(_COSTLY, 0)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        if path not in _COSTLY:
            await self._app(scope, receive, send)
            return
        if self._asked[path] >= sum(_COSTLY[path]):
            busy = JSONResponse(
                {"error": "too many requests at once; try again"}, 503, {"retry-after": "5"}
            )
            await busy(scope, receive, send)
            return
        self._asked[path] += 1
        try:
            async with self._slots[path]:
                await self._app(scope, receive, send)
        except RuntimeError as error:
            if not isinstance(error.__cause__, ThermocaldError):
                raise
            # part of the answer is sent already: it can only be cut off
            log.warning("%s: %s", path, error.__cause__)
        finally:
            self._asked[path] -= 1
