"""Archives calibrated again, block by block, on the cores of this machine or on a Dask cluster.

    recordings ─► blocks of epochs ─► frame, observations, adjustment ─► one Parquet file a block

A block depends on nothing but its recording: it begins with a search of the whole frame, whoever
computes it, so a cluster gives the same bits as one core. A file that is there is not made again,
which is how an interrupted run goes on. A block that fails, or kills its process, is reported and
costs nothing but itself.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.calibrator import Calibrator
from thermocald.errors import DataError, OutputError, ThermocaldError
from thermocald.fleet.tasks import run_tasks
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.store.recording.parquet_table import write_parquet
from thermocald.store.recording.reader import open_recording
from thermocald.store.series import EpochResult

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path


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
