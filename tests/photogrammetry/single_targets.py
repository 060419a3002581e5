"""Single discs rendered by exact area coverage, with the Cramér-Rao bound of each centre.

The bound is computed from the derivatives of the exact images, and only the centre is unknown. It
shares nothing with the fitted model. An operator that estimates more parameters cannot quite reach
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

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

    Also their exact maps, and patches [(x, y, image)].
    """

    diameters: np.ndarray
    tilts: np.ndarray
    true: np.ndarray
    maps: LocalMap
    patches: list[tuple[int, int, np.ndarray]]

    def bound(self, noise_sd: float) -> np.ndarray:
        """Return the Cramér-Rao bounds (n, 2) px of x and y for white noise with rounding."""
        bounds = []
        for _, _, patch in self.patches:
            # blurred by 0.8 px, the image has hardly anything beyond the limit of its spectrum
            fy, fx = np.meshgrid(*(np.fft.fftfreq(n) for n in patch.shape), indexing="ij")
            spectra = 2j * np.pi * np.stack([fx, fy]) * np.fft.fft2(patch)
            g = np.fft.ifft2(spectra).real.reshape(2, -1)
            bounds.append(np.sqrt(np.diag(np.linalg.inv(g @ g.T))))
        return np.array(bounds) * np.sqrt(noise_sd**2 + QUANTISATION)

    def frame(self, rng: np.random.Generator, noise_sd: float) -> np.ndarray:
        """Return a full frame with noise in the patches."""
        image = np.full((PI_SENSOR.height, PI_SENSOR.width), round(PAPER), dtype=np.uint8)
        for x, y, patch in self.patches:
            image[y : y + len(patch), x : x + len(patch)] = noisy(patch, rng, noise_sd)
        return image


@cache
def single_targets(
    diameters=(12, 16, 20, 28, 40),
    tilts=(0, 30, 45, 60),
    blur=0.8,
    seed=1,
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
    points, normals, radii, true, patches = [], [], [], [], []
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
        scene = Scene(paper=PAPER, ink=ink)
        if bits:
            code = ring_code.codes(bits)[7 * k]
            scene.ring(centre, normal, size, bits, code, turn=0.37 * k % 1)
        else:
            scene.disc(centre, normal, size)
        patch = scene.render(PI_CAMERA, AT_ORIGIN, (x, y, side, side), blur, finer=8)
        patches.append((x, y, patch))
        points.append(centre)
        normals.append(normal)
        radii.append(size / 2)
        true.append(uv)
    maps = local_maps(
        PI_SENSOR, PI_CAMERA.interior.as_array(), AT_ORIGIN.as_array(),
        np.array(points), np.array(normals), np.array(radii),
    )  # fmt: skip
    d, t = np.array(cases, dtype=float).T
    return SingleTargets(d, t, np.array(true), maps, patches)
