"""The daemon's control socket: a Unix socket in its live folder, with one request per connection.

    → {"format": "thermocald-control/1", "do": "session start", "session": {…}}
    ← {"format": "thermocald-control/1", "ok": true, …}
    ← {"format": "thermocald-control/1", "ok": false, "error": "…", "exit_status": 2}

The socket's mode, 0660, admits the daemon's user and group. A request is one line of at most
64 KiB, sent within two seconds; an invalid request changes nothing.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from thermocald.config import Config, Name, in_words
from thermocald.daemon.live_state import find_state
from thermocald.daemon.session import Session  # noqa: TC001
from thermocald.errors import DataError, DeviceError, ThermocaldError, UsageError
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


log = logging.getLogger(__name__)

FORMAT = "thermocald-control/1"
_NAME = "control.sock"
_LONGEST = 65536
_REQUEST_S = 2.0
_ANSWER_S = 60.0
_BACKLOG = 64
_AT_ONCE = 32  # connections served; further ones wait in the backlog


class DaemonBusy(DataError):
    """A daemon listens but did not answer; a second request may succeed."""


class Request(BaseModel):
    """A request: `session start` with a session, or `session stop` with the session's camera.

    `session status`: report the sessions; `retention`: delete expired frames now.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    format: Literal["thermocald-control/1"]
    do: Literal["session start", "session stop", "session status", "retention"]
    session: Session | None = None
    camera: Name | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        needed = {"session start": "session", "session stop": "camera"}.get(self.do)
        for key in ("session", "camera"):
            if (getattr(self, key) is None) == (key == needed):
                raise ValueError(f"{key}: {'missing' if key == needed else 'not of ' + self.do}")
        return self


@dataclass(eq=False)
class ControlSocket:
    """A server that listens in one thread and serves each connection in another.

    answer(request): returns the answer's content or raises ThermocaldError.
    """

    folder: Path
    answer: Callable[[Request], dict[str, Any]]

    def __post_init__(self) -> None:
        self._socket: socket.socket | None = None
        self._free = threading.BoundedSemaphore(_AT_ONCE)
        self._thread = threading.Thread()
        self._failed = False

    def ensure_open(self) -> None:
        """Listen, also again after a failure, or after the socket's file or folder was deleted.

        If that fails, log it once: the daemon works without the socket.
        """
        if self._thread.is_alive() and os.path.exists(self.folder / _NAME):
            return
        self.close()
        channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with _short(self.folder) as path:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(path)  # of a killed daemon, since this one holds the store's lock
                os.fchmod(channel.fileno(), 0o600)  # nobody else may connect before the chmod
                channel.bind(path)
                os.chmod(path, 0o660)
            channel.listen(_BACKLOG)
        except OSError as error:
            channel.close()
            if not self._failed:
                why = error.strerror or error
                what = "sessions wait until the control socket can be opened"
                log.warning("%s: %s: %s", self.folder, what, why)
            self._failed = True
            return
        self._failed, self._socket = False, channel
        self._thread = threading.Thread(
            target=self._serve, args=(channel,), name="control", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening and delete the socket's file."""
        channel, self._socket = self._socket, None
        if channel is None:
            return
        with contextlib.suppress(OSError):
            channel.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._thread.join(_REQUEST_S)
        channel.close()
        with contextlib.suppress(OSError):
            (self.folder / _NAME).unlink()

    def _serve(self, channel: socket.socket) -> None:
        while channel is self._socket:
            try:
                connection, _ = channel.accept()
            except OSError as error:
                if channel is self._socket:
                    log.error("the control socket failed: %s", error)
                return
            if not self._free.acquire(timeout=_REQUEST_S):
                connection.close()  # the client sees that the connection ends
                continue
            threading.Thread(
                target=self._serve_one, args=(connection,), name="control request", daemon=True
            ).start()

    def _serve_one(self, connection: socket.socket) -> None:
        try:
            with connection:
                try:
                    request = _parse(_line(connection, _LONGEST, _REQUEST_S))
                    answer = {"ok": True, **self.answer(request)}
                except ThermocaldError as error:
                    answer = {"ok": False, "error": str(error), "exit_status": error.exit_status}
                connection.settimeout(_REQUEST_S)
                document = jsonable({"format": FORMAT, **answer})
                connection.sendall(json.dumps(document).encode() + b"\n")
        except OSError as error:  # the client is gone or silent
            log.debug("control: %s", error)
        finally:
            self._free.release()


def ask(folder: Path, do: str, **values: Any) -> dict[str, Any] | None:
    """Send a request to the daemon with this live folder; None if no daemon listens.

    Raises the daemon's refusal as UsageError, DataError or DeviceError.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as channel:
        try:
            channel.settimeout(_REQUEST_S)
            with _short(folder) as path:
                channel.connect(path)
            channel.sendall(json.dumps({"format": FORMAT, "do": do, **values}).encode() + b"\n")
            answer = json.loads(_line(channel, 100 * _LONGEST, _ANSWER_S))
        except PermissionError as error:
            raise DataError(
                f"{folder / _NAME}: you are not permitted to use this daemon; join its group, or "
                "use sudo"
            ) from error
        except (FileNotFoundError, NotADirectoryError, ConnectionRefusedError):
            return None
        except (BlockingIOError, TimeoutError, ConnectionError) as error:
            raise DaemonBusy(
                f"{folder / _NAME}: the daemon does not answer: it has too many requests, or was "
                "just stopped; try again"
            ) from error
        except (OSError, ValueError):
            return None
    if not isinstance(answer, dict) or answer.get("format") != FORMAT:
        raise DataError(f"{folder / _NAME}: a daemon of another version is running; restart it")
    if answer.get("ok"):
        return answer
    kind = {2: UsageError, 3: DeviceError}.get(int(answer.get("exit_status", 1)), DataError)
    raise kind(str(answer.get("error", "the daemon refused the request")))


def _parse(line: bytes) -> Request:
    try:
        return Request.model_validate(json.loads(line))
    except ValidationError as error:
        raise UsageError(f"the request is refused: {in_words('', error)}") from error
    except (ValueError, RecursionError) as error:
        raise UsageError("the request is refused: it is not a JSON object in one line") from error


def _line(channel: socket.socket, longest: int, within_s: float) -> bytes:
    """Read up to a line end; OSError if it does not come in time, UsageError if too long."""
    deadline, data = time.monotonic() + within_s, bytearray()
    while b"\n" not in data:
        if len(data) > longest:
            raise UsageError(f"the request is refused: it is longer than {longest} bytes")
        channel.settimeout(max(0.001, deadline - time.monotonic()))
        piece = channel.recv(8192)
        if not piece:
            raise ConnectionError("closed before the line ended")
        data += piece
        if time.monotonic() > deadline:
            raise TimeoutError("the line did not end in time")
    return bytes(data.partition(b"\n")[0])


@contextlib.contextmanager
def _short(folder: Path) -> Iterator[str]:
    """Yield a path of the socket that fits into the 107 bytes of a socket address."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{handle}/{_NAME}"
    finally:
        os.close(handle)


def enforce_retention(config: Config) -> list[str]:
    """Delete expired frames through the running daemon, or directly; store and return events."""
    answer = ask(find_state(config.store.path), "retention")
    if answer is not None:
        return [str(sentence) for sentence in answer["deleted"]]
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.machine import machine_clock_trusted

    with contextlib.closing(StoreGuard(config.store.path)) as guard:
        now = time.time() if machine_clock_trusted() else None
        sentences = FrameFolder(config.frames).enforce(now)
        for sentence in sentences:
            guard.event(time.time(), "frames_deleted", sentence)
    return sentences
