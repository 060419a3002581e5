"""Flipped bits on a card: a changed value is never returned as a right one."""

from __future__ import annotations

import numpy as np
import pytest

from tests.store.small import change
from thermocald.errors import StoreError, ThermocaldError
from thermocald.store.database import columns
from thermocald.store.database.store import Store
from thermocald.store.series import Event

NAMES = ["epoch", "frame_time", "c", "sd_x0", "status", "temperature", "blur"]


@pytest.fixture
def whole(store, series, make_epoch, make_result, monkeypatch) -> bytes:
    """A store with chunks, a later calibration and events, as bytes."""
    monkeypatch.setattr(columns, "CHUNK", 16)
    for i in range(1, 37):
        store.append(series, make_epoch(i), make_result(i), extra={"blur": 0.5 * i})
    store.amend(series, 7, make_result(70))
    store.add_event(Event(1.6e9, "knock", "somebody came"))
    store.close()
    return store.path.read_bytes()


def content(path) -> tuple[dict, list, list]:
    """Return all that a reader gets: columns, epochs, events."""
    with Store.open(path) as store:
        (series,) = store.all_series()
        read = store.series_columns(series, NAMES)
        epochs = [
            (s.epoch.number, s.epoch.frame_time, s.result.values.tolist(), s.revision,
             s.result.covariance.tolist(), s.epoch.observations.points.tolist(), s.result.status)
            for s in store.epochs(series)
        ]  # fmt: skip
        events = [e.text for e in store.events()]
        about = (series.head, series.identity, series.testfield.points.tolist())
    return {name: list(map(str, v)) for name, v in read.items()}, epochs, [events, about]


def test_a_flipped_bit_is_never_given_out(whole, store_path, caplog):
    truth = content(store_path)
    rng = np.random.default_rng(17)
    silent, unseen = [], []
    for _ in range(50):
        at, bit = int(rng.integers(len(whole))), int(rng.integers(8))
        data = bytearray(whole)
        data[at] ^= 1 << bit
        store_path.write_bytes(data)
        caplog.clear()
        try:
            found = content(store_path)
        except ThermocaldError:
            found = None
        if found is not None and found != truth and not caplog.messages:
            silent.append(at)
        try:
            with Store.open(store_path) as store:
                examined = store.examine()
        except ThermocaldError:
            continue
        if found != truth and not (examined.damaged or examined.gaps):
            unseen.append((at, bit, found is None))
    assert (silent, unseen) == ([], [])


def test_a_damaged_row_does_not_stop_new_ones(whole, store_path, make_epoch, make_result):
    change(store_path, "UPDATE epoch SET x0 = x0 + 1e-9 WHERE number = 36")
    with Store.open(store_path, "append", durable=False) as store:
        (series,) = store.all_series()
        for i in range(37, 56):
            store.append(series, make_epoch(i), make_result(i))
        assert store.last_epoch(series) == 55
        assert store.examine().damaged == ("rpi/M1, epoch 36",)
        kept = store.epochs(series)
        assert [next(kept).epoch.number for _ in range(35)] == list(range(1, 36))
        with pytest.raises(StoreError, match="epoch 36 is damaged"):
            next(kept)


@pytest.mark.parametrize("table", ["series", "testfield"])
def test_a_store_whose_series_are_gone_is_not_empty(whole, store_path, table):
    change(store_path, f"DELETE FROM {table}")
    with Store.open(store_path) as store, pytest.raises(StoreError, match="is damaged"):
        store.all_series()


def test_missing_epochs_are_named(whole, store_path):
    change(
        store_path,
        "DELETE FROM epoch WHERE number IN (3, 10, 11, 12)",
        "DELETE FROM detail WHERE id / 1024 NOT IN (SELECT id FROM epoch)",
    )
    with Store.open(store_path) as store:
        found = store.examine()
    assert [gap.text for gap in found.gaps] == [
        "rpi/M1: epoch 3 is missing", "rpi/M1: epochs 10 to 12 are missing (3)"
    ]  # fmt: skip
    assert found.damaged == ()
