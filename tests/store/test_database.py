"""The store returns what was stored, changes nothing, and has errors with a remedy."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.store.database.store import Store
from thermocald.store.recording.testfield_file import parse_testfield
from thermocald.store.series import NOT_CALIBRATED, EpochResult, Event


def test_an_epoch_comes_back_as_it_was(filled, make_epoch, make_result):
    store, series = filled
    (stored,) = store.epochs(series, 7, 7)
    epoch, result = make_epoch(7), make_result(7)
    assert stored.epoch.number == 7
    assert stored.epoch.frame_time == epoch.frame_time
    assert stored.epoch.temperatures == epoch.temperatures
    assert np.array_equal(stored.epoch.observations.targets, epoch.observations.targets)
    assert np.array_equal(stored.epoch.observations.points, epoch.observations.points)
    assert stored.epoch.observations.sigmas == pytest.approx(epoch.observations.sigmas, rel=1e-6)
    assert np.array_equal(stored.result.values, result.values)
    assert np.array_equal(stored.result.covariance, result.covariance)
    assert np.array_equal(stored.result.sd, result.sd)
    assert (stored.result.status, stored.result.rejected) == ("ok", (1, 5))
    assert (stored.extra, stored.clock_trusted, stored.revision) == ({"blur": 3.5}, True, 0)
    covariances = store.covariances(series, [3, 7, 99])
    assert np.array_equal(covariances[1], result.covariance)
    assert np.isnan(covariances[2]).all()


def test_columns_have_names_and_nan_where_nothing_is(filled, make_result):
    store, series = filled
    covariance = make_result(1).covariance.copy()
    covariance[8, :] = covariance[:, 8] = 0.0  # C1 is held fixed
    store.append(series, Epoch(30, 1.6e9, 1.6e9), EpochResult("ok", "", np.ones(16), covariance))
    store.append(series, Epoch(31, 1.6e9 + 300, np.nan), EpochResult("too_few_targets", "only 2"))
    held = store.series_columns(series, ["C1", "sd_C1", "sd_C2"])
    assert (held["C1"][-2], held["sd_C2"][-2] > 0) == (1.0, True)
    assert np.isnan(held["sd_C1"][-2])
    names = ["epoch", "c", "sd_Z0", "X0", "x0", "temperature", "blur", "n_rejected", "status"]
    columns = store.series_columns(series, names)
    assert list(columns) == names
    assert columns["epoch"].tolist() == [*range(1, 21), 30, 31]
    for i in (0, 12):
        result = make_result(i + 1)
        assert [columns[n][i] for n in ("c", "X0", "x0")] == result.values[[0, 13, 1]].tolist()
        assert columns["sd_Z0"][i] == result.sd[15]
    assert columns["temperature"][3] == 20.25
    assert columns["n_rejected"].tolist() == [2] * 20 + [0, 0]
    assert columns["status"].tolist() == ["ok"] * 21 + ["too_few_targets"]
    assert np.isnan([columns[n][-1] for n in ("c", "sd_Z0", "temperature", "blur")]).all()


def test_what_cannot_be_stored_is_refused(filled, make_epoch):
    store, series = filled
    for number in (20, 5):
        with pytest.raises(StoreError, match=f"epoch {number} of series 'M1' comes after epoch 20"):
            store.append(series, make_epoch(number))
    for name in ("c", "epoch", "status", "sd_x0"):
        with pytest.raises(StoreError, match=f"cannot be called '{name}'"):
            store.append(series, make_epoch(21), extra={name: 1.0})
    assert store.last_epoch(series) == 20


def test_a_later_calibration_replaces_what_is_read_but_not_what_is_kept(filled, make_result):
    store, series = filled
    store.append(series, Epoch(21, 1.6e9 + 210, np.nan, {"temperature": 30.0}), None)
    assert store.series_columns(series, ["status"])["status"][-1] == NOT_CALIBRATED
    store.amend(series, 21, make_result(21))
    store.amend(series, 4, make_result(400))
    store.amend(series, 4, make_result(401))
    assert store.examine().epochs == store.last_epoch(series)  # a later calibration is no epoch
    columns = store.series_columns(series, ["c", "status", "temperature", "blur"])
    assert columns["c"][[3, 20]].tolist() == [make_result(i).values[0] for i in (401, 21)]
    assert (columns["status"][-1], columns["temperature"][-1]) == ("ok", 30.0)
    assert columns["blur"][3] == 2.0
    (stored,) = store.epochs(series, 4, 4)
    assert (stored.revision, len(stored.epoch.observations)) == (2, 12)
    assert [s.epoch.number for s in store.epochs(series)] == list(range(1, 22))
    with pytest.raises(StoreError, match="has no epoch 99"):
        store.amend(series, 99, make_result(1))


def test_several_cameras_and_series(filled, head, field, make_epoch, make_result):
    store, first = filled
    camera = replace(head.camera, name="phone")
    second = store.create_series(replace(head, camera=camera), field)
    for i in (1, 2):
        store.append(second, make_epoch(i), make_result(100 + i))
        store.append(first, make_epoch(20 + i), make_result(20 + i))
    assert [(s.camera, s.name) for s in store.all_series()] == [("rpi", "M1"), ("phone", "M1")]
    found = store.series_columns(second, ["c"])["c"]
    assert found.tolist() == [make_result(i).values[0] for i in (101, 102)]
    assert len(store.series_columns(first, ["c"])["c"]) == 22
    with pytest.raises(StoreError, match=r"several series fit.*rpi/M1, phone/M1"):
        store.find_series(name="M1")
    with pytest.raises(StoreError, match="no such series"):
        store.find_series("tablet")
    with pytest.raises(StoreError, match="has a series 'M1' already"):
        store.create_series(head, field)


def test_events_stand_with_their_epoch(filled, make_epoch):
    store, series = filled
    knock = Event(1.6e9 + 211, "knock", "the camera moved", series.id, 21, {"chi2": 91.5})
    store.append(series, make_epoch(21))
    store.add_event(knock)
    gone = Event(1.6e9 + 300, "device_gone", "lens thermometer unplugged")
    store.add_event(gone)
    assert store.events() == [knock, gone]


@pytest.mark.parametrize("verb", ["UPDATE {} SET id = id + 1", "DELETE FROM {}"])
def test_the_file_itself_refuses_changes(filled, store_path, verb):
    store, _ = filled
    store.add_event(Event(0.0, "note", "x"))
    with closing(sqlite3.connect(store_path)) as database:
        for table in ("epoch", "detail", "series", "event", "testfield"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                database.execute(verb.format(table))


def test_an_epoch_without_a_whole_number_is_damage(filled, store_path):
    store, series = filled
    with closing(sqlite3.connect(store_path)) as other:
        other.executescript("DROP TRIGGER epoch_update; UPDATE epoch SET number = x'ff' WHERE id=2")
    with pytest.raises(StoreError, match=r"damaged: an epoch of M1 has the number b'\\xff'"):
        store.last_epoch(series)


@pytest.mark.parametrize("table", ["epoch", "detail"])
def test_rows_that_a_trigger_swallows_are_not_kept_and_said(
    filled, store_path, make_epoch, make_result, table
):
    with closing(sqlite3.connect(store_path)) as other:
        other.execute(f"CREATE TRIGGER x BEFORE INSERT ON {table} BEGIN SELECT RAISE(IGNORE); END")
    store, series = filled
    with pytest.raises(StoreError, match=f"keeps rows out of {table}"):
        store.append(series, make_epoch(21), make_result(21))


def test_a_failed_epoch_leaves_nothing(filled, make_epoch, make_result):
    store, series = filled
    before = list(store._db.iterdump())
    wrong = replace(make_epoch(21), frame_time=np.nan)  # a column that must not be empty
    with pytest.raises(StoreError, match="epoch 21 of series 'M1' was not stored"):
        store.append(series, wrong, make_result(21))
    assert list(store._db.iterdump()) == before
    store.append(series, make_epoch(21), make_result(21))


def test_readers_see_committed_epochs_while_it_is_written(filled, store_path, make_epoch, caplog):
    store, series = filled
    with Store.open(store_path) as reader:
        assert reader.last_epoch(series) == 20
        store.append(series, make_epoch(21))
        assert reader.last_epoch(series) == 21
        with pytest.raises(StoreError, match="read-only"):
            reader.append(series, make_epoch(22))
        for stored in reader.epochs(series):
            store.append(series, make_epoch(21 + stored.epoch.number))
        assert not caplog.records  # an epoch that came while the others were read is not missing


def test_threads_share_a_store(filled, head, field, make_epoch, make_result):
    store, _ = filled
    kinds = [store.create_series(replace(head, series=f"T{i}"), field) for i in range(4)]

    def work(series):
        for i in range(25):
            store.append(series, make_epoch(i), make_result(i))

    threads = [threading.Thread(target=work, args=(series,)) for series in kinds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [store.last_epoch(series) for series in kinds] == [24] * 4


def test_plain_sql_can_read_it(filled, store_path):
    """For users of the sqlite3 shell, parameters are columns and temperatures JSON."""
    with closing(sqlite3.connect(store_path)) as database, database:
        row = database.execute(
            "SELECT number, c, sd_c, centre_X0, json_extract(temperatures, '$.temperature') "
            "FROM epoch WHERE number = 3"
        ).fetchone()
    assert row[0] == 3
    assert row[4] == 20.1875
    assert all(isinstance(value, float) for value in row[1:])


def test_no_store(tmp_path):
    with pytest.raises(StoreError, match="there is no such store"):
        Store.open(tmp_path / "none.db")
    with pytest.raises(StoreError, match="is a folder, not a store"):
        Store.open(tmp_path)
    with pytest.raises(StoreError, match="its folder does not exist"):
        Store.open(tmp_path / "nowhere" / "none.db", "append")
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "empty.db"
    path.touch()
    with pytest.raises(StoreError, match="is empty"):
        Store.open(path)
    with Store.open(path, "append") as store:
        assert store.all_series() == []


@pytest.mark.parametrize("mode", ["read", "append"])
def test_not_ours(tmp_path, mode):
    text = tmp_path / "notes.txt"
    text.write_text("not a database, " * 100)
    with pytest.raises(StoreError, match="it is not a store"):
        Store.open(text, mode)
    assert text.read_text() == "not a database, " * 100
    other = tmp_path / "other.db"
    with closing(sqlite3.connect(other)) as database, database:
        database.execute("CREATE TABLE recipes (id)")
    before = other.read_bytes()
    with pytest.raises(StoreError, match="not a thermocald store"):
        Store.open(other, mode)
    assert other.read_bytes() == before


def test_checkpoint_empties_the_wal(filled, store_path, make_epoch):
    store, series = filled
    wal = store_path.with_name(f"{store_path.name}-wal")
    store.append(series, make_epoch(21))
    assert wal.stat().st_size > 0
    assert store.checkpoint()
    assert wal.stat().st_size == 0
    with Store.open(store_path) as reader:
        epochs = reader.epochs(series)
        next(epochs)  # a slow reader of epochs blocks no writer
        store._db.execute("PRAGMA busy_timeout = 50")
        store.append(series, make_epoch(22))
        assert store.checkpoint()
        reader._db.execute("BEGIN")
        reader.last_epoch(series)  # in the middle of a transaction
        store.append(series, make_epoch(23))
        assert not store.checkpoint()
        reader._db.execute("COMMIT")
    assert store.checkpoint()


def test_a_camera_without_a_test_field(filled, head):
    """A camera that is only acquired has a series too."""
    store = filled[0]
    empty = parse_testfield("target,X,Y,Z,diameter,sX,sY,sZ\n", store.path)
    series = store.create_series(replace(head, series="acquired"), empty)
    assert len(series.testfield.names) == 0
    assert store.find_series(name="acquired").id == series.id
