"""Reprocessing of archives, block by block, on this machine's cores or on a Dask cluster.

    recordings ─► blocks of epochs ─► frame, observations, adjustment ─► a Parquet file per block

A block depends only on its recording: it begins with a search of the whole frame, so that a cluster
gives the same bits as one core. An existing file is not made again, so that an interrupted run
continues. A block that fails is reported and does not affect the others; one whose process dies is
tried again first.
"""

from __future__ import annotations

import logging
import os
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.calibrator import Calibrator
from thermocald.errors import DataError, OutputError, ServerGone, ThermocaldError, UsageError
from thermocald.parallel import processes
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.store.recording.head import read_head
from thermocald.store.recording.observation_file import write_parquet
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult
from thermocald.store.server.connection import ServerAddress, is_server
from thermocald.store.server.reader import ServerStore
from thermocald.store.sources import source_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

log = logging.getLogger(__name__)

_ROUNDS = 3
"""How often a task is given to a cluster whose workers died during it."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a task; `error` is empty if it succeeded.

    epochs, calibrated: numbers of a block's epochs, and of those with a result; not_written: the
    exit status if the file of results could not be written, else 0.
    """

    task: Any
    epochs: int = 0
    calibrated: int = 0
    error: str = ""
    not_written: int = 0


def run_tasks(
    work: Callable[[Any], Outcome], tasks: Sequence[Any], engine: str = "local", jobs: int = 1
) -> Iterator[Outcome]:
    """Run all tasks and yield their outcomes in the order of completion.

    work: a module's function. engine: `local`, with `jobs` processes, or the address of a Dask
    scheduler, `tcp://host:8786`, whose workers see the same files. Raises UsageError, ServerGone.
    """
    do = partial(_attempt, work)
    if engine == "local":
        return map(do, tasks) if jobs == 1 else _processes(do, tasks, jobs)
    if "://" in engine:
        return _cluster(do, tasks, engine)
    raise UsageError(f"--engine {engine}: give `local` or a Dask scheduler's tcp://HOST:PORT")


def _attempt(work: Callable[[Any], Outcome], task: Any) -> Outcome:
    """Run a task; an error of its data or output becomes its outcome."""
    try:
        return work(task)
    except (ThermocaldError, OSError) as error:
        not_written = error.exit_status if isinstance(error, OutputError) else 0
        return Outcome(task, error=str(error), not_written=not_written)


def _processes(do: Callable[[Any], Outcome], tasks: Sequence[Any], jobs: int) -> Iterator[Outcome]:
    """Run tasks in processes; those of a process that dies are tried again one by one."""
    again = []
    with processes(jobs) as pool:
        futures = {pool.submit(do, task): task for task in tasks}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                again.append(futures[future])
    for task in again:
        with processes(1) as pool:
            try:
                yield pool.submit(do, task).result()
            except BrokenProcessPool:
                yield Outcome(task, error="its process died twice")


def _cluster(do: Callable[[Any], Outcome], tasks: Sequence[Any], address: str) -> Iterator[Outcome]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise UsageError(
            f"--engine {address} needs Dask: pip install 'thermocald[dask]'"
        ) from error
    try:
        client = distributed.Client(address, timeout="20s", set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise ServerGone(f"{address}: the scheduler cannot be reached ({error})") from error
    with client:
        waiting = list(tasks)
        for left in reversed(range(_ROUNDS)):
            again = []
            futures = client.map(do, waiting, pure=False, retries=1)
            which = {future.key: task for future, task in zip(futures, waiting, strict=True)}
            for future in distributed.as_completed(futures, loop=client.loop):
                task, cause = which[future.key], future.exception()
                if future.status == "finished":
                    yield future.result()
                elif left and isinstance(cause, distributed.KilledWorker):
                    # its workers died, which need not be the task's fault
                    again.append(task)
                else:
                    why = (str(cause).splitlines() or [type(cause).__name__])[0]
                    yield Outcome(task, error=why)
                future.release()
            waiting = again
            if not waiting:
                return


_OF_RESULT = ("sigma0", "redundancy", "n_observations")
BLOCK = 360
"""Epochs per block: an hour at 10 s, of whose work the search at its start is a hundredth."""


@dataclass(frozen=True, slots=True)
class Block:
    """A recording's epochs from position `first` to before `stop`, and their Parquet file."""

    recording: Path
    first: int
    stop: int
    target: Path
    free: tuple[str, ...]


def find_series(sources: Sequence[Path]) -> dict[str, Path]:
    """Find {file name: place} of every series below folders or at addresses.

    Raises DataError if there is none, or if two would be written to one file.
    """
    found: dict[str, Path] = {}
    for source in sources:
        for parts, place in _at_server(source) if is_server(source) else _recordings(source):
            name = "-".join(parts).replace(os.sep, "_")
            if found.setdefault(name, place) != place:
                raise DataError(
                    f"{source_name(place)} and {source_name(found[name])} are the same series "
                    f"{name}; reprocess them into separate folders"
                )
    if not found:
        raise DataError(f"{', '.join(map(source_name, sources))}: no recording or series is there")
    return found


def _recordings(folder: Path) -> Iterator[tuple[tuple[str, ...], Path]]:
    def unreadable(cause: OSError) -> None:
        text = f"{cause.filename}: cannot be read: {cause.strerror}"
        if cause.filename == str(folder):
            raise DataError(text) from cause
        log.warning("%s; recordings in it are left out", text)

    below = os.walk(folder, onerror=unreadable)
    for path in sorted(Path(place) for place, _, files in below if "recording.yaml" in files):
        name = path.relative_to(folder).parts  # of a damaged recording, whose task fails
        with suppress(DataError):
            head = read_head(path)
            name = head.camera.name, head.series
        yield name, path


def _at_server(address: Path) -> Iterator[tuple[tuple[str, str, str], Path]]:
    with ServerStore.open(address) as store:
        every = store.all_series()
    for one in every:
        parts = str(one.identity["station"]), one.camera, one.name
        yield parts, ServerAddress.parse(address).narrowed(*parts)


def find_blocks(
    archives: Sequence[Path], out: Path, free: tuple[str, ...], size: int = BLOCK
) -> list[Block]:
    """Find the blocks that are not done yet of all series below folders or at addresses.

    Raises the errors of `find_series`.
    """
    blocks: list[Block] = []
    for name, path in find_series(archives).items():
        epochs = 1  # of a damaged recording, whose block fails
        with suppress(DataError):
            epochs = len(open_recording(path))
        for first in range(0, epochs, size):
            target = out / name / f"part-{first:08d}.parquet"
            if not os.path.exists(target):
                blocks.append(Block(path, first, min(first + size, epochs), target, free))
    return blocks


def calibrate_block(block: Block) -> Outcome:
    """Calibrate a block and write its file, whole or not at all."""
    recording = open_recording(block.recording)
    camera = recording.camera
    calibrator = Calibrator.of_recording(recording, AdjustmentSettings(free=block.free))
    rows = recording.iter_epochs(slice(max(block.first - 1, 0), block.stop))
    calibrator.begin_block(next(rows) if block.first else None)
    epochs = list(map(calibrator.calibrate, rows))
    results = [EpochResult.from_adjustment(done.adjustment) for done in epochs]
    values = np.array([r.values for r in results])
    sds = np.array([r.sd for r in results])
    temperatures = {
        name: recording.columns.at_frame(name)[block.first : block.stop]
        for name in recording.head.channels
    }
    columns: dict[str, Any] = {
        "camera": [camera.name] * len(epochs),
        "series": [recording.series] * len(epochs),
        "epoch": np.array([d.epoch.number for d in epochs]),
        "frame_time": np.array([d.epoch.frame_time for d in epochs]),
        **{n if n != "camera" else "temperature camera": t for n, t in temperatures.items()},
        **{name: values[:, i] for i, name in enumerate(PARAMETER_NAMES)},
        **{f"sd_{name}": sds[:, i] for i, name in enumerate(PARAMETER_NAMES)},
        **{n: np.array([getattr(r, n) for r in results]) for n in _OF_RESULT},
        "n_rejected": np.array([len(r.rejected) for r in results]),
        "status": [r.status for r in results],
        "reason": [r.reason for r in results],
    }
    write_parquet(block.target, [columns])
    calibrated = sum(r.status == "ok" for r in results)
    return Outcome(block, block.stop - block.first, calibrated)
