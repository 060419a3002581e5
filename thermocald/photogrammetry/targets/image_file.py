"""Image files: size from the header, grey values, parts of a JPEG, metadata.

Source: PNG (ISO/IEC 15948), 11.2.2 IHDR; JPEG (ITU T.81), B.2.2 frame header; TIFF 6.0, section 2.

A JPEG can only be decoded from its start. Restart markers, which many phones and some webcams
write, divide it into segments that can be decoded separately: those around the targets are joined
to a smaller JPEG, which any decoder reads. The grey values are exactly those of the whole image,
since each block of 8 × 8 px is transformed separately and the luminance is not interpolated.

Source: ITU-T Recommendation T.81, B.2 (markers and headers) and A.2 (order of the blocks).

JPEGs are decoded by libjpeg-turbo through simplejpeg, to the luminance only, in two thirds of the
time of OpenCV. OpenCV decodes other files and those that simplejpeg refuses, to the same pixels.

EXIF is copied to another file, and comments are written: CIPA DC-008 (Exif 2.32), 4.5.4 (segments
of a JPEG); PNG specification (third edition), 11.3.
"""

from __future__ import annotations

import struct
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
import simplejpeg

from thermocald.arrays import scratch
from thermocald.errors import ImageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


_set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4, 5
_set_log_level(2)  # errors: of a damaged file we tell
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_BASELINE = {0xC0, 0xC1}
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_DRI, _SOS, _EOI = 0xDD, 0xDA, 0xD9
_TIFF_SIZE, _SHORT = (256, 257), 3  # tags of width and height; the type of 16 bit
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
        if data[:4] in (b"II*\0", b"MM\0*"):
            order = "<" if data[:2] == b"II" else ">"
            (start,) = struct.unpack_from(order + "I", data, 4)
            (count,) = struct.unpack_from(order + "H", data, start)
            tags = data[start + 2 : start + 2 + 12 * min(count, _MOST_TAGS)]
            size = {}
            for tag, kind, _, raw in struct.iter_unpack(order + "HHI4s", tags):
                (size[tag],) = struct.unpack_from(order + ("H" if kind == _SHORT else "I"), raw)
            width, height = (size.get(tag, 0) for tag in _TIFF_SIZE)
            return (width, height) if width and height else None
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return abs(width), abs(height)
        if data[:1] == b"P" and data[1:2] in b"123456":
            words = [
                w for line in data[:4096].split(b"\n") for w in line.partition(b"#")[0].split()
            ]
            return int(words[1][:9]), int(words[2][:9])
    except (struct.error, ValueError, IndexError, StopIteration):
        pass
    return None


_WORTH_IT = 0.98  # of the image; beyond, it is decoded as a whole


_Layout: TypeAlias = tuple[int, int, tuple[int, int], tuple[int, int], int]
"""A JPEG with restart markers: where its frame header states the size, where its coded bits start,
width and height, px, of the tile that a segment covers, columns and rows of tiles, and the height
of all minimum coded units, px."""


def _layout(data: bytes) -> _Layout | None:
    """Return the layout of a sequential JPEG with one scan and restart markers.

    None for others, and if segments are neither equal parts of a row of units nor whole rows.
    """
    at = {marker: begin for marker, begin, _ in _segments(data)}
    frame = next((at[marker] for marker in _BASELINE if marker in at), None)
    if frame is None or not {_SOS, _DRI} <= at.keys() or (_FRAMES - _BASELINE) & at.keys():
        return None

    def word(place: int) -> int:
        return int.from_bytes(data[place : place + 2], "big")

    head, interval = at[_SOS], word(at[_DRI] + 4)
    precision, components = data[frame + 4], data[frame + 9]
    if precision != 8 or components not in (1, 3) or data[head + 4] != components:
        return None
    sampling = [data[frame + 11 + 3 * k] for k in range(components)]
    wide, high = ([s >> 4 for s in sampling], [s & 15 for s in sampling])
    height, width = word(frame + 5), word(frame + 7)
    if max(wide) != wide[0] or max(high) != high[0] or not (height and width and interval):
        return None
    # the blocks of a single component are in order, whatever its sampling
    unit = (8, 8) if components == 1 else (8 * wide[0], 8 * high[0])
    across, down = -(-width // unit[0]), -(-height // unit[1])
    if across % interval and interval % across:
        return None
    columns, rows = max(across // interval, 1), max(interval // across, 1)
    return (
        frame + 5, head + 2 + word(head + 2), (across // columns * unit[0], rows * unit[1]),
        (columns, -(-down // rows)), down * unit[1],
    )  # fmt: skip


def _decode_tiles(
    data: bytes, full: tuple[int, int], layout: _Layout, boxes: NDArray[np.int64]
) -> NDArray[np.uint8] | None:
    """Decode a JPEG of width and height `full` px; return as `EncodedImage.around`."""
    low, high = np.clip(boxes.reshape(-1, 2, 2), 0, full).swapaxes(0, 1)
    seen = (high > low).all(axis=1)
    size_at, scan, tile, (columns, rows), coded = layout
    tile_width, tile_height = tile
    # which tiles meet a box, by cumulative sums of the boxes' corners
    left, top = (low[seen] // tile).T
    right, bottom = ((high[seen] - 1) // tile + 1).T
    count = np.zeros((rows + 1, columns + 1), dtype=np.int64)
    for y, x, sign in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(count, (y, x), sign)
    chosen = np.flatnonzero(count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1].ravel() > 0)
    segments = _bits(data, scan, columns * rows)
    if segments is None or not 0 < len(chosen) <= _WORTH_IT * columns * rows:
        return None
    row, column = np.divmod(chosen, columns)
    lines = -(-len(chosen) // columns)
    # the last line is filled up
    filled = np.r_[chosen, np.repeat(chosen[-1:], lines * columns - len(chosen))]
    width, height = columns * tile_width, lines * tile_height
    if row[-1] == rows - 1:  # the last tiles may have fewer rows of units
        height -= rows * tile_height - coded
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    parts = [data[:size_at] + size + data[size_at + 4 : scan]]
    for k, i in enumerate(filled.tolist()):
        parts += [data[segments[i, 0] : segments[i, 1]], bytes((0xFF, 0xD0 + k % 8))]
    parts[-1] = bytes((0xFF, _EOI))
    packed: NDArray[np.uint8] = scratch("packed", (lines * tile_height, width), np.uint8)
    simplejpeg.decode_jpeg(b"".join(parts), colorspace="GRAY", buffer=packed[:height])
    shape = (tile_height, columns, tile_width)
    image: NDArray[np.uint8] = scratch("parts", (rows * tile_height, width), np.uint8)
    places = np.arange(len(chosen))
    image.reshape(rows, *shape)[row, :, column] = packed.reshape(lines, *shape)[
        places // columns, :, places % columns
    ]
    return np.ascontiguousarray(image[: full[1], : full[0]])


def _bits(data: bytes, scan: int, count: int) -> NDArray[np.int64] | None:
    """Return start and end (count, 2) of all segments' bits in `data`; None if some are missing."""
    bits = np.frombuffer(data, np.uint8)[scan:]
    at = np.flatnonzero(bits[:-1] == 0xFF)
    after = bits[at + 1]
    restart = (after & 0xF8) == 0xD0
    others = at[~restart & (after != 0) & (after != 0xFF)]
    if len(others) == 0 or bits[others[0] + 1] != _EOI:
        return None
    restart &= at < others[0]
    marks = at[restart]
    if len(marks) != count - 1 or np.any((after[restart] & 7) != np.arange(len(marks)) % 8):
        return None
    return scan + np.stack([np.r_[0, marks + 2], np.r_[marks, others[0]]], axis=1)


_MOST_PIXELS = 250_000_000
_MOST_BYTES = 1_000_000_000


class EncodedImage:
    """An image file, or its encoded bytes (H, W); only the parts needed are decoded.

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

        EXIF's orientation flag is ignored, since the interior orientation is that of the sensor.
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
        try:
            image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(self.data, np.uint8), flags)
        except cv2.error as error:
            raise ImageError(
                f"{self.name}: is not an image that can be decoded ({error.err})"
            ) from error
        if image is None:
            raise ImageError(
                f"{self.name}: is not an image (JPEG, PNG and TIFF are read; convert HEIC)"
            )
        return image

    def around(self, boxes: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
        """Return grey values (H, W) that are valid in boxes (n, 4) px.

        A box is left, top, right and bottom, the last two exclusive. Elsewhere the values are
        undefined. The next call in this thread reuses the memory. None if the file does not have
        the shape (H, W), cannot be decoded in parts, or this would save no time.
        """
        if not self._is_jpeg or self.size is None or self.size[::-1] != tuple(shape):
            return None
        try:
            layout = _layout(self.data)
            return layout and _decode_tiles(self.data, self.size, layout, boxes)
        except (IndexError, ValueError):
            return None  # damaged; decoding the whole file reports how


def decode_grey(source: Path | bytes) -> NDArray[Any]:
    """Return grey values (H, W), 8 or 16 bit, of an image file or of encoded bytes.

    EXIF's orientation flag is ignored. Raises ImageError if something is wrong with the file.
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
