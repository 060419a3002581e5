"""The arrays that functions take and give, by what they hold; shapes stand in each docstring."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Image", "Index", "Mask", "Single"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8] | NDArray[np.uint16]
