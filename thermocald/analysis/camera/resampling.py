"""Images resampled from one interior orientation to another, by maps of `cv2.remap`.

Shifts are computed at nodes and interpolated between them: 1e-4 px from those of every pixel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.undistortion import ideal_points
from thermocald.photogrammetry.camera.camera_model import project

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.camera.camera import Camera
    from thermocald.arrays import Array

_RENEWED_PX = 0.05
_CELL = 8  # px between the nodes at which maps are computed
_CHECKED = 5  # points per row and column that say whether the maps still hold
_STRIP = 32 * _CELL  # rows whose maps are in memory at a time


class Maps:
    """Maps from a camera to a steady one; kept as long as they hold.

    to: °C of the steady camera.
    """

    def __init__(self, steady: Camera, to: float) -> None:
        self.to, self.sensor = to, steady.sensor
        width, height = self.sensor.width, self.sensor.height
        # one node beyond each edge, where `cv2.resize` puts it
        self._shape = (-(-height // _CELL) + 2, -(-width // _CELL) + 2)
        v, u = (_CELL * np.arange(n) - (_CELL + 1) / 2.0 for n in self._shape)
        self._nodes = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        self._directions = _directions(steady, self._nodes)
        u, v = np.linspace(0, width - 1, _CHECKED), np.linspace(0, height - 1, _CHECKED)
        points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        self._checked = _directions(steady, points)
        self._seen: Array | None = None
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    def of(self, values: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps x, y (H, W) px of a camera with some interior orientation (10,)."""
        seen = project(self.sensor, values, np.zeros(6), self._checked)
        far = math.inf if self._seen is None else float(np.abs(seen - self._seen).max())
        if self._maps is None or far > _RENEWED_PX / math.sqrt(2.0):
            self._seen = seen
            self._maps = self._rows(self._shifts(values), 0, self.sensor.height)
        return self._maps

    def resample(self, image: NDArray[Any], values: Array) -> NDArray[Any]:
        """Return an image (H, W) or (H, W, 3) of a camera (10,) as the steady one had seen it.

        Nothing is kept and little memory is taken; what the camera did not see is black.
        """
        import cv2

        shifts, out = self._shifts(values), np.empty_like(image)
        for top in range(0, self.sensor.height, _STRIP):
            bottom = min(top + _STRIP, self.sensor.height)
            cv2.remap(image, *self._rows(shifts, top, bottom), cv2.INTER_CUBIC, out[top:bottom])
        return out

    def _shifts(self, values: Array) -> NDArray[np.float32]:
        """At the nodes, px."""
        moved = project(self.sensor, values, np.zeros(6), self._directions) - self._nodes
        shifts: NDArray[np.float32] = moved.astype(np.float32).reshape(*self._shape, 2)
        return shifts

    def _rows(
        self, shifts: NDArray[np.float32], top: int, bottom: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The maps of some rows; top: a multiple of the nodes' distance."""
        import cv2

        part = shifts[top // _CELL : -(-bottom // _CELL) + 2]
        rows, columns = part.shape[:2]
        large = cv2.resize(part, (columns * _CELL, rows * _CELL), interpolation=cv2.INTER_LINEAR)[
            _CELL : _CELL + bottom - top, _CELL : _CELL + self.sensor.width
        ]
        u = np.arange(self.sensor.width, dtype=np.float32)
        v = np.arange(top, bottom, dtype=np.float32)
        return large[..., 0] + u, large[..., 1] + v[:, None]


def _directions(camera: Camera, points: Array) -> Array:
    ideal = ideal_points(camera.sensor, camera.values, points)
    return np.concatenate([ideal, np.full((len(ideal), 1), -1.0)], axis=1)
