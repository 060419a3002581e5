"""Columns are complete from chunks, tail and later calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.epoch import Epoch
from thermocald.store.database import columns
from thermocald.store.series import EpochResult

CHUNK = 16


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(columns, "CHUNK", CHUNK)
    monkeypatch.setattr(columns, "MERGED", 4)


class Kept:
    """A series in a store, and what its columns must hold."""

    def __init__(self, store, series) -> None:
        self.store, self.series, self.rows = store, series, []

    def append(self, number: int, c: float = np.nan, **extra: float) -> None:
        epoch = Epoch(number, 10.0 * number, np.nan, {"temperature": 20 + 0.1 * number})
        self.store.append(self.series, epoch, self.result(c), extra=extra)
        self.rows.append({"epoch": number, "temperature": 20 + 0.1 * number, "c": c, **extra})

    def amend(self, row: int, c: float, **extra: float) -> None:
        self.store.amend(self.series, self.rows[row]["epoch"], self.result(c), extra=extra)
        self.rows[row] |= {"c": c, **extra}

    def result(self, c: float) -> EpochResult | None:
        """Return a result of which c and its standard deviation are known, None for NaN."""
        known = EpochResult("ok" if c % 5 else "weak", "", np.full(16, c), np.eye(16) * c**2)
        return None if np.isnan(c) else known

    def check(self) -> None:
        names = ["epoch", "temperature", "c", "blur", "contrast", "never"]
        found = self.store.series_columns(self.series, [*names, "sd_c", "status"])
        for name in names:
            want = [row.get(name, np.nan) for row in self.rows]
            np.testing.assert_array_equal(found[name], want)
        np.testing.assert_array_equal(found["sd_c"], found["c"])
        known = {True: "not_calibrated", False: "ok"}
        want = [known[np.isnan(c)] if c % 5 else "weak" for c in found["c"]]
        assert found["status"].tolist() == want


@pytest.mark.parametrize("size", [0, CHUNK - 1, CHUNK, 4 * CHUNK, 9 * CHUNK + 7])
def test_any_history(store, series, head, field, size, monkeypatch):
    """Gaps, later calibrations, columns that come and go, chunks of another length later on."""
    rng = np.random.default_rng(size)
    second = Kept(store, store.create_series(replace(head, series="M2"), field))
    first = Kept(store, series)
    for i in range(size):
        if i == 8 * CHUNK:
            monkeypatch.setattr(columns, "CHUNK", 7)  # as a newer version may write
        more = {"contrast": float(i)} if i // CHUNK % 3 == 1 else {}
        for kept in (first, second)[: 1 + i % 2]:
            kept.append(2 * i, np.nan if rng.random() < 0.3 else i + 1.0, blur=0.5 * i, **more)
            if rng.random() < 0.3:
                kept.amend(int(rng.integers(len(kept.rows))), i + 0.5, contrast=-1.0)
    first.check()
    second.check()
    count = "SELECT count(DISTINCT first_row) FROM column_chunk WHERE series_id = ?"
    (chunks,) = store._db.execute(count, (series.id,)).fetchone()
    assert chunks == {0: 0, 15: 0, 16: 1, 64: 1, 151: 5}[size]


@pytest.mark.parametrize("data", ["x'00'", "zeroblob(length(data))"])
def test_of_a_broken_chunk_the_rows_are_read(store, series, data, caplog):
    kept = Kept(store, series)
    for i in range(CHUNK):
        kept.append(i, i + 1.0)
    store._db.execute(f"UPDATE column_chunk SET data = {data} WHERE name = 'c'")
    kept.check()
    assert "read one by one" in caplog.text
    assert "chunk of column c is" in caplog.text
