"""Photographs and a log of temperatures put together as the epochs of a recording.

Each photograph gets the reading next to it in time, with the reading's own time, and the recording
keeps every reading: the temperature at a photograph's time is interpolated from all of them.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.logger.photographs import find_copies, other_camera
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import EpochColumns, Recording
from thermocald.store.recording.readings import Readings
from thermocald.store.recording.sense import doubt_lines, pitch_doubts
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.photographs import Photograph
    from thermocald.store.logger.temperatures import LogOptions

_LARGEST_GAP_IN_INTERVALS = 10.0


def iso(seconds: float) -> str:
    """A time as ISO 8601 in UTC, to a millisecond."""
    moment = datetime.fromtimestamp(float(seconds), UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def read_series(
    photographs: Sequence[Photograph],
    clock: DeviceClock,
    log: Path,
    options: LogOptions,
    *,
    testfield: TestField | None = None,
    series: str = "M1",
    camera: Path | None = None,
    pitch: float | None = None,
    distance: float | None = None,
) -> tuple[Recording, list[str]]:
    """Put photographs and a logger's file on one clock: a recording that lies in no folder of its
    own, and what was understood of both, for people.

    Copies of one photograph are left out. testfield: None to see what is understood, which a pixel
    pitch that nobody knows does not prevent; camera: a camera file, which then says it all; pitch,
    distance mm: instead of EXIF's. Raises DataError for photographs of different sizes or cameras,
    for times that do not say their zone, and where log and photographs do not overlap.
    """
    sizes = {(p.width, p.height) for p in photographs}
    if len(sizes) > 1:
        one = photographs[0]
        other = next(p for p in photographs if (p.width, p.height) != (one.width, one.height))
        raise DataError(
            f"{other.path}: has {other.width} × {other.height} px, {one.path.name} "
            f"{one.width} × {one.height}: one recording is of one camera in one position; "
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
    times = clock.utc([p.moment for p in named], lambda i: str(named[i].path))
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
    row = _next_to(times, logged.times)
    near, row = row >= 0, np.maximum(row, 0)
    channels = {n: np.where(near, values[row], np.nan) for n, values in logged.channels.items()}
    columns = EpochColumns(
        np.arange(1, len(times) + 1), times, np.where(near, logged.times[row], np.nan), channels,
        tuple(str(p.path.absolute()) for p in placed), {}, Readings(logged.times, logged.channels),
    )  # fmt: skip
    reference = next(iter(channels))
    at_frame = columns.at_frame(reference)
    known = np.isfinite(at_frame)
    if not known.any():
        raise DataError(
            "no photograph has a temperature: the log has gaps wherever photographs were taken "
            f"({iso(times[0])} to {iso(times[-1])})"
        )
    spec, about_camera = _camera_of(photographs[0], camera, pitch, distance, testfield is None)
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    span = f"{iso(times[0])} to {iso(times[-1])}, every {interval:.4g} s"
    step = float(np.median(np.diff(logged.times)))
    temperatures = f"{np.nanmin(at_frame):.2f} to {np.nanmax(at_frame):.2f} °C"
    notes = [
        f"photographs: {len(times)}, {placed[0].width} × {placed[0].height} px, {span}",
        *notes, *logged.notes,
        f"log: {iso(logged.times[0])} to {iso(logged.times[-1])}, every {step:.4g} s",
        (f"temperature ({reference}): known for {known.sum()} of {len(known)} photographs, "
         f"{temperatures}"),
    ]  # fmt: skip
    for i in sorted({0, len(times) // 2, len(times) - 1}):
        reading = f"{at_frame[i]:.3f} °C" if known[i] else "no temperature"
        notes.append(f"  {placed[i].path.name}  {iso(times[i])}  {reading}")
    thermometers = dict.fromkeys(channels, Channel())
    head = Head(f"{spec.name}-{series}", series, max(interval, 0.001), spec, thermometers)
    none = np.empty((0, 3))
    field = TestField.build((), none, none, (), (), ()) if testfield is None else testfield
    recording = Recording(Path(), head, field, columns, has_observations=False)
    return recording, [*notes, *about_camera]


def _overlap(frames: Array, log: Array) -> None:
    if frames[0] <= log[-1] and frames[-1] >= log[0]:
        return
    gap = log[0] - frames[-1] if frames[-1] < log[0] else frames[0] - log[-1]
    raise DataError(
        f"photographs ({iso(frames[0])} to {iso(frames[-1])}) and log ({iso(log[0])} to "
        f"{iso(log[-1])}) lie {gap / 3600:.1f} h apart: is a time zone wrong (--camera-timezone, "
        "--log-timezone), or a clock (--camera-clock, --log-clock)"
        + (", or are years written with two figures?" if gap > 3e7 else "?")
    )


def _next_to(frames: Array, log: Array) -> NDArray[np.int64]:
    """The row of the log next in time to each frame, -1 beyond ten of its intervals."""
    right = np.clip(np.searchsorted(log, frames), 1, len(log) - 1)
    left = right - 1
    row = np.where(frames - log[left] <= log[right] - frames, left, right)
    far = np.abs(log[row] - frames) > _LARGEST_GAP_IN_INTERVALS * np.median(np.diff(log))
    return np.where(far, -1, row).astype(np.int64)


def _camera_of(
    photograph: Photograph,
    file: Path | None,
    pitch: float | None,
    distance: float | None,
    dry_run: bool,
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


def write_photographs(folder: Path, recording: Recording) -> None:
    """Write what `read_series` returned, in a new folder."""
    head = replace(recording.head, name=folder.name)
    with RecordingWriter(folder, head, recording.testfield) as writer:
        for epoch in recording.iter_epochs():
            writer.append(epoch)
        assert recording.columns.readings is not None
        writer.keep_readings(recording.columns.readings)
