"""Measure a fleet: a server's size and response times, forwarding, and a second Dask worker.

    python -m benchmarks.fleet server [--full]             # 5 million epochs; --full: 50 million
    python -m benchmarks.fleet workers [--full]            # 400 frames on Dask; --full: 1,200
    python -m benchmarks.fleet forward                     # rows per second, bytes per epoch

`server` needs PostgreSQL (it makes and removes a cluster of its own) and about 0.6 kB of disk per
epoch. The rows are generated without covariances and observations, which overview and columns do
not read; the studied year, with an epoch per hour, has them. Measure on a quiet machine with a core
for each worker. Exit status 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import numpy as np
import psycopg
from psutil import Process

from benchmarks.generated_fleet import GeneratedCamera, add_camera
from tests.fleet.conftest import new_cluster
from tests.fleet.dask_cluster import DaskCluster
from thermocald.acquisition.calibrator import Calibrator
from thermocald.epoch import Epoch
from thermocald.fleet.forward import Forwarder
from thermocald.fleet.overview import fleet_document
from thermocald.fleet.reprocess import calibrate_block, find_blocks, run_tasks
from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.physics.presets import preset_simulation
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult
from thermocald.store.server.connection import ServerAddress, create_tables
from thermocald.store.server.reader import ServerStore

CAMERAS = 50
COLUMNS = 100_000  # epochs whose columns are read
STUDIED = 8760  # epochs of the studied year: one per hour
FRAMES = 20  # per recording that the workers measure again
YEAR_S = 365 * 86400.0
NAMES = ["epoch", "frame_time", "c", "x0", "y0", "sd_c", "sigma0", "temperature"]


def write_frame_archive(folder: Path, recordings: int, frames: int) -> None:
    """Write recordings M00, M01 … of the same rendered 8 MP frames, which are stored once."""
    simulation = preset_simulation("rpi-v2.1-heating", 1, "M00")
    programme = replace(simulation.programme, epochs=frames)
    first = folder / "M00"
    replace(simulation, programme=programme).write(first, with_frames=True)
    for i in range(1, recordings):
        other = folder / f"M{i:02d}"
        shutil.copytree(first, other, copy_function=os.link)
        head = other / "recording.yaml"
        text = head.read_text().replace("M00", other.name)
        head.unlink()
        head.write_text(text)


def timed(call):
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def server(full: bool) -> dict[str, float]:
    """Time the overview of a fleet, and one camera's columns and year from server and store."""
    epochs = 1_000_000 if full else 100_000
    found: dict[str, float] = {"epochs": CAMERAS * epochs}
    with new_cluster() as cluster, tempfile.TemporaryDirectory() as folder:
        with psycopg.connect(cluster.address(), autocommit=True) as connection:
            for setting in ("checkpoint_timeout = '1h'", "max_wal_size = '8GB'"):
                connection.execute(f"ALTER SYSTEM SET {setting}")
            connection.execute("SELECT pg_reload_conf()")
        address = _create_database(cluster)
        base = GeneratedCamera("", epochs=epochs, interval=YEAR_S / epochs, end=time.time() - 30)
        rng = np.random.default_rng(1)
        begin = time.perf_counter()
        with psycopg.connect(cluster.address(name="thermocald"), autocommit=True) as connection:
            for i in range(CAMERAS):
                rates = tuple((np.array(base.rates) * (1 + 0.1 * rng.standard_normal(3))).tolist())
                add_camera(connection, replace(base, station=f"gauge{i:02d}", rates=rates))
            found["generated_s"] = time.perf_counter() - begin
            connection.execute("VACUUM (ANALYZE) epoch")
            found["bytes_an_epoch"] = _table_bytes(connection) / found["epochs"]
        whole = Path(cluster.address(name="thermocald"))
        found["overview_s"], document = timed(lambda: fleet_document([whole]))
        found["overview_again_s"], _ = timed(lambda: fleet_document([whole]))
        found["sound"] = document["summary"]["sound"]
        found["counted"] = document["summary"]["epochs"]
        print(json.dumps(found), file=sys.stderr, flush=True)
        with psycopg.connect(cluster.address(name="thermocald"), autocommit=True) as connection:
            add_camera(connection, replace(base, station="columns", epochs=COLUMNS))
        one, path = Path(f"{whole}?station=columns"), Path(folder) / "columns.db"
        _copy_to_store(one, path)
        for name, opened in (("server", ServerStore.open(one)), ("store", Store.open(path))):
            with opened:
                series = opened.find_series()
                found[f"columns_from_{name}_s"] = min(
                    timed(lambda: opened.series_columns(series, NAMES))[0]  # noqa: B023
                    for _ in range(3)
                )
        path = Path(folder) / "year.db"
        _write_year(path)
        Forwarder(path, address, "studied").send_waiting()
        for name, source in (("server", f"{whole}?station=studied"), ("store", path)):
            command = [sys.executable, "-m", "thermocald", "study", source, "--sets", "1000"]
            done = [str(part) for part in (*command, "--json", Path(folder) / f"{name}.json")]
            found[f"study_from_{name}_s"], _ = timed(
                lambda: subprocess.run(done, check=True, stdout=subprocess.DEVNULL)  # noqa: B023
            )
    found["columns_ratio"] = found["columns_from_server_s"] / found["columns_from_store_s"]
    found["study_ratio"] = found["study_from_server_s"] / found["study_from_store_s"]
    return found


def _create_database(cluster) -> ServerAddress:
    with psycopg.connect(cluster.address(), autocommit=True) as connection:
        connection.execute("CREATE DATABASE thermocald")
    address = ServerAddress.parse(cluster.address(name="thermocald"))
    create_tables(address)
    return address


def _table_bytes(connection: psycopg.Connection) -> float:
    """Return the size of the epochs' tables with their indexes, bytes."""
    size = "SELECT sum(pg_total_relation_size(inhrelid))::float8 FROM pg_inherits"
    return connection.execute(f"{size} WHERE inhparent = 'epoch'::regclass").fetchone()[0]


def _copy_to_store(address: Path, path: Path) -> None:
    """Copy the rows of one camera's series, without covariances, from the server into a store."""
    with ServerStore.open(address) as there, Store.open(path, "append", durable=False) as store:
        found = there.find_series()
        series = store.create_series(found.head, found.testfield, identity={}, created_utc=1.0)
        for stored in there.epochs(found, details=False):
            store.append(series, stored.epoch, stored.result)


def _write_year(path: Path) -> None:
    """Write a year of one camera with all details: 150 calibrated epochs, repeated."""
    simulation = preset_simulation("rpi-v2.1-heating", 1)
    with tempfile.TemporaryDirectory() as name:
        simulation.write(Path(name) / "M1")
        recording = open_recording(Path(name) / "M1")
        calibrator = Calibrator.of_recording(recording, AdjustmentSettings())
        done = [calibrator.calibrate(epoch) for epoch in recording.iter_epochs()]
    interval = YEAR_S / STUDIED
    head = replace(simulation.head, interval=interval)
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(head, simulation.field, created_utc=1.0)
        for number in range(1, STUDIED + 1):
            one = done[number % len(done)]
            at = time.time() - YEAR_S + number * interval
            epoch = replace(one.epoch, number=number, frame_time=at, temperature_time=at + 0.5)
            store.append(series, epoch, EpochResult.from_adjustment(one.adjustment))


def workers(full: bool) -> dict[str, float]:
    """Measure frames again in this process and with one and two Dask workers.

    The ratio of elapsed times needs free cores. The processor time of client, scheduler and workers
    over that of one process gives the scheduler's cost on a busy machine too. A processor's speed
    varies by more than that cost, so the three take turns, and the medians of their ratios are
    reported with standard errors.
    """
    rounds: list[list[float]] = []
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        write_frame_archive(folder / "archive", 10, FRAMES)

        def blocks(out):
            return find_blocks([folder / "archive"], folder / out, tuple(DEFAULT_FREE), FRAMES)

        def measured(out, cluster):
            """Return processor time and elapsed time for all blocks, s."""
            todo = blocks(out)
            started = [cluster.scheduler, *cluster.workers] if cluster else []
            processes = [Process(p.pid) for p in started]
            begin = _processor_time(processes)
            seconds, _ = timed(
                lambda: list(
                    run_tasks(calibrate_block, todo, cluster.address if cluster else "local")
                )
            )
            return _processor_time(processes) - begin, seconds

        clusters: list[DaskCluster | None] = [None]
        for count in (1, 2):
            (folder / f"dask{count}").mkdir()
            clusters.append(stack.enter_context(DaskCluster(folder / f"dask{count}", count)))
        time.sleep(5)
        for count, cluster in enumerate(clusters):  # so that everything is imported
            warm = blocks(f"warm{count}")[: 2 * max(count, 1)]
            list(run_tasks(calibrate_block, warm, cluster.address if cluster else "local"))
        for number in range(6 if full else 2):
            rounds.append([])
            for count, cluster in enumerate(clusters):
                rounds[-1] += measured(f"{number}-{count}", cluster)
    here, here_s, one, one_s, two, two_s = np.array(rounds).T
    found: dict[str, float] = {
        "frames": len(rounds) * 10 * FRAMES,
        "alone_ms_a_frame": 1e3 * float(np.median(here_s)) / (10 * FRAMES),
    }
    for what, ratios in (
        ("overhead_per_frame", one / here - 1),
        ("overhead_per_frame_s", one_s / here_s - 1),
        ("overhead_per_frame_2", two / here - 1),
        ("second_worker", one_s / two_s),
    ):
        found[what] = float(np.median(ratios))
        found[f"sd_{what}"] = 1.25 * float(np.std(ratios, ddof=1)) / len(ratios) ** 0.5
    return found


def _processor_time(processes):
    """Return the processor time of these processes and this one, s."""
    each = [process.cpu_times() for process in processes]
    return time.process_time() + sum(times.user + times.system for times in each)


def forward() -> dict[str, float]:
    """Measure one forwarder's rows per second, and the bytes of an epoch with 147 targets."""
    found: dict[str, float] = {}
    with new_cluster() as cluster, tempfile.TemporaryDirectory() as name:
        address = _create_database(cluster)
        simulation = preset_simulation("rpi-v2.1-heating", 1)
        rng = np.random.default_rng(1)
        path = Path(name) / "k.db"
        count = 5000
        with Store.open(path, "append", durable=False) as store:
            series = store.create_series(simulation.head, simulation.field)
            seen = [epoch for epoch, _ in zip(simulation.epochs(), range(20), strict=False)]
            for number in range(1, count + 1):
                like = seen[number % len(seen)]
                a = rng.normal(size=(40, 16))
                result = EpochResult("ok", "", rng.normal(size=16), a.T @ a * 1e-6, 1.0, 280, 294)
                epoch = Epoch(number, 1.7e9 + 10 * number, 1.7e9 + 10 * number,
                              like.temperatures, observations=like.observations)  # fmt: skip
                store.append(series, epoch, result)
        found["bytes_in_store"] = path.stat().st_size / count
        seconds, progress = timed(Forwarder(path, address, "bank").send_waiting)
        found["rows_a_second"] = progress.rows / seconds
        with psycopg.connect(cluster.address(name="thermocald"), autocommit=True) as connection:
            connection.execute("VACUUM (ANALYZE) epoch")
            found["bytes_at_server"] = _table_bytes(connection) / count
    return found


BOUNDS = {
    "overview_s": (0.0, 10.0),
    "study_ratio": (0.0, 2.0),
    "second_worker": (1.7, np.inf),
    "overhead_per_frame": (-np.inf, 0.05),
}
"""Least and largest permitted value of each figure."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["server", "workers", "forward"])
    parser.add_argument(
        "--full",
        action="store_true",
        help="50 million epochs instead of 5, 1,200 frames instead of 400",
    )
    given = parser.parse_args()
    calls = {
        "server": lambda: server(given.full),
        "workers": lambda: workers(given.full),
        "forward": forward,
    }
    found = calls[given.what]()
    print(json.dumps({k: round(float(v), 4) for k, v in found.items()}, indent=1))
    missed = [k for k, (low, high) in BOUNDS.items() if k in found and not low <= found[k] <= high]
    for name in missed:
        print(f"MISSED: {name} {found[name]:.3f}, bounds {BOUNDS[name]}", file=sys.stderr)
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
