"""JSON lines into files and pipes."""

from __future__ import annotations

import errno
import json
import os

import numpy as np
import pytest

from thermocald.errors import DeviceGone, DeviceTimeout, TransientDeviceError
from thermocald.hal import VirtualClock, open_device

RESULT = {"device": "rpi", "epoch": 3, "c": np.float64(3.04), "x0": float("nan"), "status": "ok"}


def output(path, **options):
    options = {"path": str(path), "timeout_s": 0.1, **options}
    return open_device("output", "jsonl", options, VirtualClock())


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("umask", [0o000, 0o077, 0o777])
def test_lines_are_appended_to_a_file_that_only_we_write(tmp_path, umask):
    path, rotated = tmp_path / "results.jsonl", tmp_path / "results.jsonl.1"
    before = os.umask(umask)
    try:
        for epoch in (1, 2):
            with output(path) as device:
                device.emit(RESULT | {"epoch": epoch})
    finally:
        os.umask(before)
    assert lines(path) == [
        {"device": "rpi", "epoch": k, "c": 3.04, "x0": None, "status": "ok"} for k in (1, 2)
    ]
    assert path.stat().st_mode & 0o622 == 0o600
    with output(path) as device:
        path.rename(rotated)
        device.emit(RESULT)
    assert (len(lines(path)), len(lines(rotated))) == (1, 2)


@pytest.mark.parametrize(
    ("end", "left"),
    [
        (b"", b""), (b'{"a": 1}\n{"device": "rp', b'{"a": 1}\n'), (b"{", b""),
        (b'{"a": 1}\n\0\0\0', b'{"a": 1}\n'), (b'{"a": 1}\n{"b\0\0', b'{"a": 1}\n'),
        (b'{"a": 1}', b'{"a": 1}\n'), (b"my own notes", b"my own notes\n"),
        (b'{"\xc3', b""), (b"{" * 1_000_000, b"{" * 1_000_000 + b"\n"),
    ],
    ids=lambda text: str(text[:20]),
)  # fmt: skip
def test_half_a_line_of_a_killed_process_costs_no_further_line(tmp_path, end, left):
    path = tmp_path / "results.jsonl"
    path.write_bytes(end)
    with output(path) as device:
        device.emit({"epoch": 1})
    assert path.read_bytes() == left + b'{"epoch": 1}\n'


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_leaves_no_half_line(tmp_path, monkeypatch, number):
    path = tmp_path / "results.jsonl"
    with output(path) as device:
        device.emit(RESULT)
        write, left = os.write, [20]

        def full(file, data):
            if not left[0]:
                raise OSError(number, os.strerror(number))
            count = write(file, data[: left[0]])
            left[0] -= count
            return count

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(TransientDeviceError, match="the disk is full"):
            device.emit(RESULT)
        monkeypatch.undo()
        device.emit(RESULT)
    assert len(lines(path)) == 2


def test_a_pipe_that_nobody_empties_or_reads(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(DeviceGone, match="no program reads"):
        output(path).open()
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with output(path) as device:
        device.emit(RESULT)
        assert json.loads(os.read(reader, 4096))["epoch"] == 3
        many = (device.emit(RESULT) for _ in range(2000))
        with pytest.raises(DeviceTimeout, match="too slow"):
            list(many)
        os.close(reader)
        with pytest.raises(DeviceGone, match="any longer"):
            device.emit(RESULT)
