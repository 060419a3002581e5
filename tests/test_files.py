"""YAML files: what PyYAML would accept or take for ever to read is one clear error."""

from __future__ import annotations

import json
import os
import threading
import time

import pytest

from thermocald.errors import ConfigurationError, RecordingError
from thermocald.files import dump_yaml, overwrite_json, read_json, read_yaml


@pytest.fixture
def write(tmp_path):
    def write_text(text: str):
        path = tmp_path / "file.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write_text


def test_a_mapping_is_read_in_its_order_also_with_anchors(write):
    document = {"b": 1, "a": {"x": [1, 2.5, "ä"], "y": None}}
    path = write(dump_yaml(document))
    assert read_yaml(path) == document
    assert list(read_yaml(path)) == ["b", "a"]
    assert read_yaml(write("a: &x {k: 1}\nb: {<<: *x, l: 2}\n"))["b"] == {"k": 1, "l": 2}


def test_a_file_s_name_that_is_no_text_is_written_so_that_it_can_be_read(write):
    named = os.fsdecode(b"M\xe9 \xff")
    assert read_yaml(write(dump_yaml({"series": [named]}))) == {"series": ["M\\udce9 \\udcff"]}


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))

BAD = [
    ("", "is empty"),
    ("# only a comment\n", "is empty"),
    ("- 1\n", "must hold `key: value` lines"),
    ("a: 1\na: 2\n", r"line 2, column 1: key 'a' is duplicated"),
    ("a: {b: 1, b: 2}\n", "key 'b' is duplicated"),
    ("a: 010\n", "line 1, column 4: 010 is octal in YAML"),
    ("a: [1\n", "line 2"),
    ("1: x\n", "key 1 must be text"),
    ("a: !!python/object:os.system x\n", "could not determine a constructor"),
    ("a: !!bool x\n", "no YAML"),
    ("a: 2020-99-99\n", "no YAML"),
    ("[" * 5000, "file.yaml"),
    (BOMB, "aliases without end"),
    ("a: &a [*a]\n", "aliases without end"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_one_clear_error(write, text, message):
    path = write(text)
    with pytest.raises(ConfigurationError, match=message) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value)


def test_the_caller_chooses_the_error(tmp_path):
    with pytest.raises(RecordingError, match="No such file"):
        read_yaml(tmp_path / "none.yaml", RecordingError)


@pytest.mark.slow
def test_a_file_that_is_written_in_place_meanwhile_is_read_whole(tmp_path):
    """The status on a full disk is so; each document holds its number at both ends."""
    path, ended = tmp_path / "status.json", threading.Event()
    texts = [json.dumps({"a": n, "x": [10 + n] * (3 + 9000 * (n % 3)), "z": n}) for n in range(9)]
    path.write_bytes(texts[0].encode().ljust(131072))

    def write():
        while not ended.is_set():
            for text in texts:
                assert overwrite_json(path, text.encode())
                time.sleep(1e-3)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        # on a busy machine a read may always meet the writer, which here writes far too often
        seen = [document for _ in range(1000) if (document := read_json(path))]
        assert all(document["a"] == document["z"] for document in seen)
        assert len(seen) > 900
    finally:
        ended.set()
        writer.join()


@pytest.mark.parametrize("text", [None, "", "{", '{"a": 1', "[1]", "1", "\xff", '{"a": 1}{'])
def test_a_file_that_is_no_mapping_is_none(tmp_path, text):
    path = tmp_path / "x.json"
    if text is not None:
        path.write_text(text, encoding="latin-1")
    assert read_json(path) == {}
