"""Helpers of everything: files of YAML and JSON, host names, numbers, several processes."""

from __future__ import annotations

import itertools
import json
import os
import threading
import time
from pathlib import Path

import pytest

import thermocald as tc
from thermocald.addresses import HostNames, is_loopback
from thermocald.cli.common import printable
from thermocald.errors import ConfigurationError, DataError, RecordingError, ThermocaldError
from thermocald.files import (
    check_output,
    dump_yaml,
    is_database,
    overwrite_json,
    read_json,
    read_yaml,
    write_text,
)
from thermocald.numbers import typeset_powers, with_sd
from thermocald.parallel import in_order


def read(folder, text: str, error=ConfigurationError):
    """Read a text as a file of YAML."""
    (folder / "file.yaml").write_text(text, encoding="utf-8")
    return read_yaml(folder / "file.yaml", error)


def test_a_mapping_is_read_in_its_order_also_with_anchors(tmp_path):
    document = {"b": 1, "a": {"x": [1, 2.5, "ä"], "y": None}}
    assert list(read(tmp_path, dump_yaml(document)).items()) == list(document.items())
    assert read(tmp_path, "a: &x {k: 1}\nb: {<<: *x, l: 2}\n")["b"] == {"k": 1, "l": 2}
    # a file's name that is no text
    named = dump_yaml({"series": [os.fsdecode(b"M\xe9 \xff")]})
    assert read(tmp_path, named) == {"series": ["M\\udce9 \\udcff"]}


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))

BAD = [
    ("", "is empty"), ("# only a comment\n", "is empty"), ("1: x\n", "key 1 must be text"),
    ("- 1\n", "must hold `key: value` lines"), ("a: {b: 1, b: 2}\n", "key 'b' is duplicated"),
    ("a: 1\na: 2\n", r"line 2, column 1: key 'a' is duplicated"), ("a: [1\n", "line 2"),
    ("a: 010\n", "line 1, column 4: 010 is octal in YAML"), ("[" * 5000, "file.yaml"),
    ("a: 1:30", "1:30 is 90 in YAML"),
    ("a: !!python/object:os.system x\n", "line 1, column 4: holds a tag, `!…`"),
    ("a:\n\tb: 1\n", "line 2, column 1: a line or a value begins with a tab"),
    ("a: b: c\n", "line 1, column 5: `: ` must not stand here"),
    ("a: !!bool x\n", "no YAML"), ("a: 2020-99-99\n", "no YAML"),
    ("a: " + "[" * 5000 + "]" * 5000, "nested deeper than 60"),
    ("\n".join(" " * i + "a:" for i in range(2000)), "nested deeper than 60"),
    (BOMB, "aliases without end"), ("a: &a [*a]\n", "aliases without end"),
    ('a: ["x\\0y"]\n', r"'x\\x00y' holds a NUL character"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), BAD)
def test_one_clear_error_of_the_kind_that_the_caller_wants(tmp_path, text, message):
    for kind in (ConfigurationError, RecordingError):
        with pytest.raises(kind, match=message) as caught:
            read(tmp_path, text, kind)
        assert str(tmp_path / "file.yaml") in str(caught.value)


def test_a_path_with_nul_is_an_error_in_words_and_no_pipe_is_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    assert not any(map(is_database, (Path("x\0y"), tmp_path / "pipe")))
    for use in (
        tc.open, tc.load_camera, tc.read_testfield, lambda path: tc.calibrate([path], path),
        read_yaml, lambda path: write_text(path, ""), lambda path: write_text(path / "file", ""),
        lambda path: check_output(path, "folder"),
    ):  # fmt: skip
        with pytest.raises(ThermocaldError, match=r"NUL|null byte"):
            use(Path("x\0y"))


@pytest.mark.slow
def test_a_file_that_is_written_in_place_meanwhile_is_read_whole(tmp_path):
    """The status on a full disk is so; each document holds its number at both ends."""
    path, ended = tmp_path / "status.json", threading.Event()
    texts = [json.dumps({"a": n, "x": [10 + n] * (3 + 9000 * (n % 3)), "z": n}) for n in range(9)]
    path.write_bytes(texts[0].encode().ljust(131072))

    def write():
        for text in itertools.takewhile(lambda _: not ended.is_set(), itertools.cycle(texts)):
            assert overwrite_json(path, text.encode())
            time.sleep(1e-3)

    writer = threading.Thread(target=write)
    writer.start()
    # on a busy machine a read may always meet the writer, which here writes far too often
    seen = [document for _ in range(1000) if (document := read_json(path))]
    ended.set()
    writer.join()
    assert all(document["a"] == document["z"] for document in seen)
    assert len(seen) > 900


def test_a_file_that_is_no_mapping_is_none(tmp_path):
    assert read_json(tmp_path / "x.json") == {}
    for text in (b"", b"{", b'{"a": 1', b"[1]", b"1", b"\xff", b'{"a": 1}{'):
        (tmp_path / "x.json").write_bytes(text)
        assert read_json(tmp_path / "x.json") == {}


OURS = {
    "127.0.0.1", "127.0.0.1:8437", "127.1.2.3:80", "localhost", "LOCALHOST:8437", "localhost.",
    "localhost.:8437", "[::1]", "[::1]:8437", "[::ffff:127.0.0.1]:1", "127.0.0.1.", "127.0.0.1:",
    "192.168.1.5:8437", "Pi.Local:8437", "pi.local.", "[fe80::1]:80",
}  # fmt: skip
FOREIGN = {
    "127.0.0.1.evil.com", "127.evil.com", "127.0.0.1.evil.com:8437", "localhost.evil.com", "",
    "evil.com", "evil.com:127", "127.0.0.1@evil.com", "[::1].evil.com", "[::1", "::1", ":8437",
    "[127.0.0.1]", "127.0.0.1:99999", "127.0.0.1:80:80", "127.0.0.1:8O", "2130706433", "127.1",
    "0x7f.0.0.1", "0.0.0.0", "192.168.1.50", "pi.local.evil.com", "127.0.0.1..",
    "localhost,evil.com", "127.0.0.1 evil.com", "127.0.0.1\t", "１２７.0.0.1", "[::ffff:8.8.8.8]",
    "[::1]8437",
}  # fmt: skip
ORIGINS = {
    True: ("http://127.0.0.1:8437", "https://localhost", "http://[::1]:1"),
    False: ("null", "http://127.0.0.1.evil.com", "file://", "", "http://evil.com", "http://[",
            "ftp://localhost"),
}  # fmt: skip
LOOPBACK = {
    True: ("127.0.0.1", "127.9.9.9", "localhost", "::1"),
    False: ("127.0.0.1.evil.com", "127.evil.com", "0.0.0.0", "::"),
}


def test_host_names_and_origins_are_ours_or_foreign():
    known = HostNames("192.168.1.5", ["pi.local", "fe80::1"])
    assert {host for host in OURS | FOREIGN if known.allow_host(host)} == OURS
    for expected in (True, False):
        for origin in ORIGINS[expected]:
            assert HostNames("127.0.0.1").allow_origin(origin) is expected, origin
        for host in LOOPBACK[expected]:
            assert is_loopback(host) is expected, host


def test_powers_are_raised_and_names_are_left():
    for text, expected in {
        "a_B1 = (-7.69 ± 0.33)e-7 mm-1/K, 2.0e-06": "a_B1 = (−7.69 ± 0.33)·10⁻⁷ mm⁻¹/K, 2.0·10⁻⁶",
        "A2 = (4.9 ± 0.3)e+12 mm-4": "A2 = (4.9 ± 0.3)·10¹² mm⁻⁴",
        "above 40.2 ± 0.3 degC; --unit degC": "above 40.2 ± 0.3 °C; --unit degC",
        "from -35 (-1.5 K) by 3-4 of M-1, -x": "from −35 (−1.5 K) by 3-4 of M-1, -x",
        "series mm-1-b of IMG_1e5.jpg at 10 mm": "series mm-1-b of IMG_1e5.jpg at 10 mm",
        "(see M1)e-7, 0x1e5, 1e5b": "(see M1)e-7, 0x1e5, 1e5b",
    }.items():
        assert typeset_powers(text) == expected
    assert with_sd(-1e-9, 1e-6) == "(0.0 ± 1.0)·10⁻⁶"  # no negative nothing


def test_what_a_terminal_would_obey_is_shown_as_codes():
    assert printable("a\x1b[31mb\x9b°\nc") == "a\\x1b[31mb\\x9b°\nc"


def scaled(factor, item):
    if item == "bad":
        raise ValueError("this one is bad")
    if item == "dies":
        os._exit(3)
    return factor * item


@pytest.mark.parametrize(
    ("jobs", "last", "error", "words"),
    [(1, "bad", ValueError, "this one is bad"), (2, "bad", ValueError, "this one is bad"),
     (2, "dies", DataError, "give fewer --jobs")],
)  # fmt: skip
def test_results_come_in_order_and_an_error_comes_through(jobs, last, error, words):
    """Items are taken as results are asked for: a year of blocks must not be in memory."""
    taken: list = []
    items = (taken.append(item) or item for item in [*range(12), last, *range(90)])
    results = in_order(scaled, 3, items, jobs)
    assert next(results) == 0
    assert len(taken) <= 8
    assert [next(results) for _ in range(8)] == [3 * k for k in range(1, 9)]
    with pytest.raises(error, match=words):
        list(results)
    assert list(in_order(scaled, 3, [], jobs)) == []
