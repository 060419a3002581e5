"""Each broken recording gives one error that names file, line and column, and the remedy."""

from __future__ import annotations

import re

import pytest

from thermocald.errors import RecordingError, TestFieldError, ThermocaldError
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.testfield_file import read_testfield


def edit(path, old: str, new: str) -> None:
    text, replaced = re.subn(old, new, path.read_text(), count=1)
    assert replaced
    path.write_text(text)


def set_field(path, line: int, column: str, value: str) -> None:
    lines = path.read_text().split("\n")
    names = lines[0].split(",")
    fields = lines[line - 1].split(",")
    fields[names.index(column)] = value
    lines[line - 1] = ",".join(fields)
    path.write_text("\n".join(lines))


# file, line, column, value, part of the message
CELLS = [
    ("observations.csv", 5, "x", "NaN", "not a finite number"),
    ("observations.csv", 7, "x", "12,5", None),
    ("observations.csv", 7, "x", "abc", "'abc' is not a number"),
    ("observations.csv", 7, "x", "", "is empty"),
    ("observations.csv", 9, "sx", "0", "above 0 px"),
    ("observations.csv", 4, "target", "t999", "'t999' is not in testfield.csv"),
    ("observations.csv", 3, "target", "t0", "'t0' is duplicated in epoch 1"),
    ("observations.csv", 6, "epoch", "77", "epoch 77 is not in epochs.csv"),
    ("observations.csv", 6, "epoch", "1.5", "not an integer"),
    ("epochs.csv", 3, "frame_time", "1599999999.0", "runs backwards"),
    ("epochs.csv", 3, "temperature_time", "1599999999.0", "runs backwards"),
    ("epochs.csv", 4, "frame_time", "2020-09-13 12:26", "write seconds since 1970"),
    ("epochs.csv", 4, "frame_time", '"1600000020,5"', "write decimals with a point"),
    ("epochs.csv", 4, "temperature", "NaN", "leave the field empty"),
    ("epochs.csv", 4, "temperature", "warm", "'warm' is not a number; leave the field empty"),
    ("epochs.csv", 4, "temperature", "-300", "below absolute zero"),
    ("epochs.csv", 4, "temperature", "1e300", "above 1000 °C"),
    ("epochs.csv", 4, "temperature", "2_5.0", "'2_5.0' is not a number"),
    ("epochs.csv", 4, "temperature", "٢٥", "'٢٥' is not a number"),
    ("observations.csv", 7, "x", "1_2.5", "'1_2.5' is not a number"),
    ("epochs.csv", 4, "temperature_time", "", "empty although temperature was read"),
    ("epochs.csv", 3, "epoch", "1", "is duplicated or after a later one"),
    ("epochs.csv", 3, "frame", "frames/gone.png", "is missing"),
    ("testfield.csv", 3, "target", "t0", "'t0' is duplicated"),
    ("testfield.csv", 3, "target", "", "every target needs a name"),
    ("testfield.csv", 3, "sX", "-1", "must not be negative"),
    ("testfield.csv", 4, "diameter", "0", "above 0 mm"),
    # numbers that nothing measures
    *(("observations.csv", 5, column, value, "px is on no image")
      for column, value in (("x", "1e308"), ("y", "-1e308"), ("x", "1e7"))),
    *(("observations.csv", 5, column, value, "px is impossible")
      for column, value in (("sx", "1e-300"), ("sy", "1e300"), ("sx", "5e-324"), ("sy", "1e-9"))),
    *(("testfield.csv", 13, column, value, "must be between 1e-09 and 10000 mm")
      for column, value in (("sX", "1e-300"), ("sX", "2e7"), ("sZ", "5e-324"))),
    *(("testfield.csv", 13, column, value, "must be within 1e+09 mm")
      for column, value in (("X", "1e308"), ("diameter", "1e300"))),
    *(("epochs.csv", 6, column, value, "Write seconds since 1970")
      for column, value in (("frame_time", "1e300"), ("frame_time", "1e11"))),
    ("epochs.csv", 6, "frame_time", "1.6e12", "are they ms?"),
    ("epochs.csv", 6, "temperature_time", "1.6e15", "are they µs?"),
    ("epochs.csv", 6, "frame_time", "1.6e18", "are they ns?"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "line", "column", "value", "message"), CELLS)
def test_a_bad_cell_is_named(recording_path, file, line, column, value, message):
    set_field(recording_path / file, line, column, value)
    with pytest.raises((RecordingError, TestFieldError)) as caught:
        read_recording(recording_path)
    text = str(caught.value)
    assert f"{file}, line {line}" in text
    if message is None:
        assert "has 7 fields instead of 6" in text
    else:
        assert f"column {column}: " in text
        assert message in text


def in_metres(path) -> None:
    header, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    metres = [[name, *(n and str(float(n) / 1000) for n in rest)] for name, *rest in cells]
    path.write_text("\n".join([header, *map(",".join, metres)]) + "\n")


def in_every_row(column: str, value: str):
    return lambda path: [set_field(path, line, column, value) for line in range(2, 7)]


def without_its_end(path) -> None:
    path.write_text(path.read_text().rpartition(",")[0])


# a file, its damage, part of the message
FILES = {
    "kelvin": ("epochs.csv", in_every_row("temperature", "294.5"), r"kelvin: subtract 273\.15"),
    "kelvin in every reading": (
        "readings.csv", lambda path: path.write_text(
            "time,temperature,board_temperature\n1600000000,20,294.5\n1600000001,20,294.6\n"),
        r"line 2, column board_temperature: seems to be in kelvin"),
    "one time": (
        "epochs.csv", in_every_row("frame_time", "1600000000"), "all epochs have the same time"),
    "semicolons": (
        "epochs.csv", lambda path: path.write_text(path.read_text().replace(",", ";")),
        "separate the columns with commas"),
    "tabs": (
        "testfield.csv", lambda path: path.write_text(path.read_text().replace(",", "\t")),
        "separate the columns with commas"),
    "UTF-16": (
        "testfield.csv", lambda path: path.write_text(path.read_text(), "utf-16"),
        "testfield.csv: is not text in UTF-8; save it as CSV in UTF-8"),
    "another case": (
        "testfield.csv", lambda path: edit(path, "X,Y,Z", "x,y,z"), "is 'x' meant"),
    "a unit": ("observations.csv", lambda path: edit(path, ",x,", ",x [px],"), "Write x, without"),
    "half a last line": (
        "observations.csv", without_its_end,
        "line 61: has 5 fields instead of 6; is the file cut"),
    "metres": ("testfield.csv", in_metres, "metres times 1000"),
    "nothing": ("observations.csv", lambda path: path.unlink(), "nothing to calibrate from"),
    **{f"no {column}": (
        file, lambda path, column=column: edit(path, column, f"other_{column}"),
        rf"{file}, line 1: column {column} is missing")
       for file, column in (("epochs.csv", "board_temperature"), ("epochs.csv", "frame_time"),
                            ("observations.csv", "sx"), ("testfield.csv", "sZ"))},
    **{f"no {file}": (file, lambda path: path.unlink(), file)
       for file in ("recording.yaml", "epochs.csv", "testfield.csv")},
}  # fmt: skip


@pytest.mark.parametrize("case", FILES)
def test_what_is_wrong_with_a_file_is_explained(recording_path, case):
    file, damage, message = FILES[case]
    damage(recording_path / file)
    with pytest.raises((RecordingError, TestFieldError), match=message):
        read_recording(recording_path)


@pytest.mark.parametrize(
    "file", ["recording.yaml", "epochs.csv", "testfield.csv", "observations.csv"]
)
@pytest.mark.parametrize("content", [b"", b"\x00" * 64, b"\xff\xfe\x00garbage", b'"never closed\n'])
def test_files_that_are_none(recording_path, file, content):
    (recording_path / file).write_bytes(content)
    with pytest.raises(ThermocaldError, match=file):
        read_recording(recording_path)


def test_lines_are_counted_past_quoted_line_ends_and_blank_lines(recording_path):
    path = recording_path / "testfield.csv"
    header, *rows = path.read_text().splitlines()
    rows[0] = '"first\ntarget"' + rows[0][rows[0].index(",") :]
    rows[3] = rows[3].replace(rows[3].split(",")[1], "nan")
    path.write_text("\n".join([header, rows[0], "", *rows[1:]]) + "\n")
    with pytest.raises(TestFieldError, match="line 7, column X"):  # 1 + 2 + 1 + 3
        read_testfield(path)


HEADS = [
    ("format: .*", "format: thermocald-recording/9", "format: is 'thermocald-recording/9'"),
    ("format: .*", "other: 1", "format: is missing"),
    ("interval: .*", "interval: soon", "'soon' is not a finite number"),
    ("interval: .*", "interval: -1", "it must be above 0"),
    ("width: 3280", "width: 0", "camera.width: is 0 px"),
    ("width: 3280", "width: 12.5", "whole number"),
    ("width: 3280, ", "", "camera.width: is missing"),
    ("pixel_pitch: 0.00112", "pixel_pitch: 1.12", "thousandths of a mm"),
    ("principal_distance: 3.04", "principal_distance: -3", "above 0"),
    ("unit: degC", "unit: degF", "must be in degC"),
    ("resolution: 0.0625", "resolution: fine", "temperatures.temperature.resolution"),
    ("name: small", "name: [small]", "name: must be text"),
    ("name: small", "name: small\nname: other", "is duplicated"),
    ("name: small", "name: !!bool x", "no YAML"),
    ("name: small", "name: [small", "recording.yaml, line"),
    ("interval: 10.0", "interval: 1.0e-300", "interval: is 1e-300 s; it must be at least"),
    ("interval: 10.0", "interval: 1.0e+300", "interval: is 1e+300 s; it is at most"),
    ("pixel_pitch: 0.00112", "pixel_pitch: 1.0e-300", "key camera.pixel_pitch"),
    ("principal_distance: 3.04", "principal_distance: 1.0e+300", "it is at most"),
    ("principal_distance: 3.04", "principal_distance: 1.0e-300", "it must be at least"),
    ("resolution: 0.0625", "resolution: 1.0e-300", "it must be at least"),
]


@pytest.mark.parametrize(("old", "new", "message"), HEADS)
def test_a_bad_head_is_named(recording_path, old, new, message):
    path = recording_path / "recording.yaml"
    edit(path, old, new)
    with pytest.raises(RecordingError, match=re.escape(message)) as caught:
        read_recording(recording_path)
    assert "recording.yaml" in str(caught.value)


def test_a_field_in_metres_is_recognised_by_the_principal_distance(recording_path):
    """A hall of 48 m in metres is 48 "mm": too near for a lens of 12 mm."""
    field = recording_path / "testfield.csv"
    field.write_text(
        "target,X,Y,Z,diameter,sX,sY,sZ\n"
        + "".join(f"t{i},{4 * i},{i % 3},1,,0,0,0\n" for i in range(12))
    )
    read_testfield(field)
    edit(recording_path / "recording.yaml", "distance: 3.04", "distance: 12.7")
    with pytest.raises(TestFieldError, match="metres times 1000"):
        read_recording(recording_path)


def test_a_file_instead_of_a_folder(recording_path):
    with pytest.raises(RecordingError, match="is not a folder"):
        read_recording(recording_path / "epochs.csv")
