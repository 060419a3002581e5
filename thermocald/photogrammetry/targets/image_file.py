"""Image files: their size from the header, their grey values, and parts of a JPEG alone.

Source: PNG (ISO/IEC 15948), 11.2.2 IHDR; JPEG (ITU T.81), B.2.2 frame header; TIFF 6.0, section 2.

The bits of a JPEG can be read only from its start. Restart markers, which many phones and some
webcams write, divide it into segments that can be read alone: those around the targets are joined
to a smaller JPEG, which any decoder reads. Without them decoding stops after the last row that is
needed. The grey values are exactly those of the whole image, since every block of 8 × 8 px is
transformed by itself and the luminance is not interpolated.

Source: ITU-T Recommendation T.81, B.2 (markers and headers) and A.2 (order of the blocks).

JPEGs are decoded by libjpeg-turbo through simplejpeg, to the luminance alone: two thirds of the
time of OpenCV, which decodes all others and those that simplejpeg refuses. The pixels are the same.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg

from thermocald.arrays import scratch
from thermocald.errors import ImageError

if TYPE_CHECKING:
    from numpy.typing import NDArray


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


if TYPE_CHECKING:
    from numpy.typing import NDArray

    Boxes = NDArray[np.int64]
    Grey = NDArray[np.uint8]


_BASELINE = (0xC0, 0xC1)
_OTHER_FRAMES = frozenset(range(0xC2, 0xD0)) - {0xC4, 0xC8, 0xCC}
_DRI, _SOS, _EOI = 0xDD, 0xDA, 0xD9
_WORTH_IT = 0.98  # of the image: beyond, the whole is decoded


@dataclass(frozen=True, slots=True)
class _Layout:
    """width, height px; size_at, scan: where the frame header states them, and where the coded
    bits start; unit: width and height px of the units that the bits are ordered in; interval:
    units between two restart markers, 0 without them.
    """

    width: int
    height: int
    size_at: int
    scan: int
    unit: tuple[int, int]
    interval: int

    @property
    def units(self) -> tuple[int, int]:
        """Units in a row, and rows of them."""
        return -(-self.width // self.unit[0]), -(-self.height // self.unit[1])


@dataclass(frozen=True, slots=True)
class _Tiles:
    """What one segment covers: width, height px; columns and rows of tiles in the image."""

    width: int
    height: int
    columns: int
    rows: int


def decode_parts(data: bytes, boxes: Boxes) -> Grey | None:
    """Grey values (H, W) of a JPEG that hold within boxes (n, 4) px: left, top, right, bottom.

    Right and bottom are exclusive. Elsewhere the values are undefined, and the memory is used again
    by the next call in this thread. None where the file does not allow it or it would not pay.
    """
    try:
        layout = _layout(data)
        if layout is None:
            return None
        size = (layout.width, layout.height)
        low = np.clip(boxes[:, :2], 0, size)
        high = np.clip(boxes[:, 2:], 0, size)
        seen = (high > low).all(axis=1)
        if not seen.any():
            return None
        low, high = low[seen], high[seen]
        grey = _by_segments(data, layout, low, high) if layout.interval else None
        return _upper_rows(data, layout, int(high[:, 1].max())) if grey is None else grey
    except (IndexError, ValueError):
        return None  # damaged: decoding the whole file says how


def _layout(data: bytes) -> _Layout | None:
    """The layout of a sequential JPEG with one scan; None for all others."""
    at, interval, frame = 2, 0, None
    while data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xFF:
            at += 1
            continue
        if marker in _OTHER_FRAMES:
            return None
        if marker in _BASELINE:
            frame = at
        elif marker == _DRI:
            interval = int.from_bytes(data[at + 4 : at + 6], "big")
        elif marker == _SOS:
            scan = at + 2 + length
            break
        at += 2 + length
    else:
        return None
    if frame is None:
        return None
    precision, components = data[frame + 4], data[frame + 9]
    if precision != 8 or components not in (1, 3) or data[at + 4] != components:
        return None
    sampling = [data[frame + 11 + 3 * k] for k in range(components)]
    across, down = ([s >> 4 for s in sampling], [s & 15 for s in sampling])
    if max(across) != across[0] or max(down) != down[0]:
        return None
    # The blocks of a single component follow one another, however it is sampled.
    unit = (8, 8) if components == 1 else (8 * across[0], 8 * down[0])
    height, width = (int.from_bytes(data[frame + k : frame + k + 2], "big") for k in (5, 7))
    if not height or not width:
        return None
    return _Layout(width, height, frame + 5, scan, unit, interval)


def _headed(data: bytes, layout: _Layout, width: int, height: int) -> bytes:
    """All before the coded bits, for an image of another size."""
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return data[: layout.size_at] + size + data[layout.size_at + 4 : layout.scan]


def _upper_rows(data: bytes, layout: _Layout, bottom: int) -> Grey | None:
    """The image down to a row; below it is undefined."""
    height = -(-bottom // layout.unit[1]) * layout.unit[1]
    if height > _WORTH_IT * layout.height:
        return None
    grey: Grey = scratch("parts", (layout.height, layout.width), np.uint8)
    file = scratch("file", (len(data),), np.uint8)
    file[:] = np.frombuffer(data, np.uint8)
    file[layout.size_at : layout.size_at + 2] = divmod(height, 256)
    # What follows the last row is reported as superfluous, which is why warnings are no errors.
    simplejpeg.decode_jpeg(file.data, colorspace="GRAY", buffer=grey[:height], strict=False)
    return grey


def _by_segments(data: bytes, layout: _Layout, low: Boxes, high: Boxes) -> Grey | None:
    """The image where its segments meet the boxes."""
    tiles = _tiles(layout)
    if tiles is None:
        return None
    needed = _touched(tiles, low, high)
    segments = _segments(data, layout, tiles.columns * tiles.rows)
    if segments is None or needed.sum() > _WORTH_IT * needed.size:
        return None
    chosen = np.flatnonzero(needed)
    row, column = np.divmod(chosen, tiles.columns)
    lines = -(-len(chosen) // tiles.columns)
    # the last line is filled up
    filled = np.r_[chosen, np.repeat(chosen[-1:], lines * tiles.columns - len(chosen))]
    width, unit_rows = tiles.columns * tiles.width, layout.units[1]
    height = lines * tiles.height
    if row[-1] == tiles.rows - 1:  # whose tile may have fewer rows of units than the others
        height -= (tiles.rows * tiles.height) - unit_rows * layout.unit[1]
    parts = [_headed(data, layout, width, height)]
    for k, i in enumerate(filled.tolist()):
        parts += [data[segments[i, 0] : segments[i, 1]], bytes((0xFF, 0xD0 + k % 8))]
    parts[-1] = bytes((0xFF, _EOI))
    packed: Grey = scratch("packed", (lines * tiles.height, width), np.uint8)
    simplejpeg.decode_jpeg(b"".join(parts), colorspace="GRAY", buffer=packed[:height])
    shape = (tiles.height, tiles.columns, tiles.width)
    image: Grey = scratch("parts", (tiles.rows * tiles.height, width), np.uint8)
    places = np.arange(len(chosen))
    image.reshape(tiles.rows, *shape)[row, :, column] = packed.reshape(lines, *shape)[
        places // tiles.columns, :, places % tiles.columns
    ]
    return np.ascontiguousarray(image[: layout.height, : layout.width])


def _tiles(layout: _Layout) -> _Tiles | None:
    """The tiles of segments that divide a row of units, or hold whole ones."""
    across, down = layout.units
    if across % layout.interval == 0:
        columns = across // layout.interval
        return _Tiles(layout.interval * layout.unit[0], layout.unit[1], columns, down)
    if layout.interval % across == 0:
        rows = layout.interval // across
        return _Tiles(across * layout.unit[0], rows * layout.unit[1], 1, -(-down // rows))
    return None


def _touched(tiles: _Tiles, low: Boxes, high: Boxes) -> NDArray[np.bool_]:
    """Which tiles (rows · columns,) meet a box, by the sums of the boxes' corners."""
    size = (tiles.width, tiles.height)
    left, top = (low // size).T
    right, bottom = ((high - 1) // size + 1).T
    count = np.zeros((tiles.rows + 1, tiles.columns + 1), dtype=np.int64)
    for y, x, sign in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(count, (y, x), sign)
    touched: NDArray[np.bool_] = count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
    return touched.ravel()


def _segments(data: bytes, layout: _Layout, count: int) -> NDArray[np.int64] | None:
    """Start and end (count, 2) in `data` of each segment's bits; None where some are missing."""
    bits = np.frombuffer(data, np.uint8)[layout.scan :]
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
    return layout.scan + np.stack([np.r_[0, marks + 2], np.r_[marks, others[0]]], axis=1)


_MOST_PIXELS = 250_000_000
_MOST_BYTES = 1_000_000_000


class EncodedImage:
    """An image file or encoded bytes (H, W), decoded as far as they are looked at.

    Raises ImageError saying what is wrong with the file, at the latest when it is decoded.
    """

    def __init__(self, source: Path | bytes) -> None:
        self.name = str(source) if isinstance(source, Path) else "the frame"
        self._data = data = _read(source, self.name) if isinstance(source, Path) else source
        if not data:
            raise ImageError(f"{self.name}: is empty (0 bytes)")
        self._size = image_size(data)
        if self._size is not None and self._size[0] * self._size[1] > _MOST_PIXELS:
            raise ImageError(
                f"{self.name}: says that it has {self._size[0]} × {self._size[1]} px; at most "
                f"{_MOST_PIXELS // 10**6} million are decoded"
            )
        self._is_jpeg = data[:2] == b"\xff\xd8"
        if self._is_jpeg and b"\xff\xd9" not in data[-64:]:
            raise ImageError(f"{self.name}: the JPEG is cut off: its end is missing")

    def whole(self) -> NDArray[Any]:
        """Grey values (H, W), 8 or 16 bit.

        The orientation flag of EXIF is not obeyed: the sensor does not turn with it.
        """
        if self._is_jpeg:
            try:
                grey: NDArray[Any] = simplejpeg.decode_jpeg(self._data, colorspace="GRAY")[..., 0]
                return grey
            except ValueError:
                pass  # another colour space, or damage that OpenCV bears with or names
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(self._data, np.uint8), flags)
        except cv2.error as error:
            raise ImageError(
                f"{self.name}: is not an image that can be decoded ({error.err})"
            ) from error
        if image is None:
            raise ImageError(f"{self.name}: is not an image (JPEG, PNG and TIFF are read)")
        if image.dtype not in (np.uint8, np.uint16):
            raise ImageError(f"{self.name}: {image.dtype} grey values; 8 or 16 bit are read")
        return image

    def around(self, boxes: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
        """Grey values (H, W) that hold within boxes (n, 4) px (left, top, right, bottom).

        None where the file cannot be decoded in parts or has not the shape (H, W). The memory is
        used again by the next call in this thread.
        """
        if not self._is_jpeg or self._size is None or self._size[::-1] != tuple(shape):
            return None
        return decode_parts(self._data, boxes)


def decode_grey(source: Path | bytes) -> NDArray[Any]:
    """Grey values (H, W), 8 or 16 bit, of an image file or of encoded bytes.

    The orientation flag of EXIF is not obeyed: the sensor does not turn with it.
    Raises ImageError saying what is wrong with the file.
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
