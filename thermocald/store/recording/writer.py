"""Write a recording epoch by epoch; it appears as a whole or not at all."""

from __future__ import annotations

import csv
import math
import os
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.errors import RecordingError
from thermocald.files import cannot_write, dump_yaml
from thermocald.names import require_channels
from thermocald.result import csv_text
from thermocald.store.recording.head import Head, head_document
from thermocald.store.recording.reader import READINGS, TemperatureLog
from thermocald.store.recording.testfield_file import testfield_csv

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path
    from typing import Any, TextIO

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_ABSENT = {"sxy": "0"}  # in rows of an epoch without the column; others are empty


class RecordingWriter:
    """A writer of a recording, epoch by epoch, in constant memory.

    Use it as a context manager. Everything is written into `.<name>.partial` next to `path`, which
    is renamed to `path` at the end, or removed if an error ends the block. Image points are written
    to 1e-5 px, times to 1e-6 s, temperatures and coordinates with all their digits. Raises
    RecordingError if `path` exists and is not an empty folder, or if the disk is full. further:
    names of further columns of epochs.csv.
    """

    def __init__(
        self, path: Path, head: Head, testfield: TestField, further: Iterable[str] = ()
    ) -> None:
        self.path = path
        self._further = list(further)
        self._head = head
        self._field = testfield
        self._partial = path.absolute().with_name(f".{path.absolute().name}.partial")
        self._files: dict[str, TextIO] = {}
        self._columns: list[str] = []  # of observations
        self._last: Epoch | None = None
        self._last_reading = -math.inf

    def __enter__(self) -> Self:
        require_channels(self._head.channels, str(self.path), RecordingError)
        with self._in_words():
            if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
                raise RecordingError(
                    f"{self.path}: exists already; choose another name or remove it"
                )
            shutil.rmtree(self._partial, ignore_errors=True)
            self._partial.mkdir(parents=True)
            for name, text in (
                ("recording.yaml", dump_yaml(head_document(self._head))),
                ("testfield.csv", testfield_csv(self._field)),
            ):
                (self._partial / name).write_text(text, encoding="utf-8")
            names = ["epoch", "frame_time", "temperature_time", *self._head.channels, "frame"]
            self._epochs = self._new("epochs.csv", [*names, *self._further])
        return self

    def append(
        self,
        epoch: Epoch,
        image: bytes | NDArray[np.uint8] | NDArray[np.uint16] | None = None,
        extra: Mapping[str, float] | None = None,
    ) -> None:
        """Write one epoch; `image` is its frame as JPEG bytes or as grey values (written as PNG).

        Without `image`, the frame that the epoch names is copied. extra: its further columns.
        """
        # what `open_recording` would refuse
        where = f"{self.path}: epoch {epoch.number}"
        if self._last is not None and epoch.number <= self._last.number:
            raise RecordingError(f"{where} comes after {self._last.number}; numbers must increase")
        if not math.isfinite(epoch.frame_time):
            raise RecordingError(f"{where}: its frame has no time")
        if self._last is not None and epoch.frame_time < self._last.frame_time:
            raise RecordingError(f"{where}: the time of its frame runs backwards")
        if epoch.temperature_time < self._last_reading:
            raise RecordingError(f"{where}: the time of its temperature runs backwards")
        with self._in_words():
            frame = self._keep_frame(epoch, image)
            times = f"{epoch.frame_time:.6f}", _number(epoch.temperature_time, ".6f")
            read = [_number(epoch.temperatures.get(n, math.nan), "") for n in self._head.channels]
            more = [_number((extra or {}).get(name, math.nan), "") for name in self._further]
            self._epochs.writerow([epoch.number, *times, *read, frame, *more])
            if epoch.observations is not None:
                self._write_observations(epoch.number, epoch.observations)
        self._last = epoch
        if math.isfinite(epoch.temperature_time):
            self._last_reading = epoch.temperature_time

    def keep_readings(self, readings: TemperatureLog) -> None:
        """Write every reading of a log, not only those of the epochs."""
        with self._in_words():
            (text,) = csv_text([{"time": readings.times, **readings.channels}])
            (self._partial / READINGS).write_text(text, encoding="utf-8")

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            self._abandon()
            return
        with self._in_words():
            for file in self._files.values():
                file.flush()
                os.fsync(file.fileno())
                file.close()
            self._partial.rename(self.path)

    def _new(self, name: str, columns: list[str]) -> Any:
        """Return the CSV writer of a new table."""
        self._files[name] = (self._partial / name).open("w", encoding="utf-8", newline="")
        rows = csv.writer(self._files[name], lineterminator="\n")
        rows.writerow(columns)
        return rows

    def _abandon(self) -> None:
        for file in self._files.values():
            try:
                file.close()
            except OSError:  # a full disk fails the flush too; the file is removed below
                file.close()
        shutil.rmtree(self._partial, ignore_errors=True)

    @contextmanager
    def _in_words(self) -> Iterator[None]:
        """After an OSError, remove what was written and raise a RecordingError that says why."""
        try:
            yield
        except OSError as cause:
            self._abandon()
            failed = cannot_write(self.path, cause)
            error = RecordingError(f"{failed}; the part written so far was removed")
            error.exit_status = failed.exit_status
            raise error from cause

    def _keep_frame(self, epoch: Epoch, image: bytes | NDArray[Any] | None) -> str:
        if image is None and epoch.frame is None:
            return ""
        folder = self._partial / "frames"
        folder.mkdir(exist_ok=True)
        if image is None:
            assert epoch.frame is not None
            name = f"{epoch.number:06d}{epoch.frame.suffix}"
            shutil.copyfile(epoch.frame, folder / name)
        elif isinstance(image, bytes):
            name = f"{epoch.number:06d}.jpg"
            (folder / name).write_bytes(image)
        else:
            import cv2

            name = f"{epoch.number:06d}.png"
            done, data = cv2.imencode(".png", image)
            if not done:
                raise RecordingError(f"epoch {epoch.number}: its frame cannot be written as PNG")
            (folder / name).write_bytes(data.tobytes())
        return f"frames/{name}"

    def _write_observations(self, number: int, seen: Observations) -> None:
        """Write the rows of an epoch; a column that it lacks is empty, or 0 for the covariance."""
        columns = dict(zip(("x", "y", "sx", "sy"), (*seen.points.T, *seen.sigmas.T), strict=True))
        if len(seen) and seen.covariances is not None:
            columns["sxy"] = seen.covariances
        if len(seen):
            columns |= seen.quality
        if not self._columns:
            self._columns = list(columns)
            self._observations = self._new("observations.csv", ["epoch", "target", *columns])
        if added := [name for name in columns if name not in self._columns]:
            self._add_columns(added)
        names = [self._field.names[i] for i in seen.targets.tolist()]
        cells = [
            _numbers(columns[name], "%.5f" if name in ("x", "y") else "%.6g")
            if name in columns
            else [_ABSENT.get(name, "")] * len(seen)
            for name in self._columns
        ]
        self._observations.writerows(zip([number] * len(seen), names, *cells, strict=True))

    def _add_columns(self, names: list[str]) -> None:
        """Add columns to the rows of observations written so far."""
        self._files["observations.csv"].close()
        before = self._partial / "observations.before"
        (self._partial / "observations.csv").rename(before)
        absent = [_ABSENT.get(name, "") for name in names]
        with before.open(encoding="utf-8", newline="") as file:
            written = csv.reader(file)
            self._observations = self._new("observations.csv", [*next(written), *names])
            self._observations.writerows([*row, *absent] for row in written)
        before.unlink()
        self._columns += names


def _numbers(column: Array, form: str) -> list[str]:
    """Return the cells of a column (n,); empty for NaN."""
    cells = list(map(form.__mod__, column.tolist()))  # twice as fast as a call of `_number` each
    for row in np.flatnonzero(~np.isfinite(column)):
        cells[row] = ""
    return cells


def _number(value: float, form: str) -> str:
    if not math.isfinite(value):
        return ""
    return f"{value:{form}}" if form else repr(float(value))
