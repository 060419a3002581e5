"""Ring codes read about circles that were found in a frame.

About each candidate the grey values are sampled on circles in the ellipse's own frame. A coded
target has its disc in one grey, a gap about it in the other, background outside of its ring, and
in the ring transitions that all lie on a raster of 12 or of 14 bits. What is read is then drawn,
blurred, and compared with the samples. Only a ring that passes all of it and whose code exists is
a coded target: the codes have little redundancy of their own (`ring_code`), their shape has much.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.ring_drawing import RADII, allowed_misfit, ring_misfit
from thermocald.photogrammetry.targets.ring_samples import (
    ANGLES,
    COARSE_ANGLES,
    in_perspective,
    sample,
    sized,
)

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Single
    from thermocald.photogrammetry.targets.detection import Candidates
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["CodedTargets", "read_codes"]

_COARSE_RADII = (0.5, 1.5, 2.5, 3.4)
_MIDDLE = slice(2, 5)
_INSIDE, _OUTSIDE = 0.6, 0.4  # level of a sample, 0 background, 1 ink
_LEAST_RELIEF = 0.35  # of the ring, against none about a plain circle
_SHARE = 0.85  # of the samples on a circle that must agree
_LEAST_CONTRAST_DN = 10.0
_SMALLEST_SEMI_AXIS_PX = 2.6  # a gap of less cannot be seen
_RASTER_PX = 0.5  # by how much a transition may miss the raster, and by how many turns
_RASTER_TURNS = 0.006
# A closed ring with something across is read as one arc, a line through a dot as two single bits.
_MISFIT_OF_FEW = 0.06


@dataclass(frozen=True, slots=True, eq=False)
class CodedTargets:
    """Coded targets: bits, numbers (m,), and the row (m,) of each among the candidates."""

    bits: NDArray[np.int64]
    numbers: NDArray[np.int64]
    rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rows)


def read_codes(
    image: NDArray[np.uint8],
    candidates: Candidates,
    known: frozenset[tuple[int, int]] | None = None,
    wanted: tuple[Collection[tuple[int, int]], float] = ((), inf),
) -> CodedTargets:
    """The ring codes about candidates; `known` (bits, number), all others are ignored.

    Both families are always read, since a ring of one may be mistaken for one of the other. A code
    that is read at two places is dropped: one of the two is wrong. wanted: codes, and how many of
    them are enough: discs about which no code was found are then not looked at in perspective.
    """
    rows, gap, contrast = _disc_and_gap(image, candidates)
    maps = sized(image, candidates.maps.select(rows), gap, contrast)
    bits, number = _read(image, maps, gap, contrast)
    # Seen from near and aslant, a ring is not concentric with its disc: by pixels if it is large.
    left = np.nonzero(bits == 0)[0]
    codes, enough = wanted
    if len(left) and sum(c in codes for c in _pairs(bits, number)) < enough:
        grey = gap[left], contrast[left]
        bits[left], number[left] = _read(
            image, in_perspective(image, maps.select(left), *grey), *grey
        )
    good = bits > 0
    bits, number, rows = bits[good], number[good], rows[good]
    found = _pairs(bits, number)
    count = Counter(found)
    keep = np.array(
        [i for i, c in enumerate(found) if count[c] == 1 and (known is None or c in known)],
        dtype=np.int64,
    )
    return CodedTargets(bits[keep], number[keep], rows[keep])


def _pairs(bits: NDArray[np.int64], number: NDArray[np.int64]) -> list[tuple[int, int]]:
    return list(zip(bits.tolist(), number.tolist(), strict=True))


def _read(
    image: NDArray[np.uint8], maps: LocalMap, gap: Single, contrast: Single
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bits (n,), 0 where no code can be trusted, and numbers (n,) of the codes about discs."""
    level = sample(image, maps, RADII, ANGLES)
    level = (level - gap[:, None, None]) / contrast[:, None, None]
    families = np.array(ring_code.BITS, dtype=np.int64)
    readings = [_read_family(level, maps, n) for n in families.tolist()]
    numbers = np.array([r[0] for r in readings]).reshape(len(families), len(maps))
    misfits = np.array([r[1] for r in readings]).reshape(len(families), len(maps))
    best, at = np.argmin(misfits, axis=0), np.arange(len(maps))
    misfit = misfits[best, at]
    misfits[best, at] = np.inf
    # A ring that fits both families can be trusted with neither.
    good = np.isfinite(misfit) & (
        misfits.min(axis=0, initial=np.inf) > 1.2 * np.where(np.isfinite(misfit), misfit, 0)
    )
    return np.where(good, families[best], 0), numbers[best, at]


def _disc_and_gap(
    image: NDArray[np.uint8], candidates: Candidates
) -> tuple[NDArray[np.int64], Single, Single]:
    """Candidates with disc, gap, something in the ring, background outside, and all in the image.

    Returns their rows, the grey value of the gap, and the contrast.
    """
    height, width = image.shape
    reach = candidates.maps.half_extent * ring_code.RING_OUTER
    low, high = candidates.maps.centre - reach, candidates.maps.centre + reach
    inside = np.all((low > 0) & (high < (width - 1, height - 1)), axis=1)
    large = candidates.maps.semi_axes[:, 1] >= _SMALLEST_SEMI_AXIS_PX
    rows = np.nonzero(inside & large)[0]
    grey = sample(image, candidates.maps.select(rows), _COARSE_RADII, COARSE_ANGLES)
    ink, gap = grey[:, 0].mean(axis=1), grey[:, 1].mean(axis=1)
    contrast = ink - gap
    enough = contrast * candidates.polarity[rows] >= _LEAST_CONTRAST_DN
    level = (grey - gap[:, None, None]) / np.where(enough, contrast, 1.0)[:, None, None]
    passed = (
        enough
        & (np.mean(level[:, 0] > _INSIDE, axis=1) >= _SHARE)
        & (np.mean(level[:, 1] < _OUTSIDE, axis=1) >= _SHARE)
        & (np.ptp(level[:, 2], axis=1) > _LEAST_RELIEF)
        & (np.mean(level[:, 3] < _OUTSIDE, axis=1) >= _SHARE)
    )
    return rows[passed], gap[passed], contrast[passed]


@cache
def _code_table(bits: int) -> NDArray[np.int64]:
    """The code of each number of so many bits, -1 where it is none."""
    table = np.full(1 << bits, -1, dtype=np.int64)
    codes = np.array(ring_code.codes(bits))
    for k in range(bits):
        table[((codes << k) | (codes >> (bits - k))) & ((1 << bits) - 1)] = codes
    return table


def _read_family(level: Single, maps: LocalMap, bits: int) -> tuple[NDArray[np.int64], Array]:
    """Codes (n,) read with a raster of so many bits, -1 for none, and the misfit (n,) of what was
    read, infinite where nothing was.
    """
    n = len(level)
    ring = level[:, _MIDDLE].mean(axis=1)
    after = np.roll(ring, -1, axis=1)
    crosses = (ring > 0.5) != (after > 0.5)
    target, at = np.nonzero(crosses)
    level_at = ring[target, at]
    place = at + (0.5 - level_at) / (after[target, at] - level_at)
    phase = 2 * np.pi * place * bits / ANGLES
    cosine, sine = np.bincount(target, np.cos(phase), n), np.bincount(target, np.sin(phase), n)
    offset = np.arctan2(sine, cosine) / (2 * np.pi * bits)  # in turns: where the raster begins
    off = np.zeros(n)
    np.maximum.at(
        off, target, np.abs((phase / (2 * np.pi) - offset[target] * bits + 0.5) % 1 - 0.5) / bits
    )
    # A pixel is the larger an angle the smaller the target: along its shortest semi-axis.
    allowed = _RASTER_TURNS + _RASTER_PX / (2 * np.pi * 2.5 * maps.semi_axes[:, 1])
    on_raster = off < np.minimum(allowed, 0.3 / bits)

    turns = np.arange(ANGLES) / ANGLES
    position = ((turns - offset[:, None]) % 1.0) * bits
    which = np.minimum(position.astype(np.int64), bits - 1)
    within = position - which
    middle = np.abs(within - 0.5) < 0.3
    segment = (np.arange(n)[:, None] * bits + which)[middle]
    ink = np.bincount(segment, ring[middle], n * bits)
    samples = np.bincount(segment, minlength=n * bits)
    ones = (ink > 0.5 * samples).reshape(n, bits)
    codes = _code_table(bits)[ones @ (1 << np.arange(bits - 1, -1, -1))]
    readable = on_raster & (codes >= 0)
    misfit = np.full(n, np.inf)
    rows = np.nonzero(readable)[0]
    if len(rows):
        misfit[rows] = ring_misfit(
            level[rows], maps.select(rows), ones[rows], which[rows], within[rows]
        )
        misfit[misfit > allowed_misfit(maps)] = np.inf
        one_arc = np.sum(ones != np.roll(ones, 1, axis=1), axis=1) == 2
        misfit[(one_arc | (ones.sum(axis=1) <= 2)) & (misfit > _MISFIT_OF_FEW)] = np.inf
    return codes, misfit
