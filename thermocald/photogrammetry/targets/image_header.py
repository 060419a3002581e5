"""The size of an image as its file's head states it, before anything is decoded.

Source: PNG (ISO/IEC 15948), 11.2.2 IHDR; JPEG (ITU T.81), B.2.2 frame header; TIFF 6.0, section 2.
"""

from __future__ import annotations

import struct

__all__ = ["image_size"]

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_TAGS = {256: 0, 257: 1}
_MOST_TAGS = 500


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height px of PNG, JPEG, TIFF, BMP and PGM bytes; None for others and for damage."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return struct.unpack(">II", data[16:24])
        if data[:2] == b"\xff\xd8":
            return _jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data, "<" if data[:2] == b"II" else ">")
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return abs(width), abs(height)
        if data[:1] == b"P" and data[1:2] in b"123456":
            words = [
                w for line in data[:4096].split(b"\n") for w in line.partition(b"#")[0].split()
            ]
            return int(words[1][:9]), int(words[2][:9])
    except (struct.error, ValueError, IndexError):
        return None
    return None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 < len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + max(int.from_bytes(data[at + 2 : at + 4], "big"), 2)
    return None


def _tiff(data: bytes, order: str) -> tuple[int, int] | None:
    (start,) = struct.unpack(order + "I", data[4:8])
    (count,) = struct.unpack(order + "H", data[start : start + 2])
    size = [0, 0]
    for i in range(min(count, _MOST_TAGS)):
        at = start + 2 + 12 * i
        tag, kind = struct.unpack(order + "HH", data[at : at + 4])
        if tag in _TIFF_TAGS:
            form, length = ("H", 2) if kind == 3 else ("I", 4)
            (size[_TIFF_TAGS[tag]],) = struct.unpack(order + form, data[at + 8 : at + 8 + length])
    return (size[0], size[1]) if all(size) else None
