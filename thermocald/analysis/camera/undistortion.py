"""Undistortion of many image points of one camera, and resampling of images to another camera.

`camera_model.rays` is exact for any point and any number of cameras. For a million points of one
camera this module is several times faster and as exact: a polynomial inverts the radial distortion
so well that a few Newton steps are enough, in blocks that stay in the processor's cache. Blocks
that do not converge to 1e-9 px are passed to `rays`, which raises an error if there is no solution.

Images are resampled from one interior orientation to another with maps for `cv2.remap`, whose
shifts are computed at nodes and interpolated: within 1e-4 px of those computed for every pixel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    Sensor,
    distort,
    distortion_jacobian,
    image_to_mm,
    project,
    rays,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask


def image_grid(sensor: Sensor, size: int = 3) -> Array:
    """Return image points (size², 2) px from corner to corner, row by row from the top."""
    x = np.linspace(0.0, sensor.width - 1.0, size)
    y = np.linspace(0.0, sensor.height - 1.0, size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


_BLOCK = 8192
_DEGREE = 6
_STEP_PX = 1e-9  # the last step; what is left is no larger, even if the steps shrink slowly
_STEPS = 30


def ideal_points(
    sensor: Sensor, iop: ArrayLike, image_points: ArrayLike,
    scale: tuple[float, float] = (1.0, 1.0), shift: tuple[float, float] = (0.0, 0.0),
) -> Array:  # fmt: skip
    """Return x̄/c, ȳ/c (n, 2) of image points (n, 2) px, multiplied by `scale` and shifted.

    They are the tangents of the angles to the optical axis. Raises GeometryError for points beyond
    the radius at which the distortion folds back.
    """
    i, points = np.asarray(iop, dtype=float), np.atleast_2d(np.asarray(image_points, dtype=float))
    out, inverse = np.empty_like(points), _inverse_radial(sensor, i)
    for first in range(0, len(points), _BLOCK):
        part = slice(first, first + _BLOCK)
        solved = False
        if inverse is not None:
            measured = np.ascontiguousarray(image_to_mm(sensor, points[part]).T)
            ideal = measured - i[1:3, None]
            ideal *= np.polyval(inverse, ideal[0] ** 2 + ideal[1] ** 2)
            solved = bool(solve_distortion(i, measured, ideal, _STEP_PX * sensor.pixel_pitch).all())
            ideal /= i[0]
        if not solved:
            r = rays(sensor, i, points[part]).T
            ideal = r[:2] / -r[2]
        for k in range(2):
            np.add(ideal[k] * scale[k], shift[k], out=out[part, k])
    return out


# a camera that folds the image may diverge; it has no rays
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def solve_distortion(iop: Array, measured: Array, ideal: Array, tolerance: float) -> Mask:
    """Replace approximate ideal points (2, ..., n) mm by those of measured points (2, ..., n).

    iop (..., 10), as `distort` takes it. Newton's method with the Jacobian of the start, until all
    steps are below `tolerance`, mm. Returns which points (..., n) have a solution.
    """
    (xm, ym), (x, y) = measured, ideal
    jxx, jxy, jyx, jyy = distortion_jacobian(iop, x, y)
    inverse = 1.0 / (jxx * jyy - jxy * jyx)
    solved: Mask = inverse > 0
    jxx, jxy, jyx, jyy = (a * inverse for a in (jyy, jxy, jyx, jxx))
    for _ in range(_STEPS):
        rx, ry = distort(iop, x, y)
        rx -= xm
        ry -= ym
        dx, dy = jxx * rx - jxy * ry, jyy * ry - jyx * rx
        x -= dx
        y -= dy
        if max(dx.max(), -dx.min(), dy.max(), -dy.min()) <= tolerance:
            return solved
    return np.asarray(solved & (np.fmax(np.abs(dx), np.abs(dy)) <= tolerance))


def directions(sensor: Sensor, iop: ArrayLike, image_points: ArrayLike) -> Array:
    """Return the directions (n, 3) of image points (n, 2) px in the camera frame, with z = -1."""
    ideal = ideal_points(sensor, iop, image_points)
    return np.column_stack([ideal, np.full(len(ideal), -1.0)])


def _inverse_radial(sensor: Sensor, i: Array) -> Array | None:
    """Return coefficients of r̄/r = 1 + a₁ r² + …, highest first; None if the distortion folds."""
    corner = np.hypot(sensor.width, sensor.height) * sensor.pixel_pitch / 2
    r = np.linspace(0.0, 1.1 * corner, 80)[1:]
    r2 = r * r
    slope = 1 + r2 * (3 * i[3] + r2 * (5 * i[4] + r2 * 7 * i[5]))
    if np.any(slope <= 0.1):
        return None
    distorted = r * (1 + r2 * (i[3] + r2 * (i[4] + r2 * i[5])))
    powers = (distorted[:, None] / corner) ** (2 * np.arange(1, _DEGREE + 1))
    found = np.linalg.lstsq(powers, r / distorted - 1, rcond=None)[0]
    scaled: Array = found / corner ** (2 * np.arange(1, _DEGREE + 1))
    return np.append(scaled[::-1], 1.0)


_RENEWED_PX = 0.05
_CELL = 8  # px between the nodes at which maps are computed
_CHECKED = 5  # points per row and column at which the validity of maps is checked
_STRIP = 32 * _CELL  # rows whose maps are in memory at a time


class Maps:
    """Maps from a camera to a steady one, reused as long as they are valid.

    steady (10,): interior orientation of the steady camera, at `to` °C.
    """

    def __init__(self, sensor: Sensor, steady: Array, to: float) -> None:
        self.to, self.sensor = to, sensor
        # one node beyond each edge, where `cv2.resize` puts it
        self._shape = (-(-sensor.height // _CELL) + 2, -(-sensor.width // _CELL) + 2)
        v, u = (_CELL * np.arange(n) - (_CELL + 1) / 2.0 for n in self._shape)
        self._nodes = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        self._directions = directions(sensor, steady, self._nodes)
        self._checked = directions(sensor, steady, image_grid(sensor, _CHECKED))
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
        """Resample an image (H, W) or (H, W, 3) of a camera (10,) to the steady camera.

        No map is stored, and little memory is used; what the camera did not see is black.
        """
        import cv2

        shifts, out = self._shifts(values), np.empty_like(image)
        for top in range(0, self.sensor.height, _STRIP):
            bottom = min(top + _STRIP, self.sensor.height)
            cv2.remap(image, *self._rows(shifts, top, bottom), cv2.INTER_CUBIC, out[top:bottom])
        return out

    def _shifts(self, values: Array) -> NDArray[np.float32]:
        """Return the shifts at the nodes, px."""
        moved = project(self.sensor, values, np.zeros(6), self._directions) - self._nodes
        shifts: NDArray[np.float32] = moved.astype(np.float32).reshape(*self._shape, 2)
        return shifts

    def _rows(
        self, shifts: NDArray[np.float32], top: int, bottom: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps of some rows; top: a multiple of the nodes' distance."""
        import cv2

        part = shifts[top // _CELL : -(-bottom // _CELL) + 2]
        rows, columns = part.shape[:2]
        large = cv2.resize(part, (columns * _CELL, rows * _CELL), interpolation=cv2.INTER_LINEAR)[
            _CELL : _CELL + bottom - top, _CELL : _CELL + self.sensor.width
        ]
        u = np.arange(self.sensor.width, dtype=np.float32)
        v = np.arange(top, bottom, dtype=np.float32)
        return large[..., 0] + u, large[..., 1] + v[:, None]
