"""The control socket: its permissions, what it refuses, and that no input harms the daemon."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import socket
import stat
import threading
import time

import pytest

from thermocald.daemon.control import FORMAT, ControlSocket, ask
from thermocald.errors import DataError, UsageError

SESSION = {"camera": "one", "series": "M7", "start": "cold", "epochs": 3}


@pytest.fixture
def ear(tmp_path):
    """A socket that answers with the request; `ear.asked` lists the requests."""
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
        answer = b""
        while not answer.endswith(b"\n"):
            answer += channel.recv(4096)
    return json.loads(answer)


def test_an_answer_is_json_and_a_refusal_is_raised(ear, tmp_path):
    mode = stat.S_IMODE((ear.folder / "control.sock").stat().st_mode)
    assert mode == 0o660  # only owner and group have access
    assert ask(ear.folder, "session status") == {
        "format": FORMAT, "ok": True, "sessions": {"x": None}
    }  # fmt: skip
    with pytest.raises(DataError, match="nothing may go"):
        ask(ear.folder, "retention")
    with pytest.raises(UsageError, match="epochs"):
        ask(ear.folder, "session start", session={**SESSION, "epochs": -1})
    for nobody_listens in (tmp_path, tmp_path / "away"):
        assert ask(nobody_listens, "session status") is None


def test_it_listens_again_after_its_folder_was_deleted(ear, caplog):
    """Regression: after `rm -r thermocald.db.live` no session could begin until a restart."""
    shutil.rmtree(ear.folder)
    ear.folder.write_text("in the way")
    for _ in range(3):
        ear.ensure_open()
    assert caplog.messages == [
        f"{ear.folder}: sessions wait until the control socket can be opened: File exists"
    ]
    ear.folder.unlink()
    assert ask(ear.folder, "session status") is None
    for _ in range(3):
        ear.ensure_open()
    assert ask(ear.folder, "session status")["ok"]
    assert [t.name for t in threading.enumerate()].count("control") == 1


def test_it_listens_again_after_it_failed(ear, monkeypatch):
    """Regression: without a free file descriptor for once, no session could begin any more."""

    def fail(channel):
        monkeypatch.undo()
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket.socket, "accept", fail)
    assert ask(ear.folder, "session status")["ok"]  # by the call of `accept` that waits already
    deadline = time.monotonic() + 5.0
    while "control" in [t.name for t in threading.enumerate()] and time.monotonic() < deadline:
        time.sleep(0.01)
    ear.ensure_open()
    assert ask(ear.folder, "session status")["ok"]


HOSTILE = [
    b"\n",
    b"null\n",
    b"[]\n",
    b"session start\n",
    b"\xff\xfe\x00\n",
    b"[" * 60000 + b"\n",
    b'{"a":' * 12000 + b"\n",
    json.dumps({"format": FORMAT}).encode() + b"\n",
    json.dumps({"format": FORMAT, "do": "exec", "command": "rm"}).encode() + b"\n",
    json.dumps({"format": "thermocald-control/2", "do": "session status"}).encode() + b"\n",
    json.dumps({"format": FORMAT, "do": "session status", "more": 1}).encode() + b"\n",
    *(
        json.dumps({"format": FORMAT, "do": "session start", "session": {**SESSION, **wrong}})
        .encode() + b"\n"
        for wrong in [
            {"camera": "../../etc"}, {"camera": ""}, {"camera": 5}, {"series": "a/b"},
            {"series": "x" * 65}, {"start": "x" * 65}, {"start": "a\nb"}, {"epochs": 0},
            {"epochs": "3"}, {"epochs": True}, {"epochs": 10**30}, {"epochs": float("nan")},
            {"programme": [{"seconds": float("inf"), "hold_c": None}]},
            {"programme": [{"seconds": 10.0, "hold_c": 1e9}]}, {"programme": "hot"},
            {"programme": [{"seconds": 10.0, "hold_c": None}] * 1001}, {"path": "/etc/passwd"},
        ]
    ),
]  # fmt: skip


@pytest.mark.parametrize("data", HOSTILE, ids=range(len(HOSTILE)))
def test_what_is_not_understood_is_refused_and_does_nothing(ear, data):
    answer = say(ear, data)
    assert answer["ok"] is False
    assert answer["exit_status"] == 2
    assert "refused" in answer["error"]
    assert "\n" not in answer["error"]
    assert ear.asked == []
    assert ask(ear.folder, "session status") is not None


def test_endless_lines_and_random_bytes_never_end_it(ear):
    answer = say(ear, b'{"format": "' + b"x" * 70000)
    assert "longer than 65536" in answer["error"]
    rng = random.Random(4)
    for _ in range(50):
        data = rng.randbytes(rng.randrange(1, 300)).replace(b"\n", b"") + b"\n"
        assert say(ear, data)["ok"] is False
    assert ear.asked == []


def test_silent_and_broken_connections_delay_nobody(ear):
    silent = [connect(ear) for _ in range(20)]
    begin = time.monotonic()
    with connect(ear) as gone:
        gone.sendall(b'{"for')
    for _ in range(5):
        assert ask(ear.folder, "session status") is not None
    assert time.monotonic() - begin < 1.0
    for channel in silent:
        channel.close()


def test_a_full_backlog_is_not_nobody(tmp_path):
    with socket.socket(socket.AF_UNIX) as deaf:
        deaf.bind(str(tmp_path / "control.sock"))
        deaf.listen(0)
        waiting = []
        for _ in range(3):
            channel = socket.socket(socket.AF_UNIX)
            channel.setblocking(False)
            try:
                channel.connect(str(tmp_path / "control.sock"))
            except BlockingIOError:
                channel.close()
                break
            waiting.append(channel)
        with pytest.raises(DataError, match="does not answer"):
            ask(tmp_path, "session status")
        for channel in waiting:
            channel.close()
    assert ask(tmp_path, "session status") is None  # the file exists, but no daemon listens
