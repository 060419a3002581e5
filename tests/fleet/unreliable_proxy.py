"""A failing network on loopback: connections are cut at random, then refused for a while."""

from __future__ import annotations

import asyncio
import random
import threading


class UnreliableProxy:
    """A TCP proxy of a port; `calm()` ends the cuts. Use it in a `with` block."""

    def __init__(self, target: int, seed: int, every_s: float) -> None:
        self.target, self.every_s = target, every_s
        self.cuts = self.connections = 0
        self._random = random.Random(seed)
        self._open: set[asyncio.StreamWriter] = set()
        self._refusing = False
        self._calm = threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))

    def __enter__(self) -> UnreliableProxy:
        self._thread.start()
        assert self._ready.wait(10)
        return self

    def __exit__(self, *error: object) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    def calm(self) -> None:
        self._calm.set()

    async def _serve(self) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._pass_on, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        cutting = asyncio.create_task(self._cut())
        await self._end.wait()
        cutting.cancel()
        server.close()
        for writer in list(self._open):
            writer.transport.abort()
        await asyncio.sleep(0.05)

    async def _cut(self) -> None:
        while not self._calm.is_set():
            await asyncio.sleep(self._random.expovariate(1 / self.every_s))
            for writer in list(self._open):
                if self._random.random() < 0.5:
                    self.cuts += 1
                    writer.transport.abort()  # data under way are lost in both directions
            self._refusing = True
            await asyncio.sleep(self._random.uniform(0, self.every_s / 3))
            self._refusing = False

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        try:
            if self._refusing:
                writer.transport.abort()
                return
            there, back = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.transport.abort()  # the server is down
            return
        self._open |= {writer, back}
        try:
            await asyncio.gather(_copy(reader, back), _copy(there, writer))
        finally:
            self._open -= {writer, back}


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass
    finally:
        writer.transport.abort()
