"""Photographs and a log of temperatures put together as the epochs of a recording.

Each photograph gets the reading next to it in time, with the reading's own time, and the recording
keeps every reading: the temperature at a photograph's time is interpolated from all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.store.logger.photographs import find_copies, other_camera
from thermocald.store.logger.temperatures import LogOptions, TemperatureLog, read_log
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import EpochColumns, Recording
from thermocald.store.recording.readings import Readings, interpolate_readings
from thermocald.store.recording.sense import doubt_lines, pitch_doubts
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.photographs import Photograph

_LARGEST_GAP_IN_INTERVALS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class PhotographSeries:
    """Photographs in the order of time, times (n,) s UTC, and the log they were paired with.

    reading (n,): the row of the log next to each, -1 where there is none near; at_frame (n,) °C of
    the first channel, NaN where the log does not say; notes: what was left out, for people.
    """

    photographs: tuple[Photograph, ...]
    times: Array
    log: TemperatureLog
    reading: NDArray[np.int64]
    at_frame: Array
    notes: tuple[str, ...] = ()

    @property
    def interval(self) -> float:
        """The median time between photographs, s; 1 for a single one."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0

    def preview(self) -> list[str]:
        """Lines for a person: what would be written."""
        first = next(iter(self.log.channels))
        known = np.isfinite(self.at_frame)
        head = self.photographs[0]
        span = f"{iso(self.times[0])} to {iso(self.times[-1])}, every {self.interval:.4g} s"
        step = float(np.median(np.diff(self.log.times)))
        low, high = np.nanmin(self.at_frame), np.nanmax(self.at_frame)
        lines = [f"photographs: {len(self.times)}, {head.width} × {head.height} px, {span}"]
        lines += [*self.notes, *self.log.notes]
        lines.append(
            f"log: {iso(self.log.times[0])} to {iso(self.log.times[-1])}, every {step:.4g} s"
        )
        lines.append(
            f"temperature ({first}): known for {known.sum()} of {len(known)} photographs, "
            f"{low:.2f} to {high:.2f} °C"
        )
        for i in sorted({0, len(self.times) // 2, len(self.times) - 1}):
            reading = f"{self.at_frame[i]:.3f} °C" if known[i] else "no temperature"
            lines.append(f"  {self.photographs[i].path.name}  {iso(self.times[i])}  {reading}")
        return lines


def iso(seconds: float) -> str:
    """A time as ISO 8601 in UTC, to a millisecond."""
    moment = datetime.fromtimestamp(float(seconds), UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def put_together(
    photographs: Sequence[Photograph], camera_clock: DeviceClock, log: Path, options: LogOptions
) -> PhotographSeries:
    """Photographs and a logger's file on one clock.

    Copies of one photograph are left out. Raises DataError for photographs of different sizes or
    cameras, for times that do not say their zone, and where log and photographs do not overlap.
    """
    sizes = {(p.width, p.height) for p in photographs}
    if len(sizes) > 1:
        head = photographs[0]
        other = next(p for p in photographs if (p.width, p.height) != (head.width, head.height))
        raise DataError(
            f"{other.path}: has {other.width} × {other.height} px, {head.path.name} "
            f"{head.width} × {head.height}: one recording is of one camera in one position; "
            "import them apart"
        )
    if strange := other_camera(photographs):
        raise DataError(
            f"{strange}: one recording is of one camera with one lens; import them apart"
        )
    copies = find_copies([p.path for p in photographs])
    notes = [
        f"photographs: {photographs[i].path.name} is a copy of {photographs[k].path.name}: left out"
        for i, k in copies.items()
    ]
    photographs = [p for i, p in enumerate(photographs) if i not in copies]
    # by name first: within a second it is the order in which they were taken
    named = sorted(photographs, key=lambda p: p.path.name)
    times = camera_clock.utc([p.moment for p in named], lambda i: str(named[i].path))
    order = np.argsort(times, kind="stable")
    times = times[order]
    placed = tuple(named[i] for i in order.tolist())
    if (same := np.flatnonzero(np.diff(times) == 0)).size:
        first, second = (p.path.name for p in placed[same[0] : same[0] + 2])
        notes.append(
            f"doubtful: {len(same)} photographs have the time of another one, the first {first} "
            f"and {second}: taken in the order of their names"
        )
    logged = read_log(log, options, (float(times[0]), float(times[-1])))
    _overlap(times, logged.times)
    reading = _next_to(times, logged.times)
    first = next(iter(logged.channels.values()))
    at_frame = interpolate_readings(times, logged.times, first)
    if not np.isfinite(at_frame).any():
        raise DataError(
            "no photograph has a temperature: the log has gaps wherever photographs were taken "
            f"({iso(times[0])} to {iso(times[-1])})"
        )
    return PhotographSeries(placed, times, logged, reading, at_frame, tuple(notes))


def _overlap(frames: Array, log: Array) -> None:
    if frames[0] <= log[-1] and frames[-1] >= log[0]:
        return
    gap = log[0] - frames[-1] if frames[-1] < log[0] else frames[0] - log[-1]
    raise DataError(
        f"photographs ({iso(frames[0])} to {iso(frames[-1])}) and log ({iso(log[0])} to "
        f"{iso(log[-1])}) lie {gap / 3600:.1f} h apart: is a time zone wrong (--camera-timezone, "
        "--log-timezone), or a clock (--camera-clock, --log-clock)?"
    )


def _next_to(frames: Array, log: Array) -> NDArray[np.int64]:
    """The row of the log next in time to each frame, -1 beyond ten of its intervals."""
    right = np.clip(np.searchsorted(log, frames), 1, len(log) - 1)
    left = right - 1
    row = np.where(frames - log[left] <= log[right] - frames, left, right)
    far = np.abs(log[row] - frames) > _LARGEST_GAP_IN_INTERVALS * np.median(np.diff(log))
    return np.where(far, -1, row).astype(np.int64)


def camera_of(
    photograph: Photograph,
    file: Path | None,
    pitch: float | None,
    distance: float | None = None,
    dry_run: bool = False,
) -> tuple[CameraSpec, list[str]]:
    """Return the camera of photographs, what of it was taken from EXIF, and what EXIF denies.

    file: a camera file, which then says it all; pitch, distance mm: instead of EXIF's; dry_run: a
    pixel pitch that nobody knows is no error, but noted.
    """
    notes: list[str] = []
    if file is not None:
        known = read_camera(file, pitch)
        if (known.sensor.width, known.sensor.height) != (photograph.width, photograph.height):
            raise UsageError(
                f"{file}: is of {known.sensor.width} × {known.sensor.height} px, the photographs "
                f"have {photograph.width} × {photograph.height}"
            )
        notes += doubt_lines(pitch_doubts(known.sensor.pixel_pitch, photograph.pixel_pitch))
        return known, notes
    if distance is None and photograph.focal_length is not None:
        distance = photograph.focal_length
        notes.append(f"camera: principal distance {distance:g} mm from EXIF (--principal-distance)")
    if pitch is None:
        pitch = photograph.pixel_pitch
        unknown = (
            "the size of a pixel is not known and EXIF does not say it: --pixel-pitch 0.00112 "
            "(mm), or --camera FILE"
        )
        if pitch is None and not dry_run:
            raise UsageError(unknown)
        said = f"pixel pitch {pitch:.5f} mm from EXIF (--pixel-pitch)" if pitch else unknown
        notes.append(f"camera: {said}")
        pitch = pitch or 0.001
    else:
        notes += doubt_lines(pitch_doubts(pitch, photograph.pixel_pitch))
    sensor = Sensor(photograph.width, photograph.height, pitch)
    return CameraSpec(photograph.camera or "camera", sensor, distance), notes


def in_memory(
    placed: PhotographSeries, camera: CameraSpec, testfield: TestField, series: str
) -> Recording:
    """Return photographs and a log as a recording that lies in no folder of its own."""
    log, row = placed.log, placed.reading
    channels = {
        n: np.where(row >= 0, v[np.maximum(row, 0)], np.nan) for n, v in log.channels.items()
    }
    columns = EpochColumns(
        np.arange(1, len(placed.times) + 1),
        placed.times,
        np.where(row >= 0, log.times[np.maximum(row, 0)], np.nan),
        channels,
        tuple(str(p.path.absolute()) for p in placed.photographs),
        {},
        Readings(log.times, log.channels),
    )
    interval = max(placed.interval, 0.001)
    thermometers = dict.fromkeys(channels, Channel())
    head = Head(f"{camera.name}-{series}", series, interval, camera, thermometers)
    return Recording(Path(), head, testfield, columns, has_observations=False)


def write_photographs(folder: Path, recording: Recording) -> None:
    """Write what `in_memory` returned, in a new folder."""
    head = replace(recording.head, name=folder.name)
    with RecordingWriter(folder, head, recording.testfield) as writer:
        for epoch in recording.iter_epochs():
            writer.append(epoch)
        assert recording.columns.readings is not None
        writer.keep_readings(recording.columns.readings)
