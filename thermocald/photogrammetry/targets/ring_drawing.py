"""What was read in a ring, drawn with blur and held against its samples.

A ring is trusted only where the drawing fits after it may shift, turn and grow a little.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.blurred_disc import normal_cdf
from thermocald.photogrammetry.targets.ring_samples import ANGLES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Single
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["RADII", "allowed_misfit", "ring_misfit"]

RADII = (1.75, 2.05, 2.25, 2.5, 2.75, 2.95, 3.25)
_BLURS_PX = (0.8, 1.4)
_LARGEST_SHIFT = 0.2  # radii, by which perspective and distortion move a ring against its disc
# RMS of samples against what was read, in levels: at most, and for large targets, whose edges fill
# less of the ring, less.
_MISFIT = 0.13
_MISFIT_LARGE, _MISFIT_EDGE_PX = 0.03, 0.45


def allowed_misfit(maps: LocalMap) -> Array:
    """Largest misfit (n,) in levels with which a ring about each disc is trusted."""
    allowed: Array = _MISFIT_LARGE + _MISFIT_EDGE_PX / maps.semi_axes[:, 1]
    return np.minimum(allowed, _MISFIT)


def ring_misfit(
    level: Single,
    maps: LocalMap,
    ones: NDArray[np.bool_],
    which: NDArray[np.int64],
    within: Array,
) -> Array:
    """RMS (n,) of the samples against the ring that was read, drawn with one of two blurs.

    level (n, radii, angles): samples at `RADII`, 0 background, 1 ink; ones (n, bits): what was
    read; which, within (n, angles): the segment in which each angle lies, and where in it, 0 to 1.
    """
    bits = ones.shape[1]
    mine = np.take_along_axis(ones, which, 1)
    left = np.take_along_axis(ones, (which - 1) % bits, 1) != mine
    right = np.take_along_axis(ones, (which + 1) % bits, 1) != mine
    # Angle to the nearest transition in rad, positive on ink; a bit farther off will do for far.
    angle = np.minimum(np.where(left, within, within + 1), np.where(right, 1 - within, 2 - within))
    angle = np.where(mine, angle, -angle) * (2 * np.pi / bits)
    turn = 2 * np.pi * np.arange(ANGLES) / ANGLES
    u = np.stack([np.cos(turn), np.sin(turn)])
    # How many px a radius is: across the circles, and across a radial edge at that radius.
    across = 1 / np.linalg.norm(np.swapaxes(maps.inverse, 1, 2) @ u, axis=1)
    along = np.abs(np.linalg.det(maps.linear))[:, None] / np.linalg.norm(maps.linear @ u, axis=1)
    across, side = across.astype(np.float32), (angle * along).astype(np.float32)
    rho = np.array(RADII, dtype=np.float32)[:, None]
    misfit = np.full(len(level), np.inf)
    for blur in _BLURS_PX:
        left = np.nonzero(misfit > allowed_misfit(maps))[0]
        if len(left) == 0:
            break
        scale = (across[left] / np.float32(blur))[:, None]
        drawn = normal_cdf((rho - np.float32(ring_code.RING_INNER)) * scale)
        drawn += normal_cdf((np.float32(ring_code.RING_OUTER) - rho) * scale)
        drawn -= np.float32(1)
        drawn *= normal_cdf(rho * (side[left] / np.float32(blur))[:, None])
        misfit[left] = np.minimum(misfit[left], _rms_after_shift(level[left], drawn))
    return misfit


def _rms_after_shift(level: Single, drawn: Single) -> Array:
    """RMS (n,) of level minus drawn (n, radii, angles) after the ring may shift, turn, and grow."""
    n = len(level)
    turn = (2 * np.pi * np.arange(ANGLES) / ANGLES).astype(np.float32)
    radii = np.array(RADII, dtype=np.float32)
    rho, cosine, sine = radii[:, None], np.cos(turn), np.sin(turn)
    outwards = np.gradient(drawn, radii, axis=1)
    around = np.roll(drawn, -1, axis=2) - np.roll(drawn, 1, axis=2)
    around *= np.float32(ANGLES / (4 * np.pi))
    design = np.stack(
        [
            outwards * cosine - around * sine / rho,
            outwards * sine + around * cosine / rho,
            around,
            outwards * rho,
        ],
        axis=1,
    ).reshape(n, 4, -1)
    residual = (level - drawn).reshape(n, -1)
    normal = design @ np.swapaxes(design, 1, 2) + 1e-3 * np.eye(4, dtype=np.float32)
    shift = np.linalg.solve(normal, (design @ residual[..., None]))[..., 0]
    shift = np.clip(shift, -_LARGEST_SHIFT, _LARGEST_SHIFT)
    left = residual - (shift[:, None] @ design)[:, 0]
    rms: Array = np.sqrt(np.mean(left * left, axis=1))
    return rms
