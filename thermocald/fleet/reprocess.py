"""Archives calibrated again, block by block, on the cores of this machine or on a Dask cluster.

    recordings ─► blocks of epochs ─► frame, observations, adjustment ─► one Parquet file a block

A block depends on nothing but its recording: it begins with a search of the whole frame, whoever
computes it, so a cluster gives the same bits as one core. A file that is there is not made again,
which is how an interrupted run goes on. A block that fails is reported and costs nothing but
itself; one whose process dies is tried again before it is given up.
"""

from __future__ import annotations

import logging
import os
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from thermocald.acquisition.calibrator import Calibrator
from thermocald.errors import DataError, OutputError, ServerGone, ThermocaldError, UsageError
from thermocald.parallel import processes
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.store.recording.parquet_table import write_parquet
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    Item = TypeVar("Item")
    Result = TypeVar("Result")
    from pathlib import Path

_ROUNDS = 3
"""How often an item is handed to a cluster whose workers died of it, or of something else."""


def run_tasks(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    engine: str = "local",
    jobs: int = 1,
) -> Iterator[Result]:
    """The results of `work` for all items, in the order in which they are done.

    work: a function of a module, which raises nothing; lost: the result of an item whose process
    died every time, and why; engine: `local`, with `jobs` processes, or the address of a Dask
    scheduler, `tcp://host:8786`, whose workers see the same files. Raises UsageError, ServerGone.
    """
    if engine == "local":
        return map(work, items) if jobs == 1 else _processes(work, items, lost, jobs)
    if "://" in engine:
        return _cluster(work, items, lost, engine)
    raise UsageError(f"--engine {engine}: there is `local`, or a scheduler's tcp://HOST:PORT")


def _processes(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    jobs: int,
) -> Iterator[Result]:
    """On processes of this machine; where one dies, its items are tried again one by one."""
    again: list[Item] = []
    with processes(jobs) as pool:
        futures = {pool.submit(work, item): item for item in items}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                again.append(futures[future])
    for item in again:
        with processes(1) as pool:
            try:
                yield pool.submit(work, item).result()
            except BrokenProcessPool:
                yield lost(item, "its process died twice")


def _cluster(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    address: str,
) -> Iterator[Result]:
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
        waiting = list(items)
        for left in reversed(range(_ROUNDS)):
            again: list[Item] = []
            futures = client.map(work, waiting, pure=False, retries=1)
            which = {future.key: item for future, item in zip(futures, waiting, strict=True)}
            for future in distributed.as_completed(futures, loop=client.loop):
                item = which[future.key]
                if future.status == "finished":
                    yield future.result()
                elif left and isinstance(future.exception(), distributed.KilledWorker):
                    # its workers died: of it, or because somebody ends workers now and then
                    again.append(item)
                else:
                    yield lost(item, _first_line(future.exception()))
                future.release()
            waiting = again
            if not waiting:
                return


def _first_line(error: BaseException | None) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


log = logging.getLogger(__name__)

BLOCK = 360
"""Epochs of a block: an hour at 10 s. The search that it begins with is a hundredth of its work."""


@dataclass(frozen=True, slots=True)
class Block:
    """Epochs of a recording by their position, `first` to before `stop`, and where they go."""

    recording: Path
    first: int
    stop: int
    target: Path
    free: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a block: epochs, how many have a result; `error` is empty where it is done.

    not_written: the exit status where it is the file of results that could not be written, else 0.
    """

    block: Block
    epochs: int
    calibrated: int
    error: str = ""
    not_written: int = 0


def find_blocks(
    archives: Sequence[Path], out: Path, free: tuple[str, ...], size: int = BLOCK
) -> list[Block]:
    """The blocks of all recordings at or below some folders, but those that are done.

    Raises DataError where there is no recording, or two would be written to one place.
    """
    found = sorted({p.parent for a in archives for p in a.rglob("recording.yaml")})
    if not found:
        raise DataError(f"{', '.join(map(str, archives))}: no recording is there")
    blocks: list[Block] = []
    taken: dict[Path, Path] = {}
    for path in found:
        recording = open_recording(path)
        folder = out / f"{recording.camera.name}-{recording.series}".replace(os.sep, "_")
        if other := taken.get(folder):
            raise DataError(
                f"{path} and {other} are the same series {recording.camera.name}/"
                f"{recording.series}; reprocess them into folders of their own"
            )
        taken[folder] = path
        for first in range(0, len(recording.columns), size):
            target = folder / f"part-{first:08d}.parquet"
            if not target.exists():
                stop = min(first + size, len(recording.columns))
                blocks.append(Block(path, first, stop, target, free))
    return blocks


def calibrate_block(block: Block) -> Outcome:
    """Calibrate one block and write its file, whole or not at all; never raises for its data."""
    try:
        columns, calibrated = _columns(block)
    except (ThermocaldError, OSError) as error:
        return Outcome(block, 0, 0, str(error))
    try:
        write_parquet(block.target, columns)
    except OutputError as error:
        return Outcome(block, 0, 0, str(error), error.exit_status)
    return Outcome(block, block.stop - block.first, calibrated)


def run_blocks(
    blocks: Sequence[Block],
    engine: str = "local",
    jobs: int = 1,
    report: Callable[[Outcome], None] = lambda _: None,
) -> list[Outcome]:
    """Calibrate blocks, on `jobs` processes of this machine or on a Dask scheduler's workers.

    engine: `local`, or the address of a scheduler, `tcp://host:8786`, whose workers see the same
    folders. report: told of each block as it is done. Raises UsageError, ServerGone.
    """
    outcomes = []
    for outcome in run_tasks(calibrate_block, blocks, _lost, engine, jobs):
        outcomes.append(outcome)
        report(outcome)
    return outcomes


def _lost(block: Block, why: str) -> Outcome:
    return Outcome(block, 0, 0, why)


def _columns(block: Block) -> tuple[dict[str, Any], int]:
    """The block's rows as columns, and how many epochs have a result."""
    recording = open_recording(block.recording)
    camera = recording.camera
    calibrator = Calibrator.of_recording(recording, AdjustmentSettings(free=block.free))
    epochs = [
        calibrator.calibrate(epoch)
        for epoch in islice(recording.iter_epochs(), block.first, block.stop)
    ]
    results = [EpochResult.from_adjustment(done.adjustment) for done in epochs]
    values = np.array([r.values for r in results])
    sds = np.array([r.sd for r in results])
    temperatures = {
        name: recording.columns.at_frame(name)[block.first : block.stop]
        for name in recording.channels
    }
    columns: dict[str, Any] = {
        "camera": [camera.name] * len(epochs),
        "series": [recording.series] * len(epochs),
        "epoch": np.array([d.epoch.number for d in epochs], dtype=np.int64),
        "frame_time": np.array([d.epoch.frame_time for d in epochs]),
        **{n if n != "camera" else "temperature camera": t for n, t in temperatures.items()},
        **{name: values[:, i] for i, name in enumerate(PARAMETER_NAMES)},
        **{f"sd_{name}": sds[:, i] for i, name in enumerate(PARAMETER_NAMES)},
        "sigma0": np.array([r.sigma0 for r in results]),
        "redundancy": np.array([r.redundancy for r in results], dtype=np.int64),
        "n_observations": np.array([r.n_observations for r in results], dtype=np.int64),
        "n_rejected": np.array([len(r.rejected) for r in results], dtype=np.int64),
        "status": [r.status for r in results],
        "reason": [r.reason for r in results],
    }
    return columns, sum(r.status == "ok" for r in results)
