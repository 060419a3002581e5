"""Names of array types, times in seconds, evenly spread rows, and reused buffers.

The system provides fresh memory page by page, which for an 8 MP frame takes longer than the
arithmetic on it. A `scratch` array must not leave the function that asked for it.
"""

from __future__ import annotations

import threading
import warnings
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
    """Return times in s; datetime64, datetimes and pandas times count from 1970-01-01 UTC.

    Raises UsageError for anything else, and for a time that is unknown (NaN, NaT, masked).
    """
    given = np.asarray(times)
    try:
        if given.dtype == object and given.size and not isinstance(given.flat[0], float | int):
            with warnings.catch_warnings():  # numpy warns that it converts a zone to UTC
                warnings.simplefilter("ignore")
                given = given.astype("datetime64[us]")
        if given.dtype.kind == "M":
            given = given - np.datetime64(0, "s")
        if given.dtype.kind == "m":
            given = given / np.timedelta64(1, "s")
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    if not np.isfinite(found).all() or np.ma.is_masked(times):
        raise UsageError("a time is not known: give seconds since 1970-01-01 UTC, or datetime64")
    return found


def floats(values: ArrayLike) -> Array:
    """Return values as numbers, NaN where they are masked.

    Raises TypeError or ValueError for what is no number.
    """
    return np.asarray(np.ma.asarray(values, dtype=float).filled(np.nan))


def spread_rows(count: int, most: int) -> Index:
    """Return at most `most` of `count` rows, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def eight_bit(image: NDArray[Any], like: NDArray[Any] | None = None) -> NDArray[np.uint8]:
    """Return 8-bit values of an image of 8 or 16 bit.

    like: an image of the camera whose largest value shows how many of the 16 bits are used.
    """
    if image.dtype == np.uint8:
        return image
    used = 16 if like is None else max(int(like.max()).bit_length(), 8)
    small: NDArray[np.uint8] = np.minimum(image >> (used - 8), 255).astype(np.uint8)
    return small


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array with undefined contents; the thread's next call with this name reuses it."""
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    buffer: NDArray[np.uint8] | None = getattr(_buffers, name, None)
    if buffer is None or buffer.size < size:
        buffer = np.empty(size, dtype=np.uint8)
        setattr(_buffers, name, buffer)
    return buffer[:size].view(kind).reshape(shape)
