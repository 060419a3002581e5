"""Each broken recording gives one error that names file, line and column, and the remedy."""

from __future__ import annotations

import re
import struct
import zlib

import cv2
import numpy as np
import pytest

from tests.cli.test_import import photograph
from tests.recordings import read_rows, write_rows
from thermocald.errors import (
    ConfigurationError,
    ImageError,
    RecordingError,
    TestFieldError,
    ThermocaldError,
)
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.photogrammetry.camera_files.camera_record import number
from thermocald.photogrammetry.targets.image_file import decode_grey, image_size
from thermocald.store.logger.photographs import find_copies, read_photograph
from thermocald.store.recording import observation_file
from thermocald.store.recording.reader import open_recording, read_recording
from thermocald.store.recording.testfield_file import read_testfield


def set_field(path, line: int, column: str, value: str) -> None:
    rows = read_rows(path)
    rows[line - 2][column] = value
    write_rows(path, rows)


def refused(path, message: str) -> str:
    """Check that a recording is refused in one line, which holds a pattern; return the line."""
    with pytest.raises((RecordingError, TestFieldError), match=message) as caught:
        list(open_recording(path).iter_epochs())
    assert "\x1b" not in str(caught.value)
    return str(caught.value)


# a column, its value in line 4, part of the message
CELLS = {
    "observations.csv": [
        ("x", "NaN", "not a finite number"), ("x", "abc", "'abc' is not a number"),
        ("x", "", "is empty"), ("x", "1_2.5", "'1_2.5' is not a number"),
        ("x", "1e7", "px is on no image"), ("y", "-1e308", "px is on no image"),
        ("sx", "0", "above 0 px"), ("sx", "5e-324", "impossible"), ("sy", "1e300", "impossible"),
        ("target", "t999", "'t999' is not in testfield.csv"),
        ("target", "t0", "'t0' is duplicated in epoch 1"),
        ("epoch", "77", "epoch 77 is not in epochs.csv"), ("epoch", "1.5", "not an integer"),
    ],
    "epochs.csv": [
        ("frame_time", "1599999999.0", "runs backwards"), ("epoch", "1", "is duplicated or after"),
        ("temperature_time", "1599999999.0", "runs backwards"),
        ("frame_time", "2020-09-13 12:26", "write seconds since 1970"),
        ("frame_time", "1600000020,5", "write decimals with a point"),
        ("frame_time", "1e300", "Write seconds since 1970"), ("frame_time", "1.6e12", "they ms?"),
        ("temperature_time", "1.6e15", "they µs?"), ("frame_time", "1.6e18", "they ns?"),
        ("temperature", "NaN", "leave the field empty"), ("temperature", "1e300", "above 1000 °C"),
        ("temperature", "warm", "'warm' is not a number; leave the field empty"),
        ("temperature", "٢٥", "'٢٥' is not a number"), ("temperature", "-300", "absolute zero"),
        ("temperature_time", "", "empty although temperature was read"),
        ("frame", "frames/gone.png", "is missing"),
    ],
    "testfield.csv": [
        ("target", "t0", "'t0' is duplicated"), ("target", "", "every target needs a name"),
        ("sX", "-1", "must not be negative"), ("diameter", "0", "above 0 mm"),
        ("sX", "2e7", "must be between 1e-09 and 10000"), ("sZ", "5e-324", "between 1e-09 and"),
        ("X", "1e308", "must be within 1e+09 mm"), ("diameter", "1e300", "must be within 1e+09"),
        ("target", "t1\x1b[2J", "printable"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize("file", CELLS)
def test_a_bad_cell_is_named(recording_path, file, long, tmp_path, monkeypatch):
    """Of a long text, an error found in its binary copy names the line of the text."""
    if long:
        monkeypatch.setattr(observation_file, "LONG_FROM_BYTES", 0)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    whole = (recording_path / file).read_text()
    for column, value, message in CELLS[file]:
        set_field(recording_path / file, 4, column, value)
        where = f"{file}, line 4, column {column}: "
        refused(recording_path, f"{where}.*{re.escape(message)}")
        (recording_path / file).write_text(whole)


def put(old: str, new: str):
    """Return what replaces a pattern in a text."""
    return lambda text: re.sub(old, new, text)


def field(scale: float) -> str:
    """Return a wall of 44 × 2 units of `scale` mm as a test field."""
    rows = [f"t{i},{4 * scale * i},{scale * (i % 3)},1,,0,0,0\n" for i in range(12)]
    return "target,X,Y,Z,diameter,sX,sY,sZ\n" + "".join(rows)


KELVIN = "time,temperature,board_temperature\n1600000000,20,294.5\n1600000001,20,294.6\n"
# the damage to a file's text, part of the message
DAMAGES = {
    "epochs.csv": [
        (put(r"(?m)^(\d,[\d.]+,[\d.]+),[\d.]+", r"\1,294.5"), r"kelvin: subtract 273\.15"),
        (put(r"(?m)^(\d),[\d.]+", r"\1,1600000000"), "all epochs have the same time"),
        (put(",", ";"), "separate the columns with commas"),
    ],
    "testfield.csv": [
        (put(",", "\t"), "separate the columns with commas"),
        (lambda text: text.encode("utf-16"), "is not text in UTF-8; save it as CSV in UTF-8"),
        (put("X,Y,Z", "x,y,z"), "is 'x' meant"),
        (lambda _: field(0.001), "metres times 1000"),
        (lambda _: "target,X,Y,Z,diameter,sX,sY,sZ\n" + "".join(
            f"{i},{i % 500},{i // 500},0,1,0.1,0.1,0.1\n" for i in range(20_000)),
         "more than 4000 targets"),
        # lines are counted past quoted line ends and blank lines
        (put(r"t0(.*\n)(.*\n)t2,[-\d.]+", r'"first\ntarget"\1\n\2t2,nan'), "line 6, column X"),
    ],
    "observations.csv": [
        (lambda text: put(r"(?m)(,0\.\d+){2}$", ",0.3,0.1,0.0301")(text).replace("sy", "sy,sxy", 1),
         "line 2, column sxy: a covariance must be below sx·sy"),
        (put(",x,", ",x [px],"), "Write x, without"), (put("t5", '"t5'), "line .*is not readable"),
        (lambda text: text.rpartition(",")[0], "61: has 5 fields instead of 6; is the file cut"),
        (put("(?m)^(1,t1,[^,]*),", r"\1,5,"), "line 3.*has 7 fields instead of 6"),
        (lambda _: ",".join(map(str, range(20_000))) + "\n1\n", "20000 columns; at most 1000"),
        (lambda _: "a" * 300_000 + "\n1\n", "longer than"),
    ],
    "readings.csv": [(lambda _: KELVIN, "line 2, column board_temperature: seems to be in kelvin")],
}  # fmt: skip
MISSING = {
    "epochs.csv": ("board_temperature", "frame_time"), "observations.csv": ("sx",),
    "testfield.csv": ("sZ",), "recording.yaml": (),
}  # fmt: skip


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [(file, *damage) for file, damages in DAMAGES.items() for damage in damages],
)
def test_what_is_wrong_with_a_file_is_explained(recording_path, file, damage, message):
    path = recording_path / file
    damaged = damage(path.read_text() if path.exists() else "")
    path.write_bytes(damaged if isinstance(damaged, bytes) else damaged.encode())
    refused(recording_path, message)


@pytest.mark.parametrize("file", MISSING)
def test_files_that_are_none(recording_path, file):
    path = recording_path / file
    for column in MISSING[file]:
        whole = path.read_text()
        path.write_text(whole.replace(column, f"other_{column}"))
        refused(recording_path, rf"{file}, line 1: column {column} is missing")
        path.write_text(whole)
    for content in (b"", b"\x00" * 64, b"\xff\xfe\x00garbage", b'"never closed\n'):
        path.write_bytes(content)
        refused(recording_path, file)
    path.unlink()
    refused(recording_path, rf"{file}(: | is missing)|nothing to calibrate from")
    path.symlink_to("/dev/zero")
    refused(recording_path, r"is not a file|is missing")


# a key of recording.yaml, its value (None: without the key), part of the message
HEADS = [
    ("format", "thermocald-recording/9", "format: is 'thermocald-recording/9'"),
    ("format", None, "format: is missing"), ("interval", "-1", "it must be above 0"),
    ("interval", "soon", "'soon' is not a finite number"),
    ("interval", "1.0e-300", "interval: is 1e-300 s; it must be at least"),
    ("interval", "1.0e+300", "interval: is 1e+300 s; it is at most"),
    ("width", "0", "camera.width: is 0 px"), ("width", "12.5", "whole number"),
    ("width", "1" + "0" * 400, "camera.width"), ("width", None, "camera.width: is missing"),
    ("pixel_pitch", "1.12", "thousandths of a mm"), ("unit", "degF", "must be in degC"),
    ("pixel_pitch", "1.0e-300", "key camera.pixel_pitch"), ("principal_distance", "-3", "above 0"),
    ("principal_distance", "1.0e+300", "it is at most"),
    ("resolution", "fine", "temperatures.temperature.resolution"),
    ("resolution", "1.0e-300", "it must be at least"), ("name", "[small]", "name: must be text"),
    ("name", r'"x\e[2J"', "printable"), ("name", "small\nname: other", "is duplicated"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value", "message"), HEADS)
def test_a_bad_head_is_named(recording_path, key, value, message):
    path = recording_path / "recording.yaml"
    new = "" if value is None else f"{key}: {value}"
    pattern = rf"\b{key}: [^,}}\n]*" + "(, )?" * (value is None)
    path.write_text(re.sub(pattern, lambda _: new, path.read_text(), count=1))
    assert "recording.yaml" in refused(recording_path, re.escape(message))


def test_a_camera_of_ten_to_the_400_pixels_is_refused(tmp_path):
    huge = "1" + "0" * 400
    (tmp_path / "camera.yaml").write_text(f"width: {huge}\nheight: 480\npixel_pitch: 0.003\n")
    with pytest.raises(ConfigurationError, match="key width"):
        read_camera(tmp_path / "camera.yaml")
    with pytest.raises(ConfigurationError, match="too large"):
        number(int(huge), "fx")


def test_a_field_in_metres_is_recognised_by_the_principal_distance(recording_path):
    """A hall of 48 m in metres is 48 "mm": too near for a lens of 12 mm."""
    (recording_path / "testfield.csv").write_text(field(1.0))
    read_testfield(recording_path / "testfield.csv")
    head = recording_path / "recording.yaml"
    head.write_text(head.read_text().replace("distance: 3.04", "distance: 12.7"))
    refused(recording_path, "metres times 1000")
    refused(recording_path / "epochs.csv", "is not a folder")


GARBAGE = [
    "", "nan", "inf", "-1", "1e999", "0x10", "1_000", "t0", '"', "1", "2.5", "\x00", "²", "a,b\n",
    "!!bool x", '!!int ""', "2020-99-99", "!!timestamp x", "*a", "&a [*a]", "{", "~", ": ", "\n",
]  # fmt: skip


@pytest.mark.parametrize(
    "file", ["recording.yaml", "epochs.csv", "testfield.csv", "observations.csv"]
)
def test_garbage_within_a_good_file_is_one_error_that_names_it(recording_path, file):
    """The error of a damaged table may be in one that refers to it."""
    rng = np.random.default_rng(len(file))
    whole = (recording_path / file).read_bytes()
    for put in [*(word.encode() for word in GARBAGE), *(rng.bytes(9) for _ in range(15))] * 2:
        at, gone = int(rng.integers(len(whole))), int(rng.integers(40))
        (recording_path / file).write_bytes(whole[:at] + put + whole[at + gone :])
        message = file
        try:
            read_recording(recording_path)
        except ThermocaldError as error:
            message = str(error)
        assert any(path.name in message for path in recording_path.iterdir())
        assert "\n" not in message


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


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0)])
def test_the_resolution_of_the_focal_plane_is_per_inch_centimetre_or_millimetre(tmp_path, unit, mm):
    tags = {0xA20E: mm / 0.0016, 0xA210: unit}
    photograph(tmp_path / "p.jpg", "2026:06:14 12:00:01", tags=tags)
    assert read_photograph(tmp_path / "p.jpg").pixel_pitch == pytest.approx(0.0016)


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
