"""Input of excessive size is refused before any work, quickly and in one line."""

from __future__ import annotations

import os
import struct
import time
import zlib

import cv2
import numpy as np
import pytest

from tests.cli.test_import import photograph
from tests.store.test_bad_recordings import edit
from thermocald.cli.common import printable
from thermocald.errors import (
    ConfigurationError,
    ImageError,
    RecordingError,
    TestFieldError,
    ThermocaldError,
)
from thermocald.files import read_yaml
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.photogrammetry.camera_files.camera_record import number
from thermocald.photogrammetry.targets.image_file import decode_grey, image_size
from thermocald.store.logger.photographs import find_copies, read_photograph
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.table import Table
from thermocald.store.recording.testfield_file import read_testfield


def png_of_nothing(width, height):
    """Return the header of a PNG of many pixels, with hardly any data."""

    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(9)))


def test_an_image_too_large_is_refused_before_it_is_decoded(monkeypatch):
    def decode(*_):
        raise AssertionError("was decoded")

    monkeypatch.setattr(cv2, "imdecode", decode)
    with pytest.raises(ImageError, match="30000 × 30000 px"):
        decode_grey(png_of_nothing(30000, 30000))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".pgm"])
def test_sizes_are_read_from_heads(suffix):
    data = cv2.imencode(suffix, np.zeros((37, 53), np.uint8))[1].tobytes()
    assert image_size(data) == (53, 37)
    for cut in range(0, 40, 3):
        image_size(data[:cut])  # damage is no error here


def test_many_columns_are_refused_quickly(tmp_path):
    (tmp_path / "t.csv").write_text(",".join(f"c{i}" for i in range(20_000)) + "\n1\n")
    begin = time.perf_counter()
    with pytest.raises(RecordingError, match="20000 columns; at most 1000"):
        Table(tmp_path / "t.csv", ["c1"])
    assert time.perf_counter() - begin < 2
    (tmp_path / "t.csv").write_text("a" * 300_000 + "\n1\n")
    with pytest.raises(RecordingError, match="longer than"):
        Table(tmp_path / "t.csv", ["c1"])


def test_a_field_of_twenty_thousand_targets_is_refused(tmp_path):
    lines = (f"{i},{i % 500},{i // 500},0,1,0.1,0.1,0.1\n" for i in range(20_000))
    (tmp_path / "testfield.csv").write_text("target,X,Y,Z,diameter,sX,sY,sZ\n" + "".join(lines))
    with pytest.raises(TestFieldError, match="more than 4000 targets"):
        read_testfield(tmp_path / "testfield.csv")


@pytest.mark.parametrize(
    "name", ["observations.csv", "epochs.csv", "testfield.csv", "recording.yaml"]
)
def test_links_to_devices_are_refused(recording_path, name):
    (recording_path / name).unlink()
    os.symlink("/dev/zero", recording_path / name)
    with pytest.raises((RecordingError, TestFieldError), match=r"is not a file|is missing"):
        read_recording(recording_path)


@pytest.mark.parametrize(
    "text", ["a: " + "[" * 5000 + "]" * 5000, "\n".join(" " * i + "a:" for i in range(2000))]
)
def test_deep_yaml_is_refused(tmp_path, text):
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match="nested deeper than 60"):
        read_yaml(tmp_path / "x.yaml")


def test_a_width_of_ten_to_the_400_is_refused(recording_path, tmp_path):
    huge = "1" + "0" * 400
    edit(recording_path / "recording.yaml", "3280", huge)
    with pytest.raises(RecordingError, match=r"camera\.width"):
        read_recording(recording_path)
    (tmp_path / "camera.yaml").write_text(f"width: {huge}\nheight: 480\npixel_pitch: 0.003\n")
    with pytest.raises(ConfigurationError, match="key width"):
        read_camera(tmp_path / "camera.yaml")
    with pytest.raises(ConfigurationError, match="too large"):
        number(10**400, "fx")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [("recording.yaml", "name: small", 'name: "x\\\\e[2J"'), ("testfield.csv", "t1", "t1\x1b[2J")],
)
def test_names_that_a_terminal_would_obey_are_refused_or_shown_as_codes(
    recording_path, name, old, new
):
    edit(recording_path / name, old, new)
    with pytest.raises((RecordingError, TestFieldError), match="printable") as refused:
        read_recording(recording_path)
    assert "\x1b" not in str(refused.value)
    assert printable("a\x1b[31mb\x9b°\nc") == "a\\x1b[31mb\\x9b°\nc"


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
    for name in ("a.jpg", "c.jpg"):
        (tmp_path / name).write_bytes(b"the same")
    paths = [tmp_path / name for name in ("a.jpg", "gone.jpg", "c.jpg")]
    assert find_copies(paths) == {2: 0}
