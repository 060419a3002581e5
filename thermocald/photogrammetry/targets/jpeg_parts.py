"""Only the parts of a JPEG that are looked at: the grey values of the whole image in less time.

The bits of a JPEG can be read only from its start. Restart markers, which many phones and some
webcams write, divide it into segments that can be read alone: those around the targets are joined
to a smaller JPEG, which any decoder reads. Without them decoding stops after the last row that is
needed. The grey values are exactly those of the whole image, since every block of 8 × 8 px is
transformed by itself and the luminance is not interpolated.

Source: ITU-T Recommendation T.81, B.2 (markers and headers) and A.2 (order of the blocks).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import simplejpeg

from thermocald.photogrammetry.targets.scratch import scratch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Boxes = NDArray[np.int64]
    Grey = NDArray[np.uint8]

__all__ = ["decode_parts"]

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
