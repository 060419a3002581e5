"""Observations as Parquet: the same numbers as CSV, the same checks, and back again."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.commands import call, succeed
from thermocald.errors import RecordingError
from thermocald.store.recording import observation_file
from thermocald.store.recording.reader import open_recording, read_recording
from thermocald.store.recording.table import Table

pyarrow = pytest.importorskip("pyarrow", reason="pip install thermocald[parquet]")
parquet = pytest.importorskip("pyarrow.parquet")


def convert(path, to):
    succeed("convert", path, "--to", to)


def same(a, b):
    for one, other in zip(a.epochs, b.epochs, strict=True):
        x, y = one.observations, other.observations
        assert np.array_equal(x.targets, y.targets)
        assert np.array_equal(x.points, y.points)
        assert np.array_equal(x.sigmas, y.sigmas)
        assert set(x.quality) == set(y.quality)
        for name in x.quality:
            assert np.array_equal(x.quality[name], y.quality[name], equal_nan=True)


def test_there_and_back_are_the_same_numbers(recording_path):
    """With more digits than ours, a column with gaps and one of text."""
    csv = recording_path / "observations.csv"
    lines = csv.read_text().splitlines()
    cells = lines[1].split(",")
    cells[2] = "1234.567890123456"
    lines[0] += ",blur,comment"
    lines[1] = ",".join(cells)
    rows = [f"{line},{'' if i % 2 else 0.1 + i},word {i}" for i, line in enumerate(lines[1:])]
    csv.write_text("\n".join([lines[0], *rows]) + "\n")
    before = read_recording(recording_path)
    convert(recording_path, "parquet")
    assert not csv.exists()
    same(before, read_recording(recording_path))
    streamed = list(open_recording(recording_path)._observation_file.stream(slice(0, 5)))
    assert [len(s) for s in streamed] == [len(e.observations) for e in before.epochs]
    convert(recording_path, "csv")
    same(before, read_recording(recording_path))
    assert "word 3" in csv.read_text()


@pytest.mark.slow
def test_a_long_text_is_converted_in_less_time_than_our_parser_takes(recording_path):
    """Regression: each number and word was made an object, 3.5 times the time."""
    for to in ("parquet", "csv"):
        convert(recording_path, to)  # with its imports
    csv = recording_path / "observations.csv"
    head, *rows = csv.read_text().splitlines()
    csv.write_text("\n".join([head, *rows * 10000]))
    begin = time.process_time()
    for chunk in Table(csv, ["x"]).chunks():
        for name in ("x", "y", "sx", "sy"):
            chunk.numbers(name)
    read = time.process_time()
    convert(recording_path, "parquet")
    assert time.process_time() - read < 0.7 * (read - begin)  # 0.2 to 0.3; was 1.2


@pytest.mark.parametrize("kind", ["uint8", "uint32", "int16"])
def test_names_of_targets_may_be_categories(recording_path, kind):
    """Polars writes a dictionary with unsigned indices, pandas one with signed ones."""
    before = read_recording(recording_path)
    convert(recording_path, "parquet")
    path = recording_path / "observations.parquet"
    table = parquet.read_table(path)
    names = table["target"].combine_chunks().dictionary_encode()
    codes = pyarrow.DictionaryArray.from_arrays(names.indices.cast(kind), names.dictionary)
    place = table.schema.get_field_index("target")
    parquet.write_table(table.set_column(place, "target", codes), path)
    same(before, read_recording(recording_path))


def test_text_that_cannot_be_read_is_not_converted(recording_path, monkeypatch):
    csv = recording_path / "observations.csv"
    head, first, *rest = csv.read_text().splitlines()
    cells = first.split(",")
    text = "\n".join([head, ",".join([*cells[:2], '"1,5"', *cells[3:]]), *rest])
    csv.write_text(text)
    done = call("convert", recording_path, "--to", "parquet")
    assert "line 2, column x: '1,5' is not a number; write decimals with a point" in done.stderr
    assert (done.returncode, csv.read_text()) == (1, text)
    # rows that are read again are not counted twice
    monkeypatch.setattr(observation_file, "_TEXT_BLOCK", 2000)
    steps: list[int] = []
    wrong = ",".join([*cells[:2], '"1,5"', *cells[3:]])
    csv.write_text("\n".join([head, first, *rest, wrong]))
    with pytest.raises(RecordingError, match=f"line {len(rest) + 3}, column x"):
        observation_file.csv_to_parquet(csv, csv.with_suffix(".parquet"), steps.append)
    assert len(steps) > 1
    assert sum(steps) == 0
    csv.write_text(f"{head}\n")
    assert "holds no observations" in call("convert", recording_path, "--to", "parquet").stderr
    csv.write_text("\n".join(["", head, first, *rest]))
    before = read_recording(recording_path)
    convert(recording_path, "parquet")
    same(before, read_recording(recording_path))


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("x", float("inf"), "row 3, column x: inf is not a finite number"),
        ("sx", -1.0, "row 3, column sx: a standard deviation must be above 0"),
        ("target", "nobody", "row 3, column target: target 'nobody'"),
        ("epoch", 77, "row 3, column epoch: epoch 77"),
        ("y", None, "row 3, column y: is empty"),
        ("epoch", 1.5, "row 3, column epoch: '1.5' is not an integer"),
        ("epoch", -1, "row 3, column epoch: '-1' is not an integer"),
    ],
)
def test_what_is_wrong_is_said_with_row_and_column(recording_path, column, value, words):
    convert(recording_path, "parquet")
    path = recording_path / "observations.parquet"
    table = parquet.read_table(path).to_pydict()
    table[column][2] = value
    if isinstance(value, float):
        table[column] = list(map(float, table[column]))
    parquet.write_table(pyarrow.table(table), path)
    with pytest.raises(RecordingError, match=words):
        read_recording(recording_path)


def test_damage_and_doubt_are_one_line(recording_path):
    csv = (recording_path / "observations.csv").read_bytes()
    convert(recording_path, "parquet")
    path = recording_path / "observations.parquet"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(RecordingError, match="not readable as Parquet"):
        read_recording(recording_path)
    path.write_bytes(data)
    (recording_path / "observations.csv").write_bytes(csv)
    with pytest.raises(RecordingError, match="keep one of them"):
        open_recording(recording_path)
