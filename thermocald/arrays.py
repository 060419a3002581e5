"""Names of array types, times in seconds, evenly spread rows, and reused buffers.

The system provides fresh memory page by page, which for an 8 MP frame takes longer than the
arithmetic on it. A `scratch` array must not leave the function that asked for it.
"""

from __future__ import annotations

import threading
import warnings
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from thermocald.errors import UsageError

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8] | NDArray[np.uint16]


_buffers = threading.local()  # by name


def seconds(times: ArrayLike) -> Array:
    """Return times in s; datetime64, datetimes, pandas times and ISO text from 1970-01-01 UTC.

    Without a zone they are UTC. Raises UsageError for anything else, and for a time that is unknown
    (NaN, NaT, masked).
    """
    given = np.asarray(times)
    try:
        if given.dtype.kind in "OU" and given.size and not isinstance(given.flat[0], float | int):
            parsed = [datetime.fromisoformat(t) if isinstance(t, str) else t for t in given.flat]
            with warnings.catch_warnings():  # numpy warns that it converts a zone to UTC
                warnings.simplefilter("ignore")
                given = np.array(parsed, object).astype("datetime64[us]").reshape(given.shape)
        if given.dtype.kind == "M":
            given = given - np.datetime64(0, "s")
        if given.dtype.kind == "m":
            given = given / np.timedelta64(1, "s")
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    if not np.isfinite(found).all() or np.ma.is_masked(times):
        raise UsageError("a time is not known: give s since 1970-01-01 UTC, datetime64, ISO text")
    return found


def floats(values: ArrayLike) -> Array:
    """Return values as numbers, NaN where they are masked.

    Raises TypeError or ValueError for what is no number.
    """
    return np.asarray(np.ma.asarray(values, dtype=float).filled(np.nan))


def spread_rows(count: int, most: int) -> Index:
    """Return at most `most` of `count` rows, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def full_scale(image: NDArray[Any]) -> int:
    """Return the grey value at which a sensor saturates, of an image of 8 or 16 bit.

    A sensor of 10, 12 or 14 bit has its values at the lower or the upper end of 16 bit.
    """
    if image.dtype == np.uint8:
        return 255
    brightest = int(image.max())
    if brightest >> 8 == 255:
        return brightest
    return next((1 << bits) - 1 for bits in (8, 10, 12, 14, 16) if brightest >> bits == 0)


def eight_bit(image: NDArray[Any], brightest: int = 0) -> NDArray[np.uint8]:
    """Return 8-bit values of an image of 8 or 16 bit; brightest: of 16 bit, becomes 255.

    By default it is the brightest of areas of 5 × 5 px, as a hot pixel must not darken the image.
    """
    if image.dtype == np.uint8:
        return image
    import cv2

    brightest = max(brightest or int(np.max(cv2.erode(image, np.ones((5, 5), np.uint8)))), 1)
    return cv2.convertScaleAbs(image, alpha=255.0 / brightest)  # type: ignore[return-value]


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array with undefined contents; the thread's next call with this name reuses it."""
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    buffer: NDArray[np.uint8] | None = getattr(_buffers, name, None)
    if buffer is None or buffer.size < size:
        buffer = np.empty(size, dtype=np.uint8)
        setattr(_buffers, name, buffer)
    return buffer[:size].view(kind).reshape(shape)
