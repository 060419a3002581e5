"""The store returns what was stored, changes nothing, and has errors with a remedy."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.database import columns
from thermocald.store.database.epochs import (
    POINT_QUANTUM_PX,
    pack_observations,
    unpack_covariance,
    unpack_observations,
)
from thermocald.store.database.file import read_wal_tail
from thermocald.store.database.store import Store
from thermocald.store.recording.testfield_file import parse_testfield
from thermocald.store.series import NOT_CALIBRATED, EpochResult, Event
from thermocald.store.sources import StoredRecording, open_source


def test_an_epoch_comes_back_as_it_was(filled, make_epoch, make_result):
    store, series = filled
    (stored,) = store.epochs(series, 7, 7)
    epoch, result = make_epoch(7), make_result(7)
    assert (stored.epoch.number, stored.epoch.temperatures) == (7, epoch.temperatures)
    assert stored.epoch.frame_time == epoch.frame_time
    assert np.array_equal(stored.epoch.observations.targets, epoch.observations.targets)
    assert np.array_equal(stored.epoch.observations.points, epoch.observations.points)
    assert stored.epoch.observations.sigmas == pytest.approx(epoch.observations.sigmas, rel=1e-6)
    assert np.array_equal(stored.result.values, result.values)
    assert np.array_equal(stored.result.sd, result.sd)
    assert (stored.result.status, stored.result.rejected) == ("ok", (1, 5))
    assert (stored.extra, stored.clock_trusted, stored.revision) == ({"blur": 3.5}, True, 0)
    covariances = store.covariances(series, [3, 7, 99])
    assert np.array_equal(covariances[1], result.covariance)
    assert np.isnan(covariances[2]).all()


def test_columns_have_names_and_nan_where_nothing_is(filled, make_result):
    """More of columns is in the histories below."""
    store, series = filled
    covariance = make_result(1).covariance.copy()
    covariance[8, :] = covariance[:, 8] = 0.0  # C1 is held fixed
    store.append(series, Epoch(30, 1.6e9, 1.6e9), EpochResult("ok", "", np.ones(16), covariance))
    store.append(series, Epoch(31, 1.6e9 + 300, np.nan), EpochResult("too_few_targets", "only 2"))
    names = ["X0", "x0", "sd_Z0", "n_rejected", "temperature", "C1", "sd_C1", "sd_C2"]
    columns = store.series_columns(series, names)
    assert list(columns) == names
    made = make_result(13)
    assert [columns[n][12] for n in names[:5]] == [*made.values[[13, 1]], made.sd[15], 2, 20.8125]
    assert (columns["C1"][-2], columns["sd_C2"][-2] > 0) == (1.0, True)
    assert np.isnan([columns["sd_C1"][-2], columns["sd_Z0"][-1], columns["temperature"][-1]]).all()


def test_what_cannot_be_stored_is_refused_and_leaves_nothing(filled, make_epoch, make_result):
    store, series = filled
    before = list(store._db.iterdump())
    for number in (20, 5):
        with pytest.raises(StoreError, match=f"epoch {number} of series 'M1' comes after epoch 20"):
            store.append(series, make_epoch(number))
    for name in ("c", "epoch", "status", "sd_x0"):
        with pytest.raises(StoreError, match=f"cannot be called '{name}'"):
            store.append(series, make_epoch(21), extra={name: 1.0})
    with pytest.raises(StoreError, match="epoch 21 of series 'M1' was not stored"):
        store.append(series, replace(make_epoch(21), frame_time=np.nan), make_result(21))
    # their details would take the place of the next epoch's
    many = replace(observations(100), quality={f"q{i}": np.zeros(100) for i in range(3000)})
    with pytest.raises(StoreError, match="observations are too many to store"):
        store.append(series, replace(make_epoch(21), observations=many), make_result(21))
    assert list(store._db.iterdump()) == before
    store.append(series, make_epoch(21), make_result(21))
    assert not store.examine().damaged


def test_a_later_calibration_replaces_what_is_read_not_what_is_kept(
    filled, make_epoch, make_result
):
    store, series = filled
    without = Epoch(21, 1.6e9 + 210, np.nan, {"temperature": 30.0})
    store.append(series, replace(without, frame=Path("21.jpg")), None)
    store.append(series, replace(without, number=22), None)  # no frame to calibrate it from
    assert store.deferred_epochs(series, 1, 22, 9) == [21]
    assert store.series_columns(series, ["status"])["status"][-1] == NOT_CALIBRATED
    for number, made in ((21, 21), (4, 400), (4, 401)):
        store.amend(series, number, make_result(made))
    assert store.deferred_epochs(series, 1, 22, 9) == []
    assert store.examine().epochs == store.last_epoch(series)  # a later calibration is no epoch
    (stored,) = store.epochs(series, 4, 4)
    assert stored.result.values.tolist() == make_result(401).values.tolist()
    assert (stored.revision, stored.extra, len(stored.epoch.observations)) == (2, {"blur": 2.0}, 12)
    assert [s.epoch.number for s in store.epochs(series)] == list(range(1, 23))
    seen = make_epoch(9).observations
    store.amend(series, 4, make_result(402), observations=seen)
    (stored,) = store.epochs(series, 4, 4)
    assert np.array_equal(stored.epoch.observations.points, seen.points)
    with pytest.raises(StoreError, match="has no epoch 99"):
        store.amend(series, 99, make_result(1))


def test_several_cameras_and_series(filled, head, field, make_epoch, make_result):
    store, first = filled
    second = store.create_series(replace(head, camera=replace(head.camera, name="phone")), field)
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
    # a camera that is only acquired has no test field
    empty = parse_testfield("target,X,Y,Z,diameter,sX,sY,sZ\n", store.path)
    acquired = store.create_series(replace(head, series="acquired"), empty)
    assert (store.find_series(name="acquired").id, acquired.testfield.names) == (acquired.id, ())


def test_the_file_keeps_events_refuses_changes_and_is_read_by_plain_sql(filled, store_path):
    store, series = filled
    knock = Event(1.6e9 + 211, "knock", "the camera moved", series.id, 20, {"chi2": 91.5})
    gone = Event(1.6e9 + 300, "device_gone", "lens thermometer unplugged")
    for event in (knock, gone):
        store.add_event(event)
    assert store.events() == [knock, gone]
    with closing(sqlite3.connect(store_path)) as database:
        for table in ("epoch", "detail", "series", "event", "testfield"):
            for verb in (f"UPDATE {table} SET id = id + 1", f"DELETE FROM {table}"):
                with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                    database.execute(verb)
        number, *floats, temperature = database.execute(
            "SELECT number, c, sd_c, centre_X0, json_extract(temperatures, '$.temperature') "
            "FROM epoch WHERE number = 3"
        ).fetchone()
    assert (number, temperature, {*map(type, floats)}) == (3, 20.1875, {float})


@pytest.mark.parametrize("table", ["epoch", "detail"])
def test_rows_that_a_trigger_swallows_are_not_kept_and_said(filled, store_path, make_epoch, table):
    with closing(sqlite3.connect(store_path)) as other:
        other.execute(f"CREATE TRIGGER x BEFORE INSERT ON {table} BEGIN SELECT RAISE(IGNORE); END")
    store, series = filled
    with pytest.raises(StoreError, match=f"keeps rows out of {table}"):
        store.append(series, make_epoch(21))
    assert store.last_epoch(series) == 20


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


def test_threads_share_a_store(store, store_path, head, field, make_epoch, make_result):
    kinds = [store.create_series(replace(head, series=f"T{i}"), field) for i in range(4)]

    def work(series):
        for i in range(25):
            store.append(series, make_epoch(i), make_result(i))

    threads = [threading.Thread(target=work, args=(series,)) for series in kinds]
    for thread in threads:
        thread.start()
    tails = [read_wal_tail(store_path.with_name(f"{store_path.name}-wal")) for _ in range(50)]
    for thread in threads:
        thread.join()
    assert [store.last_epoch(series) for series in kinds] == [24] * 4
    assert not any(lost for lost, _ in tails)  # what is being written is not damaged


@pytest.fixture
def places(tmp_path):
    """A folder with files that are no store."""
    (tmp_path / "notes.txt").write_text("not a database, " * 100)
    (tmp_path / "empty.db").touch()
    with closing(sqlite3.connect(tmp_path / "other.db")) as database, database:
        database.execute("CREATE TABLE recipes (id)")
    return tmp_path


@pytest.mark.parametrize(("name", "mode", "words"), [
    ("none.db", "read", "there is no such store"), (".", "read", "is a folder, not a store"),
    ("nowhere/none.db", "append", "its folder does not exist"), ("empty.db", "read", "is empty"),
    ("notes.txt", "read", "it is not a store"), ("notes.txt", "append", "it is not a store"),
    ("other.db", "read", "not a thermocald store"), ("other.db", "append", "not a thermocald"),
])  # fmt: skip
def test_what_is_no_store_is_refused_and_stays(places, name, mode, words):
    before = {path.name: path.read_bytes() for path in places.iterdir()}
    with pytest.raises(StoreError, match=words):
        Store.open(places / name, mode)
    assert {path.name: path.read_bytes() for path in places.iterdir()} == before


def test_an_empty_file_becomes_a_store(places):
    with Store.open(places / "empty.db", "append") as store:
        assert store.all_series() == []


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


def observations(n: int) -> Observations:
    rng = np.random.default_rng(1)
    return Observations(
        np.arange(n), rng.uniform(-50, 9000, (n, 2)), rng.uniform(0.001, 2.0, (n, 2))
    )


def packed(seen: Observations) -> Observations:
    return unpack_observations(pack_observations(seen))


def test_rounding_is_as_stated():
    """Five decimals, the numbers of observations.csv, are exact: see the first test."""
    seen = observations(5000)
    kept = packed(seen)
    error = kept.points - seen.points
    assert np.abs(error).max() <= 0.5 * POINT_QUANTUM_PX * (1 + 1e-6)
    assert error.std() == pytest.approx(POINT_QUANTUM_PX / np.sqrt(12), rel=0.05)
    assert kept.sigmas == pytest.approx(seen.sigmas, rel=6e-8)
    assert np.array_equal(kept.targets, seen.targets)


def test_what_does_not_fit_is_kept_otherwise():
    points, quality = np.array([[1e6, np.nan], [-3e5, 0.1]]), np.array([0.5, np.nan])
    more = {"blur": quality, "größe": np.array([1.0, 2.0])}
    seen = Observations(np.array([3, 3999]), points, np.ones((2, 2)), np.array([0.1, -0.2]), more)
    kept = packed(seen)
    assert kept.targets.tolist() == [3, 3999]
    assert np.array_equal(kept.points, points, equal_nan=True)
    assert kept.covariances == pytest.approx(seen.covariances)
    assert list(kept.quality) == ["blur", "größe"]
    assert np.array_equal(kept.quality["blur"], quality, equal_nan=True)


def test_broken_bytes_are_an_error():
    for data in (b"", b"\x01", b"\x02" * 40, pack_observations(observations(9))[:-1]):
        for unpack in (unpack_observations, unpack_covariance):
            with pytest.raises(StoreError):
                unpack(data)


def test_a_block_holds_what_its_epochs_hold(store_path, head):
    """Epochs of more than one row of details, without any, and calibrated again."""
    rng, size = np.random.default_rng(2), 75
    names = [str(i) for i in range(size)]
    field = TestField.build(names, rng.uniform(0, 2000, (size, 3)), 0.02, 20.0)

    def seen(number):
        n = int(rng.integers(3, size))
        sigmas = rng.uniform(0.01, 0.1, (n, 2))
        points = rng.uniform(0, 1e6 if number == 7 else 2400, (n, 2))  # too far for quanta
        sxy = 0.2 * sigmas.prod(axis=1) if number % 3 == 0 else None
        targets, blur = np.sort(rng.choice(size, n, replace=False)), rng.uniform(0.5, 2, n)
        return Observations(targets, points, sigmas, sxy, {"blur": blur})

    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for number in range(1, 40):
            there = None if number in (4, 5) else seen(number)
            covariance = np.eye(16) if number % 2 else None
            epoch = Epoch(2 * number, 10.0 * number, 10.0 * number, {}, observations=there)
            store.append(series, epoch, EpochResult("ok", covariance=covariance))
        store.amend(series, 20, EpochResult("ok", "again"))
        store.amend(series, 30, EpochResult("ok", "again"), observations=seen(15))
    with open_source(store_path) as store:
        (series,) = store.all_series()
        epochs = {e.epoch.number: e.epoch.observations for e in store.epochs(series)}
        want = ObservationGrid.from_observations(
            series.testfield, [epochs.get(number) for number in range(2, 80, 2)]
        )
        ((first, whole),) = StoredRecording(store, series).blocks()
        windows = [slice(5, 9), slice(20, 22)]
        parts = [grid for _, grid in StoredRecording(store, series).blocks(windows)]
    assert first == 0
    np.testing.assert_array_equal(whole.weights, want.weights)
    for grid, window in zip([whole, *parts], [slice(None), *windows], strict=True):
        np.testing.assert_array_equal(grid.points, want.points[window])


CHUNK = 16


@pytest.fixture
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


@pytest.mark.usefixtures("small_chunks")
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


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("data", ["x'00'", "zeroblob(length(data))"])
def test_of_a_broken_chunk_the_rows_are_read(store, series, data, caplog):
    kept = Kept(store, series)
    for i in range(CHUNK):
        kept.append(i, i + 1.0)
    store._db.execute(f"UPDATE column_chunk SET data = {data} WHERE name = 'c'")
    kept.check()
    assert "read one by one" in caplog.text
    assert "chunk of column c is" in caplog.text
