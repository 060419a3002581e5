"""Rendered frames: what a camera sees of a test field, in grey values.

The outline of every target is projected with its distortion, filled by exact area coverage, blurred
by a Gaussian on the pixel grid, darkened towards the corners, given noise, and rounded to 8 bit.

A frame is the same on every machine, bit for bit: positions, coverage and blur are made of IEEE
operations alone (`portable`), the noise comes from PCG64's raw bits through integer tables, and the
rest is fixed-point with 6 fractional bits, always odd, so that nothing is ever half-way.

Source: blur, vignetting and noise as in Luhmann, T. et al. (2014): Close-Range Photogrammetry and
3D Imaging, 2nd ed., chapter 3; vignetting is the first term of the cos⁴ law.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.simulation.portable import gaussian_kernel, project
from thermocald.simulation.raster import blur, coverage, windows_around
from thermocald.simulation.shapes import Outlines, outlines, surface_normals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["Look", "Scene"]

_FRACTION = 64  # fixed-point steps per DN


@dataclass(frozen=True, slots=True)
class Look:
    """Grey values and optics: paper and ink DN, blur (Gaussian sigma) px, noise sigma DN, and the
    share of light that the image corners lose.
    """

    paper_dn: float = 200.0
    ink_dn: float = 30.0
    blur_px: float = 0.8
    noise_dn: float = 2.0
    vignetting: float = 0.15


@lru_cache(maxsize=2)
def _gain(sensor: Sensor, vignetting: float) -> NDArray[np.float32]:
    """The share of light (H, W) that arrives: 1 - v (r / r_corner)²."""
    cx, cy = (sensor.width - 1) / 2, (sensor.height - 1) / 2
    x2 = (np.arange(sensor.width) - cx) ** 2
    y2 = (np.arange(sensor.height) - cy) ** 2
    share = vignetting / (cx * cx + cy * cy)
    return (1.0 - share * (y2[:, None] + x2[None, :])).astype(np.float32)


@lru_cache(maxsize=2)
def _paper(sensor: Sensor, paper_dn: float, vignetting: float) -> NDArray[np.int16]:
    """The empty scene in fixed point, even numbers."""
    half = np.float32(paper_dn * _FRACTION / 2)
    fixed: NDArray[np.int16] = np.rint(_gain(sensor, vignetting) * half).astype(np.int16)
    return fixed + fixed


@lru_cache(maxsize=8)
def _noise_tables(sigma_dn: float) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Two tables (256,) whose sum over two random bytes is normal with this sigma, and odd."""
    from scipy.special import ndtri

    quantiles = ndtri((np.arange(256) + 0.5) / 256)
    quantiles *= sigma_dn * _FRACTION / np.sqrt(2.0) / float(np.std(quantiles))
    even = 2 * np.rint(quantiles / 2).astype(np.int16)
    # symmetric about 0 in steps of 2: half a step above, half below
    odd = 2 * np.floor(quantiles / 2).astype(np.int16) + 1
    return even, odd


class Scene:
    """A test field to be photographed; keeps what does not change between frames."""

    def __init__(self, sensor: Sensor, field: TestField, look: Look | None = None) -> None:
        self.sensor = sensor
        self.field = field
        self.look = look or Look()
        self._normals = surface_normals(field)
        self._facing = np.zeros(len(field), dtype=bool)
        self._outlines: Outlines | None = None

    def _shapes(self, centre: Array) -> Outlines:
        """The outlines as seen from a point (3,) mm: its side decides which way ring codes run."""
        facing = np.sum(self._normals * (centre - self.field.points), axis=1) > 0
        if self._outlines is None or not np.array_equal(facing, self._facing):
            self._facing = facing
            normals = np.where(facing[:, None], self._normals, -self._normals)
            self._outlines = outlines(self.field, normals)
        return self._outlines

    def render(
        self,
        iop: Array,
        eop: Array,
        points: Array | None = None,
        seed: int | Sequence[int] = 0,
        blur_factor: float = 1.0,
    ) -> NDArray[np.uint8]:
        """A frame (H, W) 8 bit.

        iop (10,), eop (6,); points (n, 3) mm: where the targets are now (default: the field's);
        seed: of the noise; blur_factor: how much the blur has grown.
        """
        # what comes from outside may differ in its last bits; what is rounded away is below 1e-5 px
        iop, eop = np.round(iop, 10), np.concatenate([np.round(eop[:3], 10), np.round(eop[3:], 6)])
        where = self.field.points if points is None else np.round(points, 6)
        look = self.look
        canvas = _paper(self.sensor, look.paper_dn, look.vignetting).copy()
        self._draw(canvas, iop, eop, where, blur_factor)
        if look.noise_dn > 0:
            even, odd = _noise_tables(look.noise_dn)
            size = canvas.size
            raw = np.random.PCG64(seed).random_raw(-(-2 * size // 8)).astype("<u8", copy=False)
            random_bytes = raw.view(np.uint8)[: 2 * size].reshape(2, *canvas.shape)
            first, second = cv2.LUT(random_bytes[0], even), cv2.LUT(random_bytes[1], odd)
            cv2.add(first, second, dst=first)
            noisy = cv2.addWeighted(canvas, 1 / _FRACTION, first, 1 / _FRACTION, 0, dtype=cv2.CV_8U)
        else:
            canvas += 1
            noisy = cv2.addWeighted(canvas, 1 / _FRACTION, canvas, 0.0, 0, dtype=cv2.CV_8U)
        return np.asarray(noisy, dtype=np.uint8)

    def _draw(
        self, canvas: NDArray[np.int16], iop: Array, eop: Array, points: Array, blur_factor: float
    ) -> None:
        shapes = self._shapes(eop[3:6])
        if not len(shapes.centre):
            return
        image = project(self.sensor, iop, eop, shapes.vertices(points))
        count = len(shapes.centre)
        begins = np.flatnonzero(np.diff(shapes.shape, prepend=-1))
        low = np.minimum.reduceat(image, begins)
        high = np.maximum.reduceat(image, begins)
        towards = eop[3:6] - points[shapes.centre]
        seen = np.sum(towards * shapes.normal, axis=1) > 0
        with np.errstate(invalid="ignore"):
            edge = np.array([self.sensor.width, self.sensor.height])
            seen &= np.all((high > -0.5) & (low < edge - 0.5), axis=1)
            # a shape far larger than the image would need a window to match: it is behind or beside
            seen &= np.all(high - low < edge, axis=1)
        if not seen.any():
            return
        rank = np.cumsum(seen) - 1
        edges = seen[shapes.shape]
        a, b = image[edges], image[shapes.following[edges]]
        member = rank[shapes.shape[edges]]
        sign = shapes.sign[edges]
        kernel = gaussian_kernel(self.look.blur_px * blur_factor)
        margin = len(kernel) // 2
        depth = np.float32((self.look.paper_dn - self.look.ink_dn) * _FRACTION / 2)
        gain = _gain(self.sensor, self.look.vignetting)
        place = np.empty(count, dtype=np.int64)
        for windows in windows_around(low[seen], high[seen], margin):
            place[:] = -1
            place[windows.members] = np.arange(len(windows.members))
            mine = place[member] >= 0
            stack = coverage(a[mine], b[mine], sign[mine], place[member[mine]], windows)
            stack = blur(stack, kernel)
            for k in range(len(windows.members)):
                self._paste(canvas, gain, stack, depth, windows.row[k], windows.height[k],
                            windows.left[k], windows.top[k], windows.width)  # fmt: skip

    def _paste(
        self,
        canvas: NDArray[np.int16],
        gain: NDArray[np.float32],
        stack: NDArray[np.float32],
        depth: np.float32,
        row: int,
        height: int,
        left: int,
        top: int,
        width: int,
    ) -> None:
        """Take the ink of one window off the canvas."""
        y0, y1 = max(0, top), min(self.sensor.height, top + height)
        x0, x1 = max(0, left), min(self.sensor.width, left + width)
        if y0 >= y1 or x0 >= x1:
            return
        ink = stack[row + y0 - top : row + y1 - top, x0 - left : x1 - left]
        taken = np.rint(ink * gain[y0:y1, x0:x1] * depth).astype(np.int16)
        canvas[y0:y1, x0:x1] -= taken + taken
