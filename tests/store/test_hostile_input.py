"""Garbage in any file gives only this program's errors, which name the file."""

from __future__ import annotations

import string
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.cli.test_import import photograph
from thermocald.errors import ImageError, ThermocaldError
from thermocald.photogrammetry.targets.image_file import decode_grey, image_size
from thermocald.store.logger.photographs import find_copies, read_photograph
from thermocald.store.recording.reader import read_recording

FILES = ["recording.yaml", "epochs.csv", "testfield.csv", "observations.csv"]
QUICK = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
CELLS = ["", "nan", "inf", "-1", "1e999", "0x10", "1_000", "t0", '"', "1", "2.5", "\x00"]
cells = st.one_of(
    st.text(max_size=12), st.sampled_from(CELLS), st.floats().map(repr), st.integers().map(str)
)
YAML = ["!!bool x", '!!int ""', "2020-99-99", "!!timestamp x", "*a", "&a [*a]", "{", "~"]
yaml_like = st.recursive(
    st.one_of(st.text(string.printable, max_size=15), st.sampled_from(YAML)),
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
    words = cells.map(lambda c: c.encode(errors="ignore"))
    put = data.draw(st.one_of(st.binary(max_size=12), words))
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


def test_an_image_too_large_is_refused_before_it_is_decoded(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", None)
    png = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()
    head = b"IHDR" + struct.pack(">II", 30000, 30000) + png[24:29]
    with pytest.raises(ImageError, match="30000 × 30000 px"):
        decode_grey(png[:12] + head + struct.pack(">I", zlib.crc32(head)) + png[33:])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".pgm"])
def test_sizes_are_read_from_heads(suffix):
    data = cv2.imencode(suffix, np.zeros((37, 53), np.uint8))[1].tobytes()
    assert image_size(data) == (53, 37)
    for cut in range(0, 40, 3):
        image_size(data[:cut])  # damage is no error here


def test_damaged_exif_is_no_warning(tmp_path):
    """Warnings are errors here."""
    photograph(tmp_path / "p.jpg", "2026:06:14 12:00:01", "250", "+02:00")
    whole = (tmp_path / "p.jpg").read_bytes()
    at, refused = whole.index(b"Exif"), 0
    for cut in range(at + 10, at + 120, 5):
        (tmp_path / "p.jpg").write_bytes(whole[:cut] + bytes(4) + whole[cut + 4 :])
        try:
            read_photograph(tmp_path / "p.jpg")
        except ThermocaldError:
            refused += 1
    assert refused


def test_a_file_that_cannot_be_read_hides_no_copy(tmp_path):
    paths = [tmp_path / name for name in ("a.jpg", "gone.jpg", "c.jpg")]
    for path in paths[::2]:
        path.write_bytes(b"the same")
    assert find_copies(paths) == {2: 0}
