"""Columns are complete from chunks, tail and later calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.epoch import Epoch
from thermocald.store.database import columns
from thermocald.store.database.store import Store
from thermocald.store.series import EpochResult

CHUNK = 16
MERGED = 4
NAMES = ["epoch", "frame_time", "temperature", "c", "sd_c", "blur", "status"]


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(columns, "CHUNK", CHUNK)
    monkeypatch.setattr(columns, "MERGED", MERGED)


def result(number: int) -> EpochResult:
    status = "ok" if number % 5 else "weak"
    return EpochResult(status, "", np.full(16, float(number)), np.eye(16) * number**2 + 1e-9)


def epoch(number: int) -> Epoch:
    return Epoch(number, 10.0 * number, 10.0 * number + 1, {"temperature": 20 + 0.1 * number})


def expected(numbers) -> dict[str, list]:
    return {
        "epoch": [float(i) for i in numbers],
        "frame_time": [10.0 * i for i in numbers],
        "temperature": [20 + 0.1 * i for i in numbers],
        "c": [float(i) for i in numbers],
        "sd_c": [np.sqrt(i**2 + 1e-9) for i in numbers],
        "blur": [0.5 * i for i in numbers],
        "status": ["ok" if i % 5 else "weak" for i in numbers],
    }


def read(store: Store, series) -> dict[str, list]:
    return {name: column.tolist() for name, column in store.series_columns(series, NAMES).items()}


def chunks(store: Store) -> int:
    return store._db.execute("SELECT count(DISTINCT first_row) FROM column_chunk").fetchone()[0]


@pytest.mark.parametrize("size", [0, CHUNK - 1, CHUNK, 4 * CHUNK, 9 * CHUNK + 7])
def test_any_length(store, series, size):
    numbers = [3 * i for i in range(size)]  # numbers may have gaps
    for i in numbers:
        store.append(series, epoch(i), result(i), extra={"blur": 0.5 * i})
    assert chunks(store) == size // CHUNK // MERGED + size // CHUNK % MERGED
    assert read(store, series) == expected(numbers)


def test_later_calibrations_in_chunk_and_tail_of_two_series(store, series, head, field):
    other = store.create_series(replace(head, series="M2"), field)
    for i in range(CHUNK + 5):
        store.append(series, epoch(i), None, extra={"blur": 0.5 * i})
        store.append(other, epoch(100 + i), result(100 + i), extra={"blur": 50 + 0.5 * i})
    for i in range(CHUNK + 5):
        store.amend(series, i, result(i))
    assert read(store, series) == expected(range(CHUNK + 5))
    assert read(store, other) == expected(range(100, 105 + CHUNK))


def test_a_column_that_comes_and_goes(store, series):
    for i in range(4 * CHUNK):
        there = CHUNK <= i < 2 * CHUNK or i >= 3 * CHUNK
        store.append(series, epoch(i), result(i), extra={"contrast": float(i)} if there else {})
    contrast = store.series_columns(series, ["contrast"])["contrast"]
    want = np.arange(4.0 * CHUNK)
    want[:CHUNK] = want[2 * CHUNK : 3 * CHUNK] = np.nan
    assert np.array_equal(contrast, want, equal_nan=True)
    assert np.isnan(store.series_columns(series, ["never"])["never"]).all()


@pytest.mark.parametrize("data", ["x'00'", "zeroblob(length(data))"])
def test_of_a_broken_chunk_the_rows_are_read(store, series, data, caplog):
    for i in range(CHUNK):
        store.append(series, epoch(i), result(i))
    store._db.execute(f"UPDATE column_chunk SET data = {data} WHERE name = 'c'")
    assert store.series_columns(series, ["c"])["c"].tolist() == list(range(CHUNK))
    assert "read one by one" in caplog.text
    assert "chunk of column c is" in caplog.text


def test_another_chunk_length_later_on(store, series, monkeypatch):
    """Chunks of another length, as a newer version may write, are read."""
    for i in range(4 * CHUNK):
        if i == 2 * CHUNK + 5:
            monkeypatch.setattr(columns, "CHUNK", 7)
        store.append(series, epoch(i), result(i), extra={"blur": 0.5 * i})
    assert chunks(store) == 2 + (2 * CHUNK) // 7 // MERGED
    assert read(store, series) == expected(range(4 * CHUNK))


def test_a_merged_chunk_holds_what_came_late(store, series):
    for i in range(MERGED * CHUNK):
        store.append(series, epoch(i), None if i == 5 else result(i), extra={"blur": 0.5 * i})
        if i == 2 * CHUNK:
            store.amend(series, 5, result(3), extra={"contrast": 1.0})
            store.amend(series, 5, result(5), extra={"contrast": 2.0})
    assert chunks(store) == 1
    assert read(store, series) == expected(range(MERGED * CHUNK))
    assert store.series_columns(series, ["contrast"])["contrast"][[4, 5]].tolist()[1] == 2.0
    store.amend(series, 6, result(6))
    assert read(store, series) == expected(range(MERGED * CHUNK))
