"""How a flat round target maps into the image: the projected outline, distortion and all.

The map takes the unit disc in the target's plane to pixels and is a polynomial of second order
about the projected centre, F(q) = c + J q + ½ H[q, q] with q = (s, t). J makes the ellipse; H holds
what makes the centre of the outline another point than the projected centre: the perspective's
foreshortening and the bend of the distortion across the target. Terms of third order are odd, they
change the outline symmetrically and move no centre.

Source: the eccentricity as Luhmann, T. (2014): Eccentricity in images of circular and spherical
targets and its impact on spatial intersection, Photogrammetric Record 29(148), 417–433; here it is
not a correction to an ellipse but part of the outline, so that the distortion is in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["LocalMap", "from_ellipses", "inverse_2x2", "local_maps", "target_axes"]


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """n maps of the unit disc: centre (n, 2) px, linear (n, 2, 2) px, second (n, 2, 3) px: the
    second derivatives by ss, st, tt.
    """

    centre: Array
    linear: Array
    second: Array

    def __len__(self) -> int:
        return len(self.centre)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> LocalMap:
        """Some of the maps, by mask or rows."""
        return LocalMap(self.centre[keep], self.linear[keep], self.second[keep])

    def without_eccentricity(self) -> LocalMap:
        """The same with plain ellipses: what is then measured is the ellipse's centre."""
        return LocalMap(self.centre, self.linear, np.zeros_like(self.second))

    def at(self, centre: Array) -> LocalMap:
        """The same shapes about other centres (n, 2) px."""
        return LocalMap(centre, self.linear, self.second)

    @property
    def inverse(self) -> Array:
        """The inverses of the linear parts (n, 2, 2) 1/px."""
        return inverse_2x2(self.linear)

    @property
    def semi_axes(self) -> Array:
        """Semi-axes of the ellipses (n, 2) px, the major one first."""
        # in closed form, as `inverse_2x2`
        a, b, c, d = (self.linear[:, i, k] for i in (0, 1) for k in (0, 1))
        mean, difference = np.hypot(a + d, b - c) / 2, np.hypot(a - d, b + c) / 2
        return np.stack([mean + difference, np.abs(mean - difference)], axis=1)

    @property
    def half_extent(self) -> Array:
        """Half width and height (n, 2) px of the ellipses' bounding boxes."""
        extent: Array = np.linalg.norm(self.linear, axis=2)
        return extent


def inverse_2x2(M: Array) -> Array:
    """Inverses of matrices (n, 2, 2): numpy's decompositions take ten times as long."""
    a, b, c, d = (M[:, i, k] for i in (0, 1) for k in (0, 1))
    adjugate = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    inverse: Array = adjugate / (a * d - b * c)[:, None, None]
    return inverse


def target_axes(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (n, 3) each that span the planes with these normals (n, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across: Array = np.cross(helper, normals)
    e1: Array = across / np.linalg.norm(across, axis=1, keepdims=True)
    return e1, np.cross(normals, e1)


def local_maps(
    sensor: Sensor, iop: Array, eop: Array, points: Array, normals: Array, radii: Array
) -> LocalMap:
    """The maps of targets at points (n, 3) mm with normals (n, 3) and radii (n,) mm.

    iop (10,), eop (6,). NaN for targets not in front of the camera. Derivatives are differences
    over the target's own radius, so that they hold for its outline and not only for its centre.
    """
    e1, e2 = target_axes(normals)
    e1, e2 = e1 * radii[:, None], e2 * radii[:, None]
    offsets = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)]
    around = np.concatenate([points + s * e1 + t * e2 for s, t in offsets])
    f = project(sensor, iop, eop, around).reshape(len(offsets), -1, 2)
    linear = np.stack([f[1] - f[2], f[3] - f[4]], axis=-1) / 2
    second = np.stack(
        [f[1] + f[2] - 2 * f[0], (f[5] + f[6] - f[7] - f[8]) / 4, f[3] + f[4] - 2 * f[0]], axis=-1
    )
    return LocalMap(f[0], linear, second)


def from_ellipses(centre: Array, semi_axes: Array, angle: Array) -> LocalMap:
    """Maps of ellipses: centres, semi-axes (n, 2) px, angle (n,) rad of the first semi-axis."""
    c, s = np.cos(angle), np.sin(angle)
    linear = np.stack(
        [
            np.stack([semi_axes[:, 0] * c, -semi_axes[:, 1] * s], axis=-1),
            np.stack([semi_axes[:, 0] * s, semi_axes[:, 1] * c], axis=-1),
        ],
        axis=1,
    )
    return LocalMap(np.array(centre, dtype=float), linear, np.zeros((len(centre), 2, 3)))
