"""Names of array types, times in seconds, evenly spread rows, and reused buffers.

The system provides fresh memory page by page, which for an 8 MP frame takes longer than the
arithmetic on it. A `scratch` array must not leave the function that asked for it.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8] | NDArray[np.uint16]


_buffers = threading.local()  # by name


def seconds(times: ArrayLike) -> Array:
    """Return times in s; datetime64 and pandas times count from 1970-01-01 UTC."""
    given = np.asarray(times)
    if np.issubdtype(given.dtype, np.datetime64):
        given = given.astype("datetime64[us]").astype(np.int64) * 1e-6
    return np.asarray(given, dtype=float)


def spread_rows(count: int, most: int) -> Index:
    """Return at most `most` of `count` rows, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array with undefined contents; the thread's next call with this name reuses it."""
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    buffer: NDArray[np.uint8] | None = getattr(_buffers, name, None)
    if buffer is None or buffer.size < size:
        buffer = np.empty(size, dtype=np.uint8)
        setattr(_buffers, name, buffer)
    return buffer[:size].view(kind).reshape(shape)
