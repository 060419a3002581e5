"""Photographs with the times at which they were taken, from EXIF, the file's name or its date.

Only the header of a file is read, with the EXIF data of the camera. Source: CIPA DC-008, Exif 2.32:
DateTimeOriginal, SubSecTimeOriginal, OffsetTimeOriginal.

Photographs and a log of temperatures make a recording. Each photograph is an epoch with the nearest
reading in time and that reading's own time. The recording also has every reading of the log, from
which the temperature at a photograph's time is interpolated.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
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
from thermocald.files import reading
from thermocald.names import file_name
from thermocald.numbers import counted, short_duration
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.camera_files import read_camera
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.logger.clock import iso, parse_moment
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import LARGEST_GAP, EpochColumns, Recording
from thermocald.store.recording.sense import doubt_lines, pitch_doubts, time_fault
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.options import LogOptions
    from thermocald.store.recording.reader import TemperatureLog


SOURCES = ("exif", "name", "file")
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
_IN_NAME = re.compile(
    r"(\d{4})[-_.]?(\d\d)[-_.]?(\d\d)(?:[_T -]| at )?"
    r"(\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?:[_.-]?(\d{3}))?"
)
_SECONDS_IN_NAME = re.compile(r"(?<!\d)(?:1[5-9]|2\d)\d{8}(?:\d{3}|\.\d+)?(?!\d)")  # since 1970
_EXIF_IFD = 0x8769
_TIME_TAGS = ((0x9003, 0x9291, 0x9011), (0x9004, 0x9292, 0x9012), (0x0132, 0x9290, 0x9010))
"""Tags of time, fraction of a second and zone: when taken, digitised, last changed."""
_DIAGONAL_35MM = 43.2666  # mm, of 36 × 24


@dataclass(frozen=True, slots=True)
class Photograph:
    """A photograph: its file, its time as written by the camera, and its size in px.

    camera, focal_length (mm), pixel_pitch (mm), serial: from EXIF; "" or None if not given.
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
        """Name, serial number and focal length, the same for one camera with one lens."""
        return self.camera, self.serial, self.focal_length


def find_photographs(paths: list[Path]) -> list[Path]:
    """Return the pictures among files and in folders, each once. Raises DataError if none."""
    if not paths:
        raise DataError("no photographs are given")
    found: list[Path] = []
    for path in paths:
        with reading(path, DataError):
            if path.is_dir():
                # macOS leaves ._IMG_1.jpg, which is no picture, beside IMG_1.jpg
                found += sorted(
                    p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.name[0] != "."
                )
            elif path.is_file():
                found.append(path)
            else:
                raise DataError(f"{path}: there is no such file or folder")
    if not found:
        raise DataError(
            f"{paths[0]}: holds no photographs ({', '.join(sorted(SUFFIXES))}); convert others, "
            "such as HEIC, to JPEG; folders in it are not searched"
        )
    return list(dict.fromkeys(found))


def read_photographs(paths: list[Path], source: str = "exif") -> list[Photograph]:
    """Read all photographs among files and in folders.

    Raises UsageError for an unknown source of their times, and the errors of `find_photographs` and
    `read_photograph`.
    """
    if source not in SOURCES:
        raise UsageError(f"--times {source}: must be one of {', '.join(SOURCES)}")
    return [read_photograph(path, source) for path in find_photographs(paths)]


def read_photograph(path: Path, source: str = "exif") -> Photograph:
    """Read one photograph; `source` of its time is one of SOURCES.

    Raises ImageError for a file that is not a picture, DataError if it has no time.
    """
    if importlib.util.find_spec("PIL") is None:
        raise DriverMissing("reading photographs needs Pillow: pip install 'thermocald[report]'")
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # a large image is no attack, as it is not decoded here
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            # damaged EXIF: the values that are used are tested
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
    make, model, serial = (
        str(details.get(tag) or "").strip("\0 ") for tag in (0x010F, 0x0110, 0xA431)
    )
    return Photograph(
        path, moment, width, height, model if model.startswith(make) else f"{make} {model}".strip(),
        focal, _pixel_pitch(details, focal, width, height), serial,
    )  # fmt: skip


def other_camera(photographs: Sequence[Photograph]) -> str | None:
    """Return a sentence on the first photograph of another camera than most, or None.

    Name, serial number and focal length within 2 % (zoom, other lens) of EXIF are compared.
    """
    usual = Counter(p.body for p in photographs).most_common(1)[0][0]
    for photograph in photographs:
        name, serial, focal = photograph.body
        same_lens = focal == usual[2] or (focal and usual[2] and abs(focal / usual[2] - 1) < 0.02)
        if (name, serial) != usual[:2] or not same_lens:
            return (
                f"{photograph.path.name} is of {_body_text(photograph.body)}, the others of "
                f"{_body_text(usual)}"
            )
    return None


def _body_text(body: tuple[str, str, float | None]) -> str:
    name, serial, focal = body
    parts = [name or "a camera without a name", serial, f"{focal:g} mm" if focal else ""]
    return " ".join(part for part in parts if part)


def find_copies(paths: Sequence[Path]) -> dict[int, int]:
    """Return {position of a copy: position of the first file with the same bytes}.

    Files that cannot be read are ignored.
    """
    first: dict[bytes, int] = {}
    copies = {}
    # False, too, in a closed folder
    sizes = [os.path.getsize(path) if os.path.isfile(path) else -1 for path in paths]
    alike = Counter(sizes)
    for i, path in enumerate(paths):
        if alike[sizes[i]] == 1:
            continue
        with suppress(OSError), path.open("rb") as file:
            key = hashlib.file_digest(file, "sha256").digest()
            if (known := first.setdefault(key, i)) != i:
                copies[i] = known
    return copies


def strange_photographs(paths: Sequence[Path]) -> list[str]:
    """Return doubts about the frames of a recording, a sentence each."""
    there = list(dict.fromkeys(path for path in paths if os.path.isfile(path)))
    found = []
    if copies := find_copies(there):
        copy, original = next(iter(copies.items()))
        found.append(
            f"{counted(len(copies), 'frame')} copied from another one, the first "
            f"{there[copy].name} from {there[original].name}"
        )
    known = [photograph for path in there if (photograph := known_photograph(path))]
    if len(known) > 1 and (other := other_camera(known)):
        found.append(other)
    return found


def known_photograph(path: Path, source: str = "exif") -> Photograph | None:
    """Return what `read_photograph` returns, or None where it would raise."""
    try:
        return read_photograph(path, source)
    except (DataError, DriverMissing, ImageError):
        return None


def _exif_moment(path: Path, details: dict[int, Any]) -> datetime:
    for when, part, offset in _TIME_TAGS:
        text = str(details.get(when) or "").strip("\0 ")
        if not re.search("[1-9]", text):  # blanks or zeros: the camera's clock is not set
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
    if found := _IN_NAME.search(path.stem):
        *parts, fraction = found.groups(default="")
        text = "{}-{}-{}T{}:{}:{}".format(*parts) + (fraction and f".{fraction}")
    elif found := _SECONDS_IN_NAME.search(path.stem):
        text = found[0]
    else:
        raise DataError(f"{path}: no time in the name, as in IMG_20260614_120301.jpg")
    try:
        moment = parse_moment(text)
    except ValueError as cause:
        raise DataError(f"{path}: the name: {cause}") from cause
    assert isinstance(moment, datetime)
    # names by Google's phones are in UTC
    return moment.replace(tzinfo=UTC) if path.name.startswith("PXL_") else moment


def _pixel_pitch(
    details: dict[int, Any], focal: float | None, width: int, height: int
) -> float | None:
    """Return the pixel pitch, mm, from the focal plane's resolution or the 35 mm equivalent."""
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
    """Combine photographs and a logger's file into a recording; return it with notes for the user.

    The recording has no folder yet. Copies of a photograph are left out. testfield: None for a dry
    run, in which an unknown pixel pitch is only noted; camera: a camera file, used instead of EXIF;
    pitch, distance mm: used instead of EXIF's. Raises DataError for photographs of different sizes
    or cameras, for times without a zone, and if log and photographs do not overlap in time.
    """
    placed, times, notes = _sort_photographs(photographs, clock)
    logged = read_log(log, options, (float(times[0]), float(times[-1])))
    columns = _pair(placed, times, logged)
    reference = next(iter(columns.temperatures))
    at_frame = columns.at_frame(reference)
    known = np.isfinite(at_frame)
    if not known.any():
        raise DataError(
            "no photograph has a temperature: the log has gaps at the times of all photographs "
            f"({iso(times[0])} to {iso(times[-1])})"
        )
    spec, about_camera = _camera_of(photographs[0], camera, pitch, distance, testfield is None)
    interval = float(np.median(np.diff(np.unique(times)))) if len(times) > 1 else 1.0
    span = f"{iso(times[0])} to {iso(times[-1])}, every {interval:.4g} s"
    temperatures = f"{np.nanmin(at_frame):.2f} to {np.nanmax(at_frame):.2f} °C"
    notes = [
        f"photographs: {len(times)}, {placed[0].width} × {placed[0].height} px, {span}",
        *notes, *logged.notes,
        f"log: {iso(logged.times[0])} to {iso(logged.times[-1])}, every {logged.step:.4g} s",
        (f"temperature ({reference}): known for {known.sum()} of "
         f"{counted(len(known), 'photograph')}, {temperatures}"),
    ]  # fmt: skip
    for i in sorted({0, len(times) // 2, len(times) - 1}):
        reading = f"{at_frame[i]:.3f} °C" if known[i] else "no temperature"
        notes.append(f"  {placed[i].path.name}  {iso(times[i])}  {reading}")
    thermometers = dict.fromkeys(columns.temperatures, Channel())
    series = file_name(series, "series", UsageError)
    head = Head(f"{spec.name}-{series}", series, max(interval, 0.001), spec, thermometers)
    field = testfield or TestField.build((), np.empty((0, 3)), np.empty((0, 3)), (), (), ())
    recording = Recording(Path(), head, field, columns, has_observations=False)
    return recording, [*notes, *about_camera]


def _sort_photographs(
    photographs: Sequence[Photograph], clock: DeviceClock
) -> tuple[list[Photograph], Array, list[str]]:
    """Return photographs of one camera in the order of their times, these, s UTC, and notes.

    Copies are left out. Raises DataError for several sizes or cameras, and for impossible times.
    """
    one = photographs[0]
    size = one.width, one.height
    if other := next((p for p in photographs if (p.width, p.height) != size), None):
        raise DataError(
            f"{other.path}: has {other.width} × {other.height} px, {one.path.name} "
            f"{one.width} × {one.height}: a recording has one camera in one position; import "
            "them separately"
        )
    if strange := other_camera(photographs):
        raise DataError(f"{strange}: a recording has one camera and lens; import them separately")
    copies = find_copies([p.path for p in photographs])
    notes = [
        f"photographs: {photographs[i].path.name} is a copy of {photographs[k].path.name}: left out"
        for i, k in copies.items()
    ]
    kept = [p for i, p in enumerate(photographs) if i not in copies]
    # sorted by name first, which gives the order within one second
    named = sorted(kept, key=lambda p: p.path.name)
    times = clock.utc([p.moment for p in named], lambda i: str(named[i].path))
    order = np.argsort(times, kind="stable")
    times = times[order]
    placed = [named[i] for i in order.tolist()]
    if fault := time_fault(times):
        raise DataError(
            f"{placed[fault[0]].path}: was taken at {iso(times[fault[0]])}, years from the "
            "photograph before: a clock that was not set? Correct the times, or leave some out"
        )
    if len(times) > 1 and np.ptp(times) == 0:
        raise DataError(
            f"{placed[0].path}: all photographs have its time; take them from other data (--times)"
        )
    if (same := np.flatnonzero(np.diff(times) == 0)).size:
        first, second = (p.path.name for p in placed[same[0] : same[0] + 2])
        notes.append(
            f"doubtful: {counted(len(same), 'photograph')} with the time of another one, the first "
            f"{first} and {second}: the order of their names is used"
        )
    return placed, times, notes


def _pair(placed: Sequence[Photograph], times: Array, logged: TemperatureLog) -> EpochColumns:
    """Return epochs of photographs with times (E,) s, each with the log's reading nearest in time.

    Raises DataError if photographs and log do not overlap in time.
    """
    log = logged.times
    if (gap := max(times[0] - log[-1], log[0] - times[-1])) > 0:
        raise DataError(
            f"photographs ({iso(times[0])} to {iso(times[-1])}) and log ({iso(log[0])} to "
            f"{iso(log[-1])}) are {short_duration(gap)} apart: is a time zone wrong "
            "(--camera-timezone, --log-timezone), or a clock (--camera-clock, --log-clock)"
            + (", or are years written with two digits?" if gap > 3e7 else "?")
        )
    right = np.clip(np.searchsorted(log, times), 1, len(log) - 1)
    row = np.where(times - log[right - 1] <= log[right] - times, right - 1, right)
    near = np.abs(log[row] - times) <= LARGEST_GAP * logged.step
    channels = {n: np.where(near, values[row], np.nan) for n, values in logged.channels.items()}
    return EpochColumns(
        np.arange(1, len(times) + 1), times, np.where(near, log[row], np.nan), channels,
        tuple(str(p.path.absolute()) for p in placed), {}, logged,
    )  # fmt: skip


def _camera_of(
    photograph: Photograph,
    file: Path | None,
    pitch: float | None,
    distance: float | None,
    dry_run: bool,
) -> tuple[CameraSpec, list[str]]:
    """Return the camera of photographs, with notes on values from EXIF and doubts.

    file: a camera file, used instead of EXIF; pitch, distance mm: used instead of EXIF's; dry_run:
    an unknown pixel pitch is noted, not an error.
    """
    if file is not None:
        known = read_camera(file, pitch)
        if (known.sensor.width, known.sensor.height) != (photograph.width, photograph.height):
            raise UsageError(
                f"{file}: is of {known.sensor.width} × {known.sensor.height} px, the photographs "
                f"have {photograph.width} × {photograph.height}"
            )
        return known, doubt_lines(pitch_doubts(known.sensor.pixel_pitch, photograph.pixel_pitch))
    notes: list[str] = []
    if distance is None and photograph.focal_length is not None:
        distance = photograph.focal_length
        notes.append(f"camera: principal distance {distance:g} mm from EXIF (--principal-distance)")
    if pitch is None:
        pitch = photograph.pixel_pitch
        unknown = (
            "the pixel pitch is unknown, as EXIF does not give it: set --pixel-pitch (mm; "
            "0.00112 for a Raspberry Pi camera v2.1) or --camera FILE"
        )
        if pitch is None and not dry_run:
            raise UsageError(unknown)
        source = f"pixel pitch {pitch:.5f} mm from EXIF (--pixel-pitch)" if pitch else unknown
        notes.append(f"camera: {source}")
        pitch = pitch or 0.001
    else:
        notes += doubt_lines(pitch_doubts(pitch, photograph.pixel_pitch))
    sensor = Sensor(photograph.width, photograph.height, pitch)
    return CameraSpec(photograph.camera or "camera", sensor, distance), notes


def write_photographs(folder: Path, recording: Recording) -> None:
    """Write a recording of `read_series` into a new folder."""
    head = replace(recording.head, name=folder.name)
    with RecordingWriter(folder, head, recording.testfield) as writer:
        for epoch in recording.iter_epochs():
            writer.append(epoch)
        assert recording.columns.readings is not None
        writer.keep_readings(recording.columns.readings)
