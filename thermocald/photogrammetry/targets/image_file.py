"""Image files: size from the header, grey values, metadata.

Source: PNG (ISO/IEC 15948), 11.2.2 IHDR; JPEG (ITU T.81), B.2.2 frame header; TIFF 6.0, section 2.

JPEGs are decoded by libjpeg-turbo through simplejpeg, to the luminance only, in two thirds of the
time of OpenCV. OpenCV decodes other files and those that simplejpeg refuses, to the same pixels.

EXIF is copied to another file, and comments are written: CIPA DC-008 (Exif 2.32), 4.5.4 (segments
of a JPEG); PNG specification (third edition), 11.3.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg

from thermocald.errors import ImageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


_set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4, 5
_set_log_level(2)  # errors: of a damaged file we tell
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SOS, _EOI = 0xDA, 0xD9
_TIFF = b"II*\0", b"MM\0*"
_WIDTH, _HEIGHT, _ORIENTATION, _SHORT = 256, 257, 274, 3  # tags; the type of 16 bit
_MOST_TAGS = 500


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield marker, begin and end of each segment of a JPEG, up to the header of its first scan."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD8:  # without content
            at += 2
        else:
            begin, at = at, at + 2 + max(int.from_bytes(data[at + 2 : at + 4], "big"), 2)
            yield marker, begin, at
            if marker == _SOS:
                return


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height, px, of a PNG, JPEG, TIFF, BMP or PGM; None for other bytes."""
    try:
        if data[:8] == _PNG:
            return struct.unpack(">II", data[16:24])
        if data[:2] == _JPEG:
            at = next(begin for marker, begin, _ in _segments(data) if marker in _FRAMES)
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        if data[:4] in _TIFF:
            tags = _tiff_tags(data)
            (width,), (height,) = (
                struct.unpack_from(form, data, at) for form, at in (tags[_WIDTH], tags[_HEIGHT])
            )
            return (width, height) if width and height else None
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return abs(width), abs(height)
        if data[:1] == b"P" and data[1:2] in b"123456":
            words = [
                w for line in data[:4096].split(b"\n") for w in line.partition(b"#")[0].split()
            ]
            return int(words[1][:9]), int(words[2][:9])
    except (struct.error, ValueError, LookupError, StopIteration):
        pass
    return None


def _tiff_tags(data: bytes) -> dict[int, tuple[str, int]]:
    """Return format and place of the value of each tag in a TIFF's first directory."""
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    tags = {}
    for at in range(start + 2, start + 2 + 12 * min(count, _MOST_TAGS), 12):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        tags[tag] = order + ("H" if kind == _SHORT else "I"), at + 8
    return tags


_MOST_PIXELS = 250_000_000
_MOST_BYTES = 1_000_000_000


class EncodedImage:
    """An image file, or its encoded bytes (H, W), decoded when asked for.

    size: width and height, px, by its header, None if that is not read (WebP).
    Raises ImageError if something is wrong with the file, at the latest when it is decoded.
    """

    def __init__(self, source: Path | bytes) -> None:
        self.name = str(source) if isinstance(source, Path) else "the frame"
        self.data = data = _read(source, self.name) if isinstance(source, Path) else source
        if not data:
            raise ImageError(f"{self.name}: is empty (0 bytes)")
        self.size = image_size(data)
        if self.size is not None and self.size[0] * self.size[1] > _MOST_PIXELS:
            raise ImageError(
                f"{self.name}: has {self.size[0]} × {self.size[1]} px by its header; at most "
                f"{_MOST_PIXELS // 10**6} million are decoded"
            )
        self._is_jpeg = data[:2] == _JPEG
        # phones append a video after the end; a preview among the metadata has an end of its own
        scan = max((end for *_, end in _segments(data)), default=2) if self._is_jpeg else 0
        if self._is_jpeg and data.rfind(bytes((0xFF, _EOI)), scan) < 0:
            raise ImageError(f"{self.name}: the JPEG is cut off, its end is missing")

    def whole(self) -> NDArray[Any]:
        """Return grey values (H, W), 8 or 16 bit.

        The orientation flag is ignored, since the interior orientation is that of the sensor.
        """
        if self._is_jpeg:
            try:
                grey: NDArray[Any] = simplejpeg.decode_jpeg(self.data, colorspace="GRAY")[..., 0]
                return grey
            except ValueError:
                pass  # another colour space, or damage that OpenCV tolerates or reports
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        image = self._decode(flags)
        if image.dtype not in (np.uint8, np.uint16):
            raise ImageError(f"{self.name}: {image.dtype} grey values; 8 or 16 bit are read")
        return image

    def as_it_is(self) -> NDArray[Any]:
        """Return values (H, W) or (H, W, 3 or 4) of the file's own type, not rotated."""
        return self._decode(cv2.IMREAD_UNCHANGED)

    def _decode(self, flags: int) -> NDArray[Any]:
        data = bytearray(self.data)
        if data[:4] in _TIFF:  # OpenCV turns it, whatever the flags
            with suppress(struct.error, KeyError):
                form, at = _tiff_tags(self.data)[_ORIENTATION]
                struct.pack_into(form, data, at, 1)
        try:
            image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            raise ImageError(
                f"{self.name}: is not an image that can be decoded ({error.err})"
            ) from error
        if image is None:
            raise ImageError(
                f"{self.name}: is not an image or is cut off (JPEG, PNG, TIFF are read, not HEIC)"
            )
        return image


def decode_grey(source: Path | bytes) -> NDArray[Any]:
    """Return grey values (H, W), 8 or 16 bit, of an image file or of encoded bytes.

    The orientation flag is ignored. Raises ImageError if something is wrong with the file.
    """
    return EncodedImage(source).whole()


def _read(path: Path, name: str) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise ImageError(f"{name}: is not a file")
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            raise ImageError(f"{name}: is larger than {_MOST_BYTES // 10**6} MB")
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"{name}: cannot be read: {error.strerror or error}") from error


_COMMENT = 0xFE
_METADATA_JPEG = {0xE1, 0xE2, 0xED, _COMMENT}
"""EXIF and XMP, colour profile, IPTC, comment."""
_METADATA_PNG = {b"eXIf", b"iCCP", b"tEXt", b"zTXt", b"iTXt", b"pHYs"}


def with_metadata(image: bytes, source: bytes) -> bytes:
    """Return an encoded image with another's metadata; unchanged unless both are JPEG or PNG."""
    if image.startswith(_JPEG) and source.startswith(_JPEG):
        metadata = b"".join(
            source[begin:end] for kind, begin, end in _segments(source) if kind in _METADATA_JPEG
        )
        return image[:2] + metadata + image[2:]
    if image.startswith(_PNG) and source.startswith(_PNG):
        head, *rest = _chunks(image)
        chunks = [chunk for chunk in _chunks(source) if chunk[4:8] in _METADATA_PNG]
        return _PNG + b"".join(chain([head], chunks, rest))
    return image


def with_comment(jpeg: bytes, text: str) -> bytes:
    """Return a JPEG with a comment after its other metadata; text: below 65 kB."""
    place = 2
    for marker, _, end in _segments(jpeg):
        if marker not in _METADATA_JPEG and marker != 0xE0:
            break
        place = end
    content = text.encode()
    segment = struct.pack(">BBH", 0xFF, _COMMENT, len(content) + 2) + content
    return jpeg[:place] + segment + jpeg[place:]


def _chunks(data: bytes) -> list[bytes]:
    chunks, place = [], len(_PNG)
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        chunks.append(data[place : place + 12 + length])
        place += 12 + length
    return chunks
