"""Garbage in any file gives only this program's errors, which name the file."""

from __future__ import annotations

import string

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermocald.errors import ThermocaldError
from thermocald.store.recording.reader import read_recording

FILES = ["recording.yaml", "epochs.csv", "testfield.csv", "observations.csv"]
QUICK = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

cells = st.one_of(
    st.text(max_size=12),
    st.sampled_from(
        ["", "nan", "inf", "-1", "1e999", "0x10", "1_000", "t0", '"', "1", "2.5", "\x00"]
    ),
    st.floats().map(repr),
    st.integers().map(str),
)
yaml_like = st.recursive(
    st.one_of(
        st.text(string.printable, max_size=15),
        st.sampled_from(
            ["!!bool x", '!!int ""', "2020-99-99", "!!timestamp x", "*a", "&a [*a]", "{", "~"]
        ),
    ),
    lambda inner: st.dictionaries(st.sampled_from("abcd"), inner, max_size=3).map(
        lambda d: "{" + ", ".join(f"{k}: {v}" for k, v in d.items()) + "}"
    ),
    max_leaves=6,
)


@pytest.mark.parametrize("file", FILES)
@QUICK
@given(data=st.data())
def test_any_bytes_within_a_good_file(recording_path, file, data):
    whole = (recording_path / file).read_bytes()
    at = data.draw(st.integers(0, len(whole)))
    gone = data.draw(st.one_of(st.integers(0, 40), st.just(len(whole))))
    put = data.draw(
        st.one_of(st.binary(max_size=12), cells.map(lambda c: c.encode(errors="ignore")))
    )
    (recording_path / file).write_bytes(whole[:at] + put + whole[at + gone :])
    try:
        read_recording(recording_path)
    except ThermocaldError as error:
        message = str(error)
        # the error of a damaged table may be in one that refers to it
        assert any(name in message for name in FILES)
    (recording_path / file).write_bytes(whole)


@QUICK
@given(value=yaml_like, key=st.sampled_from(["camera", "temperatures", "interval", "name", "x"]))
def test_any_yaml(recording_path, value, key):
    path = recording_path / "recording.yaml"
    whole = path.read_text()
    path.write_text(whole + f"\n{key}2: {value}\n" if key == "x" else f"{key}: {value}\n" + whole)
    message = "recording.yaml"
    try:
        read_recording(recording_path)
    except ThermocaldError as error:
        message = str(error)
    assert "recording.yaml" in message
    assert "\n" not in message
    path.write_text(whole)
