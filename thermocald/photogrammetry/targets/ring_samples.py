"""Grey values about discs, sampled on circles in each disc's own plane, and what they say of it.

A contour gives a disc to a pixel; its size is taken from the grey values, and so is the perspective
in which its ring is seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.outline import LocalMap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Single

__all__ = ["ANGLES", "COARSE_ANGLES", "in_perspective", "sample", "sized"]

ANGLES = 84  # a multiple of 12 and of 14
COARSE_ANGLES = 28
_PROFILE, _PROFILE_STEP, _PROFILE_REACH = (0.5, 3.55), 0.05, 0.45
_EDGE_RADII = (0.55, 0.65, 0.75, 0.85, 0.95, 1.05, 1.15, 1.25, 1.35, 1.45)
_INSIDE = 0.6  # level of a sample, 0 background, 1 ink


def sample(
    image: NDArray[np.uint8], maps: LocalMap, radii: tuple[float, ...], angles: int
) -> Single:
    """Grey values (n, radii, angles) on circles about discs, clockwise from the first axis.

    radii: of the circles, in radii of the disc; angles: how many samples a circle has.
    """
    turn = 2 * np.pi * np.arange(angles) / angles
    circle = np.stack([np.cos(turn), np.sin(turn)])
    grey = np.empty((len(maps), len(radii), angles), dtype=np.float32)
    chunk = 32_000 // len(radii)  # cv2.remap takes no more rows
    rho = np.array(radii, dtype=np.float32)[:, None, None]
    bend = np.stack([circle[0] ** 2, 2 * circle[0] * circle[1], circle[1] ** 2]) / 2
    bent = bool(np.any(maps.second))
    for i in range(0, len(maps), chunk):
        part = slice(i, i + chunk)
        around = (maps.linear[part] @ circle).astype(np.float32)[:, None] * rho
        if bent:
            around += (maps.second[part] @ bend).astype(np.float32)[:, None] * rho**2
        around += maps.centre[part].astype(np.float32)[:, None, :, None]
        x, y = (np.ascontiguousarray(around[:, :, k]).reshape(-1, angles) for k in (0, 1))
        grey[part] = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(-1, len(radii), angles)
    return grey


def sized(image: NDArray[np.uint8], maps: LocalMap, gap: Single, contrast: Single) -> LocalMap:
    """The maps with the size that the discs have at half of their contrast.

    A contour lies where its threshold does, which may be a pixel off.
    """
    level = sample(image, maps, _EDGE_RADII, COARSE_ANGLES)
    level = (level - gap[:, None, None]) / contrast[:, None, None]
    # The disc reaches as far as ink goes: its level, summed outwards.
    step = _EDGE_RADII[1] - _EDGE_RADII[0]
    radius = _EDGE_RADII[0] - step / 2 + np.clip(level, 0, 1).sum(axis=1) * step
    turn = 2 * np.pi * np.arange(COARSE_ANGLES) / COARSE_ANGLES
    across = 1 / np.linalg.norm(
        np.swapaxes(maps.inverse, 1, 2) @ np.stack([np.cos(turn), np.sin(turn)]),
        axis=1,
    )
    excess = np.median((radius - 1) * across, axis=1)
    axes = np.linalg.norm(maps.linear, axis=1)
    factor = np.maximum(1 + excess[:, None] / axes, 0.5)
    return LocalMap(maps.centre, maps.linear * factor[:, None, :], maps.second)


def in_perspective(
    image: NDArray[np.uint8], maps: LocalMap, gap: Single, contrast: Single
) -> LocalMap:
    """The maps (n,) of discs with the perspective in which their rings are seen.

    gap, contrast (n,) DN. The edges of disc and ring are looked for along each radius; those of a
    target seen in perspective w about a centre that is e off lie at R − e·u − uᵀA u R − (w·u) R²
    instead of at R = 1, 2, 3, with u the direction and A the ellipse's error. What the ring says
    is of no matter here.
    """
    rho = np.arange(_PROFILE[0], _PROFILE[1], _PROFILE_STEP)
    level = sample(image, maps, tuple(rho.tolist()), ANGLES)
    level = (level - gap[:, None, None]) / contrast[:, None, None]
    turn = 2 * np.pi * np.arange(ANGLES) / ANGLES
    u = np.stack([np.cos(turn), np.sin(turn)])
    # away from the ends of an arc, whose corners are rounded by blur
    ring = level[:, np.argmin(np.abs(rho - 2.5))] > _INSIDE
    ring &= np.roll(ring, 2, axis=1) & np.roll(ring, -2, axis=1)
    normal, rhs = np.zeros((len(maps), 7, 7)), np.zeros((len(maps), 7))
    for radius, rising in (
        (1.0, False),
        (ring_code.RING_INNER, True),
        (ring_code.RING_OUTER, False),
    ):
        window = np.abs(rho - radius) < _PROFILE_REACH
        part = level[:, window] if rising else 1 - level[:, window]
        crossing = (part[:, :-1] < 0.5) & (part[:, 1:] >= 0.5)
        known = crossing.sum(axis=1) == 1
        if radius > 1:
            known &= ring
        first = np.argmax(crossing, axis=1)[:, None]
        below = np.take_along_axis(part, first, 1)[:, 0]
        above = np.take_along_axis(part, first + 1, 1)[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            place = rho[window][first[:, 0]] + _PROFILE_STEP * (0.5 - below) / (above - below)
        short = np.where(known, radius - place, 0.0)
        design = np.stack(
            [
                u[0], u[1], radius * u[0] ** 2, 2 * radius * u[0] * u[1], radius * u[1] ** 2,
                radius**2 * u[0], radius**2 * u[1],
            ]
        )  # fmt: skip
        normal += (design * known[:, None]) @ design.T
        rhs += short @ design.T
    ex, ey, a, b, d, *w = np.linalg.solve(normal + 1e-3 * np.eye(7), rhs[..., None])[..., 0].T
    e, shape = np.stack([ex, ey], axis=-1), np.stack([a, b, b, d], axis=-1).reshape(-1, 2, 2)
    linear = maps.linear @ (np.eye(2) - shape)
    first, second = linear[:, :, 0], linear[:, :, 1]
    ws, wt = w[0][:, None], w[1][:, None]
    bend = np.stack([-2 * ws * first, -ws * second - wt * first, -2 * wt * second], axis=-1)
    return LocalMap(maps.centre - (maps.linear @ e[..., None])[..., 0], linear, bend)
