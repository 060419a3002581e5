"""Measure the store: bytes per epoch, reading columns, and a whole replay against its adjustments.

Run: python -m benchmarks.store [--epochs 1000000]
Bounds: file ≤ 1.4 × payload (observations of 18 bytes, parameters, covariance as float64); reading
9 columns of a million epochs into NumPy ≤ 2 × np.load and zlib.crc32 of the same data (the store
verifies all that it reads; np.load alone takes less than half of that time); read + adjust + store
≤ 4 × the adjustments alone. Exit status 1 if a bound is missed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.database.columns import CHUNK, MERGED, SeriesColumns
from thermocald.store.database.epochs import insert_epoch
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import open_recording
from thermocald.store.recording.writer import RecordingWriter
from thermocald.store.series import EpochResult, StoredEpoch

if TYPE_CHECKING:
    from collections.abc import Callable

BYTES_PER_OBSERVATION = 18  # row uint16, x, y int32, sx, sy float32: see store/database/epochs.py
BYTES_PER_RESULT = 16 * 8 + 136 * 8  # parameters, upper triangle of their covariance
COLUMNS = [
    "epoch",
    "frame_time",
    "temperature",
    "c",
    "sd_c",
    "x0",
    "y0",
    "sigma0",
    "n_observations",
]
BOUNDS = {"size": 1.4, "columns": 2.0, "end to end": 4.0}

HEAD = Head(
    "benchmark",
    "M1",
    10.0,
    CameraSpec("rpi", Sensor(3280, 2464, 0.00112), 3.04),
    {"temperature": Channel(), "board": Channel()},
)


def field_of(targets: int) -> TestField:
    rng = np.random.default_rng(1)
    names = [str(i) for i in range(targets)]
    return TestField.build(names, rng.uniform(0, 2000, (targets, 3)), 0.02, 20.0)


def result_of(rng: np.random.Generator) -> EpochResult:
    a = rng.normal(size=(30, 16))
    return EpochResult("ok", "", rng.normal(size=16), a.T @ a * 1e-6, 1.0, 250, 300)


def size_ratio(folder: Path, targets: int, epochs: int) -> float:
    """Return the bytes on disk, everything included, over the payload."""
    rng = np.random.default_rng(2)
    path = folder / f"size{targets}.db"
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(HEAD, field_of(targets))
        for i in range(epochs):
            points = rng.uniform(0, 2400, (targets, 2))
            sigmas = rng.uniform(0.01, 0.1, (targets, 2))
            seen = Observations(np.arange(targets), points, sigmas)
            temperatures = {"temperature": 20 + 0.0625 * (i % 400), "board": 40.0}
            epoch = Epoch(i, 1.6e9 + 10 * i, 1.6e9 + 10 * i + 0.7, temperatures, observations=seen)
            store.append(series, epoch, result_of(rng), extra={"blur": 0.8, "contrast": 120.0})
    size = sum(file.stat().st_size for file in folder.glob(f"{path.name}*"))
    return size / (epochs * (targets * BYTES_PER_OBSERVATION + BYTES_PER_RESULT))


def fill_columns(path: Path, epochs: int) -> None:
    """Fill a store with epochs without observations, in one transaction: only reading is measured.

    The first chunk and the last epochs are written as a series writes its rows. The chunks between
    are permutations of the first: a million rows would take minutes, and nothing here reads them.
    """
    rng = np.random.default_rng(3)
    size = MERGED * CHUNK
    chunks = max(epochs // size, 1)
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(HEAD, field_of(10))
        store._db.execute("BEGIN")
        for i in range(min(epochs, size)):
            _insert_row(store, series.id, i, rng)
        columns = SeriesColumns(store._db, series.id)
        columns.build()
        if chunks > 1:
            first = columns.latest(-1)
            for k in range(1, chunks):
                later = {name: rng.permutation(column) for name, column in first.items()}
                later["number"] = first["number"] + k * size
                for name in ("frame_time", "temperature_time"):
                    later[name] = first[name] + 10.0 * k * size
                columns.insert(k * size, (k + 1) * size - 1, later)
            for i in range(chunks * size, epochs):
                _insert_row(store, series.id, i, rng)
            columns.build()
        store._db.execute("COMMIT")


def _insert_row(store: Store, series: int, number: int, rng: np.random.Generator) -> None:
    time_s = 10.0 * number
    epoch = Epoch(number, time_s, time_s + 0.7, {"temperature": 20.0, "board": 40.0})
    values = rng.normal(size=16)
    result = EpochResult("ok", "", values, np.diag(values**2), 1.0, 250, 300)
    stored = StoredEpoch(epoch, EpochResult("ok", "", result.values), {}, True, 0)
    insert_epoch(store._db, series, stored)


def columns_ratio(folder: Path, epochs: int) -> tuple[float, float, float]:
    """Return (ratio, our time s, time of np.load and CRC-32 s), the least of several runs."""
    fill_columns(folder / "columns.db", epochs)
    with Store.open(folder / "columns.db") as store:
        series = store.find_series()
        columns = store.series_columns(series, COLUMNS)
        assert columns["epoch"].tolist() == list(range(epochs))
        np.save(folder / "columns.npy", np.stack(list(columns.values())))
        del columns
        ours = theirs = float("inf")
        for _ in range(15):  # in turn, so that both meet the same disturbances
            ours = min(ours, best(lambda: store.series_columns(series, COLUMNS), 2))
            theirs = min(theirs, best(lambda: zlib.crc32(np.load(folder / "columns.npy")), 2))
    return ours / theirs, ours, theirs


def end_to_end(folder: Path, epochs: int) -> tuple[float, dict[str, float]]:
    """Return read + adjust + store over the adjustments alone, and the ms per epoch of each."""
    from benchmarks.adjustment import EXTERIOR, INTERIOR, SENSOR, corner_field, observe
    from thermocald.photogrammetry.epoch.adjustment import adjust

    field = corner_field()
    rng = np.random.default_rng(4)
    path = folder / "M1"
    with RecordingWriter(path, HEAD, field) as writer:
        for i in range(epochs):
            seen = observe(field, rng)
            inside = ((seen.points > 0) & (seen.points < [SENSOR.width, SENSOR.height])).all(axis=1)
            epoch = Epoch(i, 10.0 * i, 10.0 * i, {}, observations=seen.select(inside))
            writer.append(epoch)

    def adjusted(epoch: Epoch) -> EpochResult:
        return EpochResult.from_adjustment(
            adjust(SENSOR, field, epoch.observations, INTERIOR, EXTERIOR)
        )

    loaded = list(open_recording(path).iter_epochs())
    file = folder / "replayed.db"

    def replay() -> None:
        for old in folder.glob("replayed.db*"):
            old.unlink()
        with Store.open(file, "append", durable=False) as store:
            recording = open_recording(path)
            series = store.create_series(recording.head, recording.testfield)
            for epoch in recording.iter_epochs():
                store.append(series, epoch, adjusted(epoch))

    def store_only() -> None:
        with Store.open(folder / f"only{time.monotonic_ns()}.db", "append", durable=False) as store:
            series = store.create_series(HEAD, field)
            for epoch in loaded:
                store.append(series, epoch, kept)

    kept = adjusted(loaded[0])
    times = {
        "read": best(lambda: list(open_recording(path).iter_epochs()), 3),
        "adjust": best(lambda: [adjusted(epoch) for epoch in loaded], 3),
        "store": best(store_only, 3),
        "replay": best(replay, 3),
    }
    ratio = times["replay"] / times["adjust"]
    return ratio, {name: 1e3 * seconds / epochs for name, seconds in times.items()}


def best(work: Callable[[], object], rounds: int = 7) -> float:
    """Return the least processor time of some runs, s."""
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--epochs", type=int, default=1_000_000, help="number of epochs whose columns are read"
    )
    options = parser.parse_args()
    missed = []

    def report(bound: str, what: str, ratio: float) -> None:
        print(f"{what:58s} {ratio:6.2f}   bound {BOUNDS[bound]:.1f}", flush=True)
        if ratio > BOUNDS[bound]:
            missed.append(what)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for targets in (50, 150, 400):
            ratio = size_ratio(folder, targets, 6000)
            report("size", f"file / payload, {targets} targets", ratio)
        ratio, times = end_to_end(folder, 300)
        report("end to end", "read + adjust + store / adjust, 150 targets", ratio)
        print("   ms per epoch: " + ", ".join(f"{n} {t:.3f}" for n, t in times.items()))
        ratio, ours, theirs = columns_ratio(folder, options.epochs)
        report("columns", f"{options.epochs} epochs × 9 columns / np.load and CRC-32", ratio)
        print(f"   store {1e3 * ours:.1f} ms, np.load and CRC-32 {1e3 * theirs:.1f} ms")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
