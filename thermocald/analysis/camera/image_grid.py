"""The grid of image points at which errors are reported: corners, edges, and between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor


def image_grid(sensor: Sensor, size: int = 3) -> Array:
    """Image points (size², 2) px from corner to corner, row by row from the top."""
    x = np.linspace(0.0, sensor.width - 1.0, size)
    y = np.linspace(0.0, sensor.height - 1.0, size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
