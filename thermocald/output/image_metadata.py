"""What a photograph says about itself (EXIF, colour profile, comments) carried to another file.

Sources: CIPA DC-008 (Exif 2.32) 4.5.4, segments of a JPEG; PNG specification (third edition) 11.3.
"""

from __future__ import annotations

import struct
from itertools import chain

_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_TOLD_JPEG = {0xE1, 0xE2, 0xED, 0xFE}
"""EXIF and XMP, colour profile, IPTC, comment."""
_TOLD_PNG = {b"eXIf", b"iCCP", b"tEXt", b"zTXt", b"iTXt", b"pHYs"}
_START_OF_SCAN = 0xDA


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
