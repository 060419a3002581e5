"""Frames rendered by exact area coverage, to test target measurements against.

Shares no code with `thermocald.physics`. A shape is a polygon whose vertices are projected with the
full camera model. The area that it covers of each sub-pixel is computed exactly (Green's theorem,
segments split at the grid lines); the sub-pixel image is blurred with a sampled Gaussian and
averaged over the pixels. The only approximations are the outline by its vertices (720 of them: a
sagitta of 1e-5 of the radius) and the blur by samples 1/`finer` px apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from thermocald.photogrammetry.camera.camera_model import CameraModel, ExteriorOrientation
from thermocald.photogrammetry.targets import ring_code

VERTICES = 720


def coverage(polygon: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the area (height, width) of each cell that a polygon (n, 2) covers.

    Cell (0, 0) is [0, 1]². The result is positive for either orientation of the polygon. Parts
    outside the grid are left out in y and clamped to the border in x.
    """
    a = np.asarray(polygon, dtype=float)
    b = np.roll(a, -1, axis=0)
    # Cut long edges so that none crosses more than one grid line in each direction
    pieces = np.maximum(np.ceil(np.abs(b - a).max(axis=1)).astype(int), 1)
    which = np.repeat(np.arange(len(a)), pieces)
    k = np.arange(len(which)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    t0, t1 = (k / pieces[which])[:, None], ((k + 1) / pieces[which])[:, None]
    d = (b - a)[which]
    p, q = a[which] + t0 * d, a[which] + t1 * d
    cuts = np.zeros((len(p), 4))
    cuts[:, 3] = 1.0
    for axis in (0, 1):
        line = np.maximum(np.floor(p[:, axis]), np.floor(q[:, axis]))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (line - p[:, axis]) / (q[:, axis] - p[:, axis])
        cuts[:, 1 + axis] = np.where((t > 0) & (t < 1), t, 0.0)
    cuts.sort(axis=1)
    out = np.zeros((height, width + 1))
    for i in range(3):
        s = p + cuts[:, i, None] * (q - p)
        e = p + cuts[:, i + 1, None] * (q - p)
        dy = e[:, 1] - s[:, 1]
        x, y = (s[:, 0] + e[:, 0]) / 2, (s[:, 1] + e[:, 1]) / 2
        row = np.floor(y).astype(int)
        x = np.clip(x, 0, width - 1e-9)
        column = np.floor(x).astype(int)
        ok = (row >= 0) & (row < height) & (dy != 0)
        share = 1 - (x - column)
        np.add.at(out, (row[ok], column[ok]), (dy * share)[ok])
        np.add.at(out, (row[ok], column[ok] + 1), (dy * (1 - share))[ok])
    area = np.cumsum(out, axis=1)[:, :width]
    return np.abs(area)


@dataclass
class Scene:
    """Shapes in object space, drawn in `ink` on `paper` (DN).

    shapes: polygons (n, 3) mm; light: relative change of the light per px in x and y.
    """

    shapes: list[np.ndarray] = field(default_factory=list)
    paper: float = 190.0
    ink: float = 40.0
    light: tuple[float, float] = (0.0, 0.0)

    def disc(self, centre, normal, diameter) -> None:
        e1, e2 = plane_axes(normal)
        t = np.linspace(0, 2 * np.pi, VERTICES, endpoint=False)[:, None]
        self.shapes.append(centre + diameter / 2 * (np.cos(t) * e1 + np.sin(t) * e2))

    def ring(self, centre, normal, diameter, bits, number, turn=0.0) -> None:
        """Add a coded target, rotated in its plane by `turn` turns."""
        self.disc(centre, normal, diameter)
        e1, e2 = plane_axes(normal)
        for begin, end in ring_code.segments(bits, number):
            # Clockwise for the viewer, at whom the normal points: from e1 to -e2
            t = -2 * np.pi * (np.linspace(begin, end, VERTICES // 3) + turn)[:, None]
            arc = np.cos(t) * e1 + np.sin(t) * e2
            band = np.vstack([ring_code.RING_INNER * arc, ring_code.RING_OUTER * arc[::-1]])
            self.shapes.append(centre + diameter / 2 * band)

    def patch(self, corners) -> None:
        """Add a polygon (n, 3) mm, its edges subdivided so that distortion bends them."""
        c = np.asarray(corners, dtype=float)
        t = np.linspace(0, 1, 200, endpoint=False)[:, None]
        self.shapes.append(np.vstack([c[i - 1] * (1 - t) + c[i] * t for i in range(len(c))]))

    def render(
        self,
        camera: CameraModel,
        exterior: ExteriorOrientation,
        window: tuple[int, int, int, int] | None = None,
        blur: float = 0.8,
        finer: int = 3,
    ) -> np.ndarray:
        """Return noise-free grey values (h, w) of the frame or of a window (x, y, w, h).

        Blur and pixel average are linear, so each shape is drawn, blurred, and added separately.
        """
        x0, y0, w, h = window or (0, 0, camera.sensor.width, camera.sensor.height)
        cx, cy = camera.sensor.centre

        def light(u, v):
            return 1 + self.light[0] * (u - cx)[None, :] + self.light[1] * (v - cy)[:, None]

        image = self.paper * light(np.arange(x0, x0 + w), np.arange(y0, y0 + h))
        margin = int(np.ceil(6 * blur)) + 1
        size = 2 * int(np.ceil(6 * blur * finer)) + 1
        for shape in self.shapes:
            points = camera.project(exterior, shape)
            if not np.isfinite(points).all():
                continue
            low = np.floor(points.min(axis=0) + 0.5).astype(int) - margin
            top = np.ceil(points.max(axis=0) + 0.5).astype(int) + margin
            low, top = np.maximum(low, (x0, y0)), np.minimum(top, (x0 + w, y0 + h))
            if np.any(top <= low):
                continue
            # The patch has a margin of its own, so that its edge is also right
            px, py = low - margin
            wide, high = (top - low + 2 * margin) * finer
            part = coverage((points + 0.5 - (px, py)) * finer, wide, high)
            part *= self.ink - self.paper
            if any(self.light):
                u = (np.arange(wide) + 0.5) / finer + px - 0.5
                v = (np.arange(high) + 0.5) / finer + py - 0.5
                part *= light(u, v)
            if blur > 0:
                part = cv2.GaussianBlur(part, (size, size), blur * finer)
            mean = part.reshape(high // finer, finer, wide // finer, finer).mean(axis=(1, 3))
            mean = mean[margin:-margin, margin:-margin]
            image[low[1] - y0 : top[1] - y0, low[0] - x0 : top[0] - x0] += mean
        return image


def plane_axes(normal) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that form a right-handed frame with the normal."""
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    helper = np.eye(3)[np.argmin(np.abs(n))]
    e1 = np.cross(helper, n)
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(n, e1)


def noisy(image: np.ndarray, rng: np.random.Generator, sd: float = 2.0) -> np.ndarray:
    """Add white noise of `sd` DN and round to 8 bit."""
    return np.clip(np.rint(image + rng.normal(0, sd, image.shape)), 0, 255).astype(np.uint8)


def rms(values, axis=None):
    return np.sqrt(np.mean(np.square(values), axis=axis))


def look_at(
    centre, target, roll: float = 0.0, up=(0.0, 0.0, 1.0), else_up=(0.0, 1.0, 0.0), nearly=0.99
) -> ExteriorOrientation:
    """Return the orientation of a camera at `centre` that looks at `target`, with roll in rad.

    `up` is up in the image; `else_up` if the view is nearly along `up` (cosine above `nearly`).
    """
    z = np.asarray(centre, dtype=float) - target
    z /= np.linalg.norm(z)
    x = np.cross(up if abs(np.dot(up, z)) < nearly else else_up, z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return ExteriorOrientation.from_rotation(
        np.column_stack([c * x + s * y, -s * x + c * y, z]), centre
    )
