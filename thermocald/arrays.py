"""Names of array types, rows that stand for all, and arrays that are used again.

The system gives fresh memory page by page, which for an 8 MP frame takes longer than the arithmetic
done in it. `scratch` is only for what does not leave the function that asked.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8] | NDArray[np.uint16]


_KEPT = threading.local()  # by name


def spread_rows(count: int, most: int) -> Index:
    """Return so many rows of `count` at most, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array with undefined contents; the thread's next call with this name reuses it."""
    kind = np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize
    buffer: NDArray[np.uint8] | None = getattr(_KEPT, name, None)
    if buffer is None or buffer.size < size:
        buffer = np.empty(size, dtype=np.uint8)
        setattr(_KEPT, name, buffer)
    return buffer[:size].view(kind).reshape(shape)
