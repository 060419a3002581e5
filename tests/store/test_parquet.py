"""Observations as Parquet: the same numbers as CSV, the same checks, and back again."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.commands import call, succeed
from tests.recordings import read_rows, write_rows
from tests.store.small import assert_same_epochs
from tests.store.test_bad_recordings import refused
from thermocald.errors import RecordingError
from thermocald.store.recording import observation_file
from thermocald.store.recording.reader import open_recording, read_recording
from thermocald.store.recording.table import Table

pyarrow = pytest.importorskip("pyarrow", reason="pip install thermocald[parquet]")
parquet = pytest.importorskip("pyarrow.parquet")


def convert(path, to="parquet"):
    """Convert a recording; return the file and the epochs before."""
    before = read_recording(path).epochs
    succeed("convert", path, "--to", to)
    return path / f"observations.{to}", before


def check(path, epochs) -> None:
    assert_same_epochs(read_recording(path).epochs, epochs, rtol=0)


def test_there_and_back_are_the_same_numbers(recording_path, monkeypatch):
    """With more digits than ours, a column with gaps and one of text."""
    csv = recording_path / "observations.csv"
    rows = read_rows(csv)
    rows[0]["x"] = "1234.567890123456"
    for i, row in enumerate(rows):
        row |= {"blur": "" if i % 2 else f"{0.1 + i}", "comment": f"word {i}"}
    write_rows(csv, rows)
    path, before = convert(recording_path)
    assert not csv.exists()
    check(recording_path, before)
    parquet.write_table(parquet.read_table(path), path, row_group_size=7)  # epochs span groups
    with monkeypatch.context() as long:
        long.setattr(observation_file, "LONG_FROM_BYTES", 0)
        for i, epoch in enumerate(before):
            (seen,) = open_recording(recording_path)._observation_file.stream(slice(i, i + 1))
            assert np.array_equal(seen.points, epoch.observations.points)
    convert(recording_path, "csv")
    check(recording_path, before)
    assert "word 3" in csv.read_text()


@pytest.mark.slow
def test_a_long_text_is_converted_in_less_time_than_our_parser_takes(recording_path):
    """Regression: each number and word was made an object, 3.5 times the time."""
    for to in ("parquet", "csv"):
        csv, _ = convert(recording_path, to)  # with its imports
    head, *rows = csv.read_text().splitlines()
    csv.write_text("\n".join([head, *rows * 10000]))
    begin = time.process_time()
    for chunk in Table(csv, ["x"]).chunks():
        for name in ("x", "y", "sx", "sy"):
            chunk.numbers(name)
    read = time.process_time()
    succeed("convert", recording_path, "--to", "parquet")
    assert time.process_time() - read < 0.7 * (read - begin)  # 0.2 to 0.3; was 1.2


@pytest.mark.parametrize("kind", ["uint8", "uint32", "int16"])
def test_names_of_targets_may_be_categories(recording_path, kind):
    """Polars writes a dictionary with unsigned indices, pandas one with signed ones."""
    path, before = convert(recording_path)
    table = parquet.read_table(path)
    names = table["target"].combine_chunks().dictionary_encode()
    codes = pyarrow.DictionaryArray.from_arrays(names.indices.cast(kind), names.dictionary)
    place = table.schema.get_field_index("target")
    parquet.write_table(table.set_column(place, "target", codes), path)
    check(recording_path, before)


def test_text_that_cannot_be_read_is_not_converted(recording_path, monkeypatch):
    csv = recording_path / "observations.csv"
    whole, rows = csv.read_text(), read_rows(csv)
    write_rows(csv, [*rows[:-1], {**rows[-1], "x": "1,5"}])
    said = f"line {len(rows) + 1}, column x: '1,5' is not a number; write decimals with a point"
    for wrong, words in ((csv.read_text(), said), (whole[:22] + "\n", "holds no observations")):
        csv.write_text(wrong)
        done = call("convert", recording_path, "--to", "parquet")
        assert (words in done.stderr, done.returncode, csv.read_text()) == (True, 1, wrong)
    # rows that are read again are not counted twice
    write_rows(csv, [*rows[:-1], {**rows[-1], "x": "1,5"}])
    monkeypatch.setattr(observation_file, "_TEXT_BLOCK", 2000)
    steps: list[int] = []
    with pytest.raises(RecordingError, match=said.partition(":")[0]):
        observation_file.csv_to_parquet(csv, csv.with_suffix(".parquet"), steps.append)
    assert (len(steps) > 1, sum(steps)) == (True, 0)
    csv.write_text("\n" + whole)  # a blank line above
    check(recording_path, convert(recording_path)[1])


@pytest.mark.parametrize(("column", "value", "words"), [
    ("x", float("inf"), "inf is not a finite number"), ("y", None, "is empty"),
    ("sx", -1.0, "a standard deviation must be above 0"), ("target", "nobody", "target 'nobody'"),
    ("epoch", 77, "epoch 77"), ("epoch", 1.5, "'1.5' is not"), ("epoch", -1, "'-1' is not an int"),
])  # fmt: skip
def test_what_is_wrong_is_said_with_row_and_column(recording_path, column, value, words):
    path, _ = convert(recording_path)
    table = parquet.read_table(path).to_pydict()
    table[column][2] = value
    if isinstance(value, float):
        table[column] = list(map(float, table[column]))
    parquet.write_table(pyarrow.table(table), path)
    refused(recording_path, f"row 3, column {column}: {words}")


def test_damage_and_doubt_are_one_line(recording_path):
    path, _ = convert(recording_path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    refused(recording_path, "not readable as Parquet")
    path.with_suffix(".csv").write_bytes(data)
    refused(recording_path, "keep one of them")
