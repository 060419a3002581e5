"""YAML files: what PyYAML would let through, or would need for ever, is one clear error."""

from __future__ import annotations

import pytest

from thermocald.errors import ConfigurationError, RecordingError
from thermocald.files import dump_yaml, read_yaml


@pytest.fixture
def write(tmp_path):
    def write_text(text: str):
        path = tmp_path / "file.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write_text


def test_a_mapping_is_read_in_its_order(write):
    document = {"b": 1, "a": {"x": [1, 2.5, "ä"], "y": None}}
    path = write(dump_yaml(document))
    assert read_yaml(path) == document
    assert list(read_yaml(path)) == ["b", "a"]


def test_anchors_may_be_used(write):
    assert read_yaml(write("a: &x {k: 1}\nb: {<<: *x, l: 2}\n"))["b"] == {"k": 1, "l": 2}


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))

BAD = [
    ("", "is empty"),
    ("# only a comment\n", "is empty"),
    ("- 1\n", "must hold `key: value` lines"),
    ("a: 1\na: 2\n", r"line 2, column 1: key 'a' is duplicated"),
    ("a: {b: 1, b: 2}\n", "key 'b' is duplicated"),
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
