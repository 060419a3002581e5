"""Circles found in a frame without prior knowledge, and the ring codes read about them.

A frame is thresholded against its local mean, so that uneven light does no harm; contours that are
ellipses are candidates. About each candidate the grey values are sampled in the ellipse's own
frame: a target has its disc in one grey, a gap about it in the other, a ring whose segments fit the
raster of 12 or of 14 bits, and background outside. Only a ring that passes all of it, and whose
code exists, is a coded target: the codes have little redundancy of their own (`ring_code`).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.photogrammetry import ring_code
from thermocald.photogrammetry.outline import LocalMap, from_ellipses

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["Candidates", "CodedTargets", "find_circles", "read_codes"]

_BLOCK_SHARE = 1 / 40  # of the image's width: the neighbourhood of the local mean, full size
_SMALLEST_BLOCK = 25
_OFFSET_DN = 6.0
_FEWEST_CONTOUR_POINTS = 8
_LARGEST_SHARE = 0.12  # of the image's width
_COMPACTNESS = 0.5
_AREA_TOLERANCE = 0.12
_RADIUS_TOLERANCE = 0.03
_SMALLEST_AXIS = 1.5
_LARGEST_AXIS_RATIO = 3.2  # 60° obliqueness and then some perspective
_ANGLES = 84  # a multiple of 12 and of 14
_RADII = (0.5, 1.5, 2.35, 2.65, 3.4)
_INSIDE, _OUTSIDE = 0.6, 0.4  # grey level of a sample, 0 background, 1 ink
_SHARE = 0.94  # of the samples on a circle that must agree
_MISFIT = 0.20
_LEAST_CONTRAST_DN = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """n ellipses: maps (centre good to some 0.1 px), and ink (n,): -1 dark on light, 1 reverse."""

    maps: LocalMap
    ink: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ink)


@dataclass(frozen=True, slots=True, eq=False)
class CodedTargets:
    """Coded targets: bits, numbers (m,), and the row (m,) of each among the candidates."""

    bits: NDArray[np.int64]
    numbers: NDArray[np.int64]
    rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rows)


def find_circles(image: NDArray[np.uint8], scale: int = 1, ink: int = -1) -> Candidates:
    """Ellipses of one kind (dark on light -1, light on dark 1) in an image (H, W).

    scale: the image is searched at 1/scale of its size; ellipses with less than some six px across
    there are not found.
    """
    small = image
    if scale > 1:
        small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    block = max(int(image.shape[1] * _BLOCK_SHARE / scale), _SMALLEST_BLOCK) | 1
    mean = cv2.blur(small, (block, block), borderType=cv2.BORDER_REPLICATE)
    difference = cv2.subtract(mean, small) if ink < 0 else cv2.subtract(small, mean)
    _, mask = cv2.threshold(difference, _OFFSET_DN, 255, cv2.THRESH_BINARY)
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    longest = 4 * _LARGEST_SHARE * small.shape[1]
    found, outlines = [], []
    for contour in contours:
        if not _FEWEST_CONTOUR_POINTS <= len(contour) <= longest:
            continue
        # Outlines have a negative, holes a positive oriented area.
        area = -cv2.contourArea(contour, oriented=True)
        if area * 4 * np.pi < _COMPACTNESS * cv2.arcLength(contour, True) ** 2:
            continue
        (x, y), (width, height), angle = cv2.fitEllipseDirect(contour)
        ellipse = np.pi / 4 * width * height
        if (
            abs(area - ellipse) < _AREA_TOLERANCE * ellipse + 3.0
            and min(width, height) >= _SMALLEST_AXIS
            and max(width, height) + 1 <= _LARGEST_AXIS_RATIO * (min(width, height) + 1)
        ):
            found.append((x, y, width / 2, height / 2, np.radians(angle)))
            outlines.append(contour)
    e = np.array(found, dtype=float).reshape(-1, 5)
    e = e[_are_ellipses(outlines, e)]
    centre = scale * e[:, :2] + (scale - 1) / 2
    # A contour runs through pixel centres, half a pixel inside of the outline.
    return Candidates(
        from_ellipses(centre, scale * (e[:, 2:4] + 0.5), e[:, 4]),
        np.full(len(e), ink, dtype=np.int64),
    )


def _are_ellipses(contours: list[Any], e: Array) -> NDArray[np.bool_]:
    """Which contours keep to their ellipses (x, y, a, b, angle), to a pixel's raster and 3 %."""
    if not contours:
        return np.zeros(0, dtype=bool)
    count = np.array([len(c) for c in contours])
    which = np.repeat(np.arange(len(contours)), count)
    points = np.concatenate(contours)[:, 0].astype(float)
    x, y, a, b, angle = e.T
    c, s = np.cos(angle)[which], np.sin(angle)[which]
    dx, dy = points[:, 0] - x[which], points[:, 1] - y[which]
    rho = np.hypot((c * dx + s * dy) / a[which], (c * dy - s * dx) / b[which])
    off = np.bincount(which, np.abs(rho - 1)) / count
    keeps: NDArray[np.bool_] = off < _RADIUS_TOLERANCE + 0.35 / np.minimum(a, b)
    return keeps


def read_codes(
    image: NDArray[np.uint8],
    candidates: Candidates,
    families: Iterable[int] = ring_code.BITS,
    known: frozenset[tuple[int, int]] | None = None,
) -> CodedTargets:
    """The ring codes about candidates; `known` (bits, number), all others are ignored.

    A code that is read at two places is dropped: one of the two is not what it says.
    """
    ring, passed = _ring_profiles(image, candidates)
    rows = np.nonzero(passed)[0]
    raster = np.array(sorted(families), dtype=np.int64)
    readings = [_read_family(ring[rows], n) for n in raster.tolist()]
    numbers = np.array([r[0] for r in readings]).reshape(len(raster), len(rows))
    misfits = np.array([r[1] for r in readings]).reshape(len(raster), len(rows))
    misfits = np.where((numbers >= 0) & (misfits < _MISFIT), misfits, np.inf)
    best, at = np.argmin(misfits, axis=0), np.arange(len(rows))
    misfit, number, bits = misfits[best, at], numbers[best, at], raster[best]
    others = misfits.copy()
    others[best, at] = np.inf
    # A ring that fits both families can be trusted with neither.
    clear = others.min(axis=0) >= np.where(np.isfinite(misfit), 1.2 * misfit + 0.01, 0.0)
    good = np.isfinite(misfit) & clear
    found = list(zip(bits[good].tolist(), number[good].tolist(), strict=True))
    count = Counter(found)
    keep = np.array(
        [i for i, c in enumerate(found) if count[c] == 1 and (known is None or c in known)],
        dtype=np.int64,
    )
    return CodedTargets(bits[good][keep], number[good][keep], rows[good][keep])


@cache
def _code_table(bits: int) -> NDArray[np.int64]:
    """The code of each number of so many bits, -1 where it is none."""
    codes = frozenset(ring_code.codes(bits))
    smallest = (ring_code.smallest_rotation(number, bits) for number in range(1 << bits))
    return np.array([code if code in codes else -1 for code in smallest], dtype=np.int64)


def _ring_profiles(
    image: NDArray[np.uint8], candidates: Candidates
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Level of the ring (n, _ANGLES), 0 background to 1 ink; which candidates look like targets."""
    n = len(candidates)
    profiles = np.zeros((n, len(_RADII), _ANGLES), dtype=np.float32)
    turn = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    circle = np.stack([np.cos(turn), np.sin(turn)])
    height, width = image.shape
    chunk = 32_000 // len(_RADII)
    for i in range(0, n, chunk):
        part = candidates.maps.select(np.arange(i, min(i + chunk, n)))
        around = (part.linear @ circle)[:, None] * np.array(_RADII)[:, None, None]
        at = (around + part.centre[:, None, :, None]).astype(np.float32)
        at = at.reshape(-1, 2, _ANGLES)
        sampled = cv2.remap(
            image, np.ascontiguousarray(at[:, 0]), np.ascontiguousarray(at[:, 1]),
            cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0,
        )  # fmt: skip
        profiles[i : i + chunk] = sampled.reshape(len(part), len(_RADII), _ANGLES)
    ink, gap = profiles[:, 0].mean(axis=1), profiles[:, 1].mean(axis=1)
    contrast = ink - gap
    enough = contrast * candidates.ink >= _LEAST_CONTRAST_DN
    safe = np.where(enough, contrast, 1.0)
    level = (profiles - gap[:, None, None]) / safe[:, None, None]
    reach = np.linalg.norm(candidates.maps.linear, axis=2) * ring_code.RING_OUTER
    low, high = candidates.maps.centre - reach, candidates.maps.centre + reach
    inside = np.all((low > 0) & (high < (width - 1, height - 1)), axis=1)
    passed = (
        enough
        & inside
        & (np.mean(level[:, 0] > _INSIDE, axis=1) >= _SHARE)
        & (np.mean(level[:, 1] < _OUTSIDE, axis=1) >= _SHARE)
        & (np.mean(level[:, -1] < _OUTSIDE, axis=1) >= _SHARE)
    )
    return level[:, 2:4].mean(axis=1), passed


def _read_family(ring: NDArray[np.float32], bits: int) -> tuple[NDArray[np.int64], Array]:
    """Codes (n,) read with a raster of so many bits, -1 for none, and that raster's misfit (n,).

    The misfit is the RMS of the level against 0 or 1 in the middle part of each segment, infinite
    where a segment is neither.
    """
    per_bit = _ANGLES // bits
    margin = per_bit // 5
    best_misfit = np.full(len(ring), np.inf)
    best = np.zeros((len(ring), bits), dtype=bool)
    for shift in range(per_bit):
        segment = np.roll(ring, -shift, axis=1).reshape(len(ring), bits, per_bit)
        middle = segment[:, :, margin : per_bit - margin]
        mean = middle.mean(axis=2)
        ones = mean > 0.5
        misfit = np.sqrt(np.mean((middle - ones[:, :, None]) ** 2, axis=(1, 2)))
        clear = np.all(np.abs(mean - 0.5) > 0.15, axis=1)
        misfit = np.where(clear, misfit, np.inf)
        better = misfit < best_misfit
        best_misfit = np.where(better, misfit, best_misfit)
        best = np.where(better[:, None], ones, best)
    numbers = best @ (1 << np.arange(bits - 1, -1, -1))
    return _code_table(bits)[numbers], best_misfit
