"""Photographs with the times at which they were taken: from EXIF, the file's name, or its date.

Only the head of a file is read; what EXIF says of the camera comes with it. Source: CIPA DC-008,
Exif 2.32: DateTimeOriginal, SubSecTimeOriginal, OffsetTimeOriginal.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
import struct
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from thermocald.errors import DataError, DriverMissing, ImageError, UsageError
from thermocald.store.logger.clock import parse_moment

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


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
    """Return {position: of the first one with the same bytes} of files that are there twice."""
    sizes = Counter(path.stat().st_size for path in paths)
    first: dict[bytes, int] = {}
    copies = {}
    for i, path in enumerate(paths):
        if sizes[path.stat().st_size] > 1:
            with path.open("rb") as file:
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
