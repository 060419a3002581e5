"""Photographs with the times at which they were taken: from EXIF, the file's name, or its date.

Only the head of a file is read; what EXIF says of the camera comes with it. Source: CIPA DC-008,
Exif 2.32: DateTimeOriginal, SubSecTimeOriginal, OffsetTimeOriginal.

Put together with a log of temperatures they are the epochs of a recording. Each photograph gets the
reading next to it in time, with the reading's own time, and the recording keeps every reading: the
temperature at a photograph's time is interpolated from all of them.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
import struct
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DataError, DriverMissing, ImageError, UsageError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.logger.clock import iso, parse_moment
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import EpochColumns, Recording
from thermocald.store.recording.sense import doubt_lines, pitch_doubts
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.temperatures import LogOptions


SOURCES = ("exif", "name", "file")
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
_IN_NAME = re.compile(r"(\d{8})[_T-]?(\d{6})(?:[_.-]?(\d{3}))?")
_EXIF_IFD = 0x8769
_TIME_TAGS = ((0x9003, 0x9291, 0x9011), (0x9004, 0x9292, 0x9012), (0x0132, 0x9290, 0x9010))
"""Time, its fraction of a second, its zone: as taken, as digitised, as changed last."""
_DIAGONAL_35MM = 43.2666  # mm, of 36 × 24


@dataclass(frozen=True, slots=True)
class Photograph:
    """A file, when it was taken as the camera wrote it, its size px, and what EXIF says of the
    camera: name, principal distance mm, pixel pitch mm, serial number; None where it does not.
    """

    path: Path
    moment: datetime
    width: int
    height: int
    camera: str = ""
    focal_length: float | None = None
    pixel_pitch: float | None = None
    serial: str = ""

    @property
    def body(self) -> tuple[str, str, float | None]:
        """What is the same in all photographs of one camera with one lens."""
        return self.camera, self.serial, self.focal_length


def find_photographs(paths: list[Path]) -> list[Path]:
    """The pictures among files and in folders, each once; DataError where there are none."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            found += sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
        elif path.is_file():
            found.append(path)
        else:
            raise DataError(f"{path}: there is no such file or folder")
    if not found:
        raise DataError(f"{paths[0]}: holds no photographs ({', '.join(sorted(SUFFIXES))})")
    return list(dict.fromkeys(found))


def read_photographs(paths: list[Path], source: str = "exif") -> list[Photograph]:
    """All photographs among files and in folders; errors as `find_photographs`, `read_photograph`.

    Raises UsageError for a source of their times that there is not.
    """
    if source not in SOURCES:
        raise UsageError(f"--times {source}: must be one of {', '.join(SOURCES)}")
    return [read_photograph(path, source) for path in find_photographs(paths)]


def read_photograph(path: Path, source: str = "exif") -> Photograph:
    """One photograph; `source` of its time is one of SOURCES.

    Raises ImageError for what is not a picture, DataError where it does not hold its time.
    """
    if importlib.util.find_spec("PIL") is None:
        raise DriverMissing("reading photographs needs Pillow: pip install 'thermocald[report]'")
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # a large sensor is not an attack: nothing is decoded here
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            # of damaged EXIF: what is needed of it is tested
            warnings.simplefilter("ignore", UserWarning)
            with Image.open(path) as image:
                width, height = image.size
                exif = image.getexif()
                details: dict[int, Any] = {**exif, **exif.get_ifd(_EXIF_IFD)}
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, Image.DecompressionBombError,
            struct.error) as cause:  # fmt: skip
        raise ImageError(f"{path}: is not a picture that can be read ({cause})") from cause
    if source == "exif":
        moment = _exif_moment(path, details)
    elif source == "name":
        moment = _name_moment(path)
    else:
        moment = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    focal = _positive(details.get(0x920A))
    return Photograph(
        path, moment, width, height, _camera(details), focal,
        _pixel_pitch(details, focal, width, height),
        str(details.get(0xA431) or "").strip("\0 "),
    )  # fmt: skip


def other_camera(photographs: Sequence[Photograph]) -> str | None:
    """Return a sentence on the first photograph that is not of the camera of most, or None.

    EXIF tells: name, serial number, focal length (a zoom, another lens) within 2 %.
    """
    usual = Counter(p.body for p in photographs).most_common(1)[0][0]
    for photograph in photographs:
        name, serial, focal = photograph.body
        same_lens = focal == usual[2] or (focal and usual[2] and abs(focal / usual[2] - 1) < 0.02)
        if (name, serial) != usual[:2] or not same_lens:
            return (
                f"{photograph.path.name} is of {_body(photograph.body)}, the others of "
                f"{_body(usual)}"
            )
    return None


def _body(body: tuple[str, str, float | None]) -> str:
    name, serial, focal = body
    parts = [name or "a camera without a name", serial, f"{focal:g} mm" if focal else ""]
    return " ".join(part for part in parts if part)


def find_copies(paths: Sequence[Path]) -> dict[int, int]:
    """Return {position: of the first one with the same bytes} of files that are there twice.

    A file that cannot be read is none.
    """
    of_size: dict[int, list[int]] = {}
    first: dict[bytes, int] = {}
    copies = {}
    for i, path in enumerate(paths):
        with suppress(OSError):
            of_size.setdefault(path.stat().st_size, []).append(i)
    for i in sorted(i for alike in of_size.values() if len(alike) > 1 for i in alike):
        with suppress(OSError), paths[i].open("rb") as file:
            key = hashlib.file_digest(file, "sha256").digest()
            if (known := first.setdefault(key, i)) != i:
                copies[i] = known
    return copies


def strange_photographs(paths: Sequence[Path]) -> list[str]:
    """Return what is doubtful in the frames of a recording, a sentence each."""
    there = list(dict.fromkeys(path for path in paths if path.is_file()))
    found = []
    if copies := find_copies(there):
        one, of = next(iter(copies.items()))
        found.append(
            f"{len(copies)} frames are copies of another one, the first {there[one].name} of "
            f"{there[of].name}"
        )
    known = []
    for path in there:
        with suppress(DataError, DriverMissing, ImageError):
            known.append(read_photograph(path))
    if len(known) > 1 and (other := other_camera(known)):
        found.append(other)
    return found


def moment_taken(path: Path) -> datetime | None:
    """Return when a photograph was taken as its EXIF says it, None where it does not."""
    try:
        return read_photograph(path).moment
    except (DataError, DriverMissing, ImageError):
        return None


def focal_length(path: Path) -> float | None:
    """Return the focal length that a photograph's EXIF says, mm, None where it does not."""
    try:
        return read_photograph(path, "file").focal_length
    except (DriverMissing, ImageError):
        return None


def _exif_moment(path: Path, details: dict[int, Any]) -> datetime:
    for when, part, offset in _TIME_TAGS:
        text = str(details.get(when) or "").strip("\0 ")
        if not text or text.startswith("0000"):
            continue
        fraction = re.sub(r"\D", "", str(details.get(part) or ""))
        zone = str(details.get(offset) or "").strip("\0 ")
        try:
            known = re.fullmatch(r"[+-]\d{2}:?\d{2}|Z", zone)
            moment = parse_moment(text + (zone if known else ""))
        except ValueError as cause:
            raise DataError(f"{path}: EXIF: {cause}") from cause
        if not isinstance(moment, datetime):
            raise DataError(f"{path}: EXIF: {text!r} is not a date with a time")
        return moment + timedelta(seconds=float(f"0.{fraction or 0}"))
    raise DataError(
        f"{path}: EXIF holds no time; take it from the name (--times name, as in "
        "IMG_20260614_120301.jpg) or from the file's date (--times file)"
    )


def _name_moment(path: Path) -> datetime:
    found = _IN_NAME.search(path.stem)
    if found is None:
        raise DataError(f"{path}: no time in the name; IMG_20260614_120301.jpg would hold one")
    try:
        moment = parse_moment(f"{found[1]}T{found[2]}" + (f".{found[3]}" if found[3] else ""))
    except ValueError as cause:
        raise DataError(f"{path}: the name: {cause}") from cause
    assert isinstance(moment, datetime)
    return moment


def _camera(details: dict[int, Any]) -> str:
    make, model = (str(details.get(tag) or "").strip("\0 ") for tag in (0x010F, 0x0110))
    return model if model.startswith(make) else f"{make} {model}".strip()


def _pixel_pitch(
    details: dict[int, Any], focal: float | None, width: int, height: int
) -> float | None:
    """From the focal plane's resolution, else from the focal length of a 35 mm camera, mm."""
    resolution, unit = _positive(details.get(0xA20E)), details.get(0xA210)
    per_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(unit if isinstance(unit, int) else 2)
    if resolution and per_mm and 5e-4 < per_mm / resolution < 0.02:
        return per_mm / resolution
    equivalent = _positive(details.get(0xA405))
    if focal and equivalent:
        return _DIAGONAL_35MM * focal / equivalent / float((width**2 + height**2) ** 0.5)
    return None


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < 1e6 else None


_LARGEST_GAP_IN_INTERVALS = 10.0


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
        tuple(str(p.path.absolute()) for p in placed), {}, logged,
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
