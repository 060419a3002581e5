"""Single discs rendered by exact area coverage, with the Cramér-Rao bound of each centre.

The bound is computed from the exact images: each disc is rendered with shifts of ±0.05 px for the
derivatives, and only its centre is unknown. It shares nothing with the fitted model. An operator
that estimates more parameters cannot quite reach it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from tests.photogrammetry.exact_rendering import Scene, noisy
from tests.photogrammetry.fields import PI_CAMERA, PI_SENSOR
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.outline import LocalMap, local_maps

AT_ORIGIN = ExteriorOrientation(0, 0, 0, 0, 0, 0)
PAPER, INK = 190.0, 40.0
SIZE = 84
SIZE_WITH_RING = 124
QUANTISATION = 1 / 12


@dataclass
class SingleTargets:
    """n discs: nominal diameters (n,) px and tilts (n,) deg, and true projected centres (n, 2).

    Also their exact maps, patches [(x, y, image)], and functions that draw the gradients of each
    patch (2, h, w) DN/px, which only the bound needs.
    """

    diameters: np.ndarray
    tilts: np.ndarray
    true: np.ndarray
    maps: LocalMap
    patches: list[tuple[int, int, np.ndarray]]
    gradient_makers: list[Callable[[], np.ndarray]]

    @cached_property
    def gradients(self) -> list[np.ndarray]:
        return [make() for make in self.gradient_makers]

    def bound(self, noise_sd: float) -> np.ndarray:
        """Return the Cramér-Rao bounds (n, 2) px of x and y for white noise with rounding."""
        variance = noise_sd**2 + QUANTISATION
        bounds = []
        for g in self.gradients:
            flat = g.reshape(2, -1)
            bounds.append(np.sqrt(np.diag(np.linalg.inv(flat @ flat.T) * variance)))
        return np.array(bounds)

    def frame(self, rng: np.random.Generator | None, noise_sd: float) -> np.ndarray:
        """Return a full frame with noise in the patches; without `rng`, only rounded."""
        image = np.full((PI_SENSOR.height, PI_SENSOR.width), round(PAPER), dtype=np.uint8)
        for x, y, patch in self.patches:
            value = np.rint(patch).astype(np.uint8) if rng is None else noisy(patch, rng, noise_sd)
            image[y : y + len(patch), x : x + len(patch)] = value
        return image


@cache
def single_targets(
    diameters=(12, 16, 20, 28, 40),
    tilts=(0, 30, 45, 60),
    blur=0.8,
    seed=1,
    light=(0.0, 0.0),
    bits=0,
    ink=INK,
) -> SingleTargets:
    """Draw discs on a raster over the Pi camera's frame, each tilted about a random axis.

    The result is cached; tests do not change it.
    bits: of a code ring (diameters up to 30 px), 0 for none; ink: DN of the discs on PAPER.
    """
    rng = np.random.default_rng(seed)
    cases = [(d, t) for d in diameters for t in tilts]
    columns = int(np.ceil(np.sqrt(len(cases) * 1.33)))
    rows = int(np.ceil(len(cases) / columns))
    xs = np.linspace(150, PI_SENSOR.width - 150, columns)
    ys = np.linspace(150, PI_SENSOR.height - 150, rows)
    scale = PI_CAMERA.interior.c / PI_SENSOR.pixel_pitch
    points, normals, radii, true, patches, gradients = [], [], [], [], [], []
    for k, (diameter, tilt) in enumerate(cases):
        at = np.array([xs[k % columns], ys[k // columns]]) + rng.uniform(-9, 9, 2)
        ray = PI_CAMERA.rays(at[None])[0]
        centre = ray * 1000 / -ray[2]
        axis = np.cross(ray, rng.normal(size=3))
        axis /= np.linalg.norm(axis)
        angle = np.radians(tilt)
        normal = -ray * np.cos(angle) + np.cross(axis, -ray) * np.sin(angle)
        size = diameter * np.linalg.norm(centre) / scale
        uv = PI_CAMERA.project(AT_ORIGIN, centre[None])[0]
        side = SIZE_WITH_RING if bits else SIZE
        x, y = np.rint(uv - side / 2).astype(int)

        def draw(c, normal=normal, size=size, window=(x, y, side, side), ring=k):
            scene = Scene(paper=PAPER, ink=ink, light=light)
            if bits:
                code = ring_code.codes(bits)[7 * ring]
                scene.ring(c, normal, size, bits, code, turn=0.37 * ring % 1)
            else:
                scene.disc(c, normal, size)
            return scene.render(PI_CAMERA, AT_ORIGIN, window, blur, finer=8)

        def gradient(centre=centre, draw=draw):
            # ±0.05 px in the image, moved in object space parallel to the image plane
            moves, by = [], []
            for e in np.eye(3)[:2] * 0.05 / scale * 1000:
                a, b = (PI_CAMERA.project(AT_ORIGIN, (centre + s * e)[None])[0] for s in (1, -1))
                moves.append(draw(centre + e) - draw(centre - e))
                by.append(a - b)
            return np.tensordot(np.linalg.inv(by), moves, axes=1)

        gradients.append(gradient)
        points.append(centre)
        normals.append(normal)
        radii.append(size / 2)
        true.append(uv)
        patches.append((x, y, draw(centre)))
    maps = local_maps(
        PI_SENSOR, PI_CAMERA.interior.as_array(), AT_ORIGIN.as_array(),
        np.array(points), np.array(normals), np.array(radii),
    )  # fmt: skip
    d, t = np.array(cases, dtype=float).T
    return SingleTargets(d, t, np.array(true), maps, patches, gradients)
