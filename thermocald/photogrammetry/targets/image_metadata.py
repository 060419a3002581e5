"""What a photograph says about itself: EXIF and comments written, and carried to another file.

Sources: CIPA DC-008 (Exif 2.32), 4.5.4 (segments of a JPEG) and 4.6 (tags); TIFF 6.0, section 2;
PNG specification (third edition), 11.3.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from itertools import chain
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

_Value = str | int | float
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_APP1, _COMMENT = 0xE1, 0xFE
_EXIF = b"Exif\0\0"
_TOLD_JPEG = {_APP1, 0xE2, 0xED, _COMMENT}
"""EXIF and XMP, colour profile, IPTC, comment."""
_TOLD_PNG = {b"eXIf", b"iCCP", b"tEXt", b"zTXt", b"iTXt", b"pHYs"}
_START_OF_SCAN = 0xDA
_DETAILS = 0x8769  # the tag that points to EXIF's own directory
_PER_MM = 4  # EXIF's unit of a focal plane's resolution
_FRACTION = 10_000  # denominator of rational numbers


def with_metadata(image: bytes, source: bytes) -> bytes:
    """Return an encoded image with the metadata of another; both JPEG or PNG, else as it is."""
    if image.startswith(_JPEG) and source.startswith(_JPEG):
        told = b"".join(part for kind, part in _segments(source) if kind in _TOLD_JPEG)
        return image[:2] + told + image[2:]
    if image.startswith(_PNG) and source.startswith(_PNG):
        head, *rest = _chunks(image)
        told_png = [chunk for chunk in _chunks(source) if chunk[4:8] in _TOLD_PNG]
        return _PNG + b"".join(chain([head], told_png, rest))
    return image


def has_exif(image: bytes) -> bool:
    """Whether an encoded image is a JPEG with EXIF."""
    return image.startswith(_JPEG) and any(
        kind == _APP1 and part[4:10] == _EXIF for kind, part in _segments(image)
    )


def with_exif(jpeg: bytes, camera: str, utc: float, focal_mm: float, pixels_per_mm: float) -> bytes:
    """Return a JPEG with EXIF: camera, time, upright, focal length and pixels; utc: s."""
    moment = datetime.fromtimestamp(utc, UTC)
    base: dict[int, _Value] = {0x0110: camera, 0x0112: 1, 0x0131: "thermocald", _DETAILS: 0}
    details: dict[int, _Value] = {
        0x9003: moment.strftime("%Y:%m:%d %H:%M:%S"), 0x9011: "+00:00",
        0x9291: f"{moment.microsecond // 1000:03d}", 0x920A: focal_mm,
        0xA20E: pixels_per_mm, 0xA20F: pixels_per_mm, 0xA210: _PER_MM,
    }  # fmt: skip
    base[_DETAILS] = 8 + len(_directory(base, 8))
    tiff = b"II*\0" + struct.pack("<I", 8) + _directory(base, 8)
    return _with_segment(jpeg, _APP1, _EXIF + tiff + _directory(details, len(tiff)))


def with_comment(jpeg: bytes, text: str) -> bytes:
    """Return a JPEG with a comment behind what it says already; text: below 65 kB."""
    return _with_segment(jpeg, _COMMENT, text.encode())


def _directory(entries: Mapping[int, _Value], start: int) -> bytes:
    """A directory of TIFF, little-endian, whose first byte is at `start`: ASCII, long, rational."""
    head, tail = struct.pack("<H", len(entries)), b""
    behind = start + 2 + 12 * len(entries) + 4
    for tag, value in sorted(entries.items()):
        kind, count = 4, 1
        if isinstance(value, str):
            data = value.encode("ascii", "replace") + b"\0"
            kind, count = 2, len(data)
        elif isinstance(value, float):
            data, kind = struct.pack("<II", round(value * _FRACTION), _FRACTION), 5
        else:
            data = struct.pack("<I", value)
        if len(data) > 4:
            at = behind + len(tail)
            tail += data + b"\0" * (len(data) % 2)
            data = struct.pack("<I", at)
        head += struct.pack("<HHI4s", tag, kind, count, data)
    return head + struct.pack("<I", 0) + tail


def _with_segment(jpeg: bytes, kind: int, content: bytes) -> bytes:
    """Insert a segment behind those that say something of the image."""
    place = 2
    for known, part in _segments(jpeg):
        if known not in _TOLD_JPEG and known != 0xE0:
            break
        place += len(part)
    segment = struct.pack(">BBH", 0xFF, kind, len(content) + 2) + content
    return jpeg[:place] + segment + jpeg[place:]


def _segments(data: bytes) -> list[tuple[int, bytes]]:
    """Marker and bytes of each segment before the image's data."""
    found, place = [], 2
    while place + 4 <= len(data) and data[place] == 0xFF and data[place + 1] != _START_OF_SCAN:
        (length,) = struct.unpack_from(">H", data, place + 2)
        found.append((data[place + 1], data[place : place + 2 + length]))
        place += 2 + length
    return found


def _chunks(data: bytes) -> list[bytes]:
    found, place = [], len(_PNG)
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        found.append(data[place : place + 12 + length])
        place += 12 + length
    return found
