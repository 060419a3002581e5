"""The control socket: its permissions, what it refuses, and that no input harms the daemon."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import socket
import stat
import time

import pytest

from thermocald.daemon.control import FORMAT, ControlSocket, ask
from thermocald.errors import DataError, UsageError

SESSION = {"camera": "one", "series": "M7", "start": "cold", "epochs": 3}


@pytest.fixture
def ear(tmp_path):
    """A socket that answers `session status`; `ear.asked` lists the requests."""
    asked = []

    def answer(request):
        asked.append(request)
        if request.do == "retention":
            raise DataError("nothing may go")
        return {"sessions": {"x": float("nan")}}

    folder = tmp_path / ("deep" * 30)  # longer than the limit of a socket address
    control = ControlSocket(folder, answer)
    control.ensure_open()
    control.asked = asked
    yield control
    control.close()
    assert not (folder / "control.sock").exists()


def well(ear) -> bool:
    """Return whether it answers."""
    return (ask(ear.folder, "session status") or {}).get("ok", False)


def connect(ear) -> socket.socket:
    channel = socket.socket(socket.AF_UNIX)
    channel.settimeout(10)
    handle = os.open(ear.folder, os.O_RDONLY)
    channel.connect(f"/proc/self/fd/{handle}/control.sock")
    os.close(handle)
    return channel


def say(ear, data: bytes) -> dict:
    with connect(ear) as channel:
        channel.sendall(data)
        return json.loads(channel.makefile().readline())


def test_an_answer_is_json_and_a_refusal_is_raised(ear, tmp_path):
    mode = stat.S_IMODE((ear.folder / "control.sock").stat().st_mode)
    assert mode == 0o660  # only owner and group have access
    told = {"format": FORMAT, "ok": True, "sessions": {"x": None}}
    assert ask(ear.folder, "session status") == told
    with pytest.raises(DataError, match="nothing may go"):
        ask(ear.folder, "retention")
    with pytest.raises(UsageError, match="epochs"):
        ask(ear.folder, "session start", session={**SESSION, "epochs": -1})
    for nobody_listens in (tmp_path, tmp_path / "away"):
        assert ask(nobody_listens, "session status") is None


def test_a_socket_that_cannot_be_opened_is_said_once(ear, caplog):
    """After `rm -r thermocald.db.live` it listens again, see test_sessions."""
    shutil.rmtree(ear.folder)
    ear.folder.write_text("in the way")
    for _ in range(3):
        ear.ensure_open()
    why = "sessions wait until the control socket can be opened: File exists"
    assert caplog.messages == [f"{ear.folder}: {why}"]
    ear.folder.unlink()


def test_it_listens_again_after_it_failed(ear, monkeypatch):
    """Regression: without a free file descriptor for once, no session could begin any more."""

    def fail(channel):
        monkeypatch.undo()
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket.socket, "accept", fail)
    assert well(ear)  # by the call of `accept` that waits already
    ear._thread.join(5.0)
    ear.ensure_open()
    assert well(ear)


STATUS, START = ({"format": FORMAT, "do": f"session {what}"} for what in ("status", "start"))
STEP = {"seconds": 10.0, "hold_c": None}
HOSTILE = [
    b"", b"null", b"[]", b"session start", b"\xff\xfe\x00", b"[" * 60000, b'{"a":' * 12000,
    {"format": FORMAT}, {**STATUS, "do": "exec"}, {**STATUS, "format": "thermocald-control/2"},
    {**STATUS, "more": 1},
    *({**START, "session": {**SESSION, **wrong}} for wrong in [
        {"camera": "../../etc"}, {"camera": ""}, {"camera": 5}, {"series": "a/b"},
        {"series": "x" * 65}, {"start": "x" * 65}, {"start": "a\nb"}, {"epochs": 0},
        {"epochs": "3"}, {"epochs": True}, {"epochs": 10**30}, {"epochs": float("nan")},
        {"programme": [{**STEP, "seconds": float("inf")}]}, {"programme": "hot"},
        {"programme": [{**STEP, "hold_c": 1e9}]}, {"programme": [STEP] * 1001},
        {"path": "/etc/passwd"},
    ]),
]  # fmt: skip


@pytest.mark.parametrize("line", HOSTILE, ids=range(len(HOSTILE)))
def test_what_is_not_understood_is_refused_and_does_nothing(ear, line):
    data = line if isinstance(line, bytes) else json.dumps(line).encode()
    answer = say(ear, data + b"\n")
    assert (answer["ok"], answer["exit_status"]) == (False, 2)
    assert "refused" in answer["error"]
    assert "\n" not in answer["error"]
    assert ear.asked == []
    assert well(ear)


def test_endless_lines_random_bytes_and_silence_neither_end_it_nor_delay_others(ear):
    answer = say(ear, b'{"format": "' + b"x" * 70000)
    assert "longer than 65536" in answer["error"]
    rng = random.Random(4)
    for _ in range(50):
        data = rng.randbytes(rng.randrange(1, 300)).replace(b"\n", b"") + b"\n"
        assert say(ear, data)["ok"] is False
    assert ear.asked == []
    silent = [connect(ear) for _ in range(20)]
    begin = time.monotonic()
    with connect(ear) as gone:
        gone.sendall(b'{"for')
    for _ in range(5):
        assert well(ear)
    assert time.monotonic() - begin < 1.0
    for channel in silent:
        channel.close()


def test_a_full_backlog_is_not_nobody(tmp_path):
    place = str(tmp_path / "control.sock")
    with socket.socket(socket.AF_UNIX) as deaf:
        deaf.bind(place)
        deaf.listen(0)
        waiting = [socket.socket(socket.AF_UNIX) for _ in range(3)]
        for channel in waiting:
            channel.setblocking(False)
            channel.connect_ex(place)
        with pytest.raises(DataError, match="does not answer"):
            ask(tmp_path, "session status")
        for channel in waiting:
            channel.close()
    assert ask(tmp_path, "session status") is None  # the file exists, but no daemon listens
