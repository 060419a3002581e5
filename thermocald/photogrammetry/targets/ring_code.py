"""Ring codes around circular targets: the codes, their drawing, and their reading in a frame.

A target is a disc of radius 1 and a concentric ring between radius 2 and 3, which is divided into N
equal segments. A segment in the disc's colour is a 1, one in the background's colour a 0. Read
clockwise (as seen by the viewer) with the most significant bit first, each starting segment gives a
number, of which the smallest is the code. Codes must have an even number of ones, at least one pair
of opposite ones, and a gap; there are 147 codes of 12 bits and 516 of 14 bits. `number` in this
module and in a test field's code (`RING12:<code>`, `RING14:<code>`) is the code itself, not its
place in the list of a program; such lists are in increasing order of the code.

Source: Schneider, C. T. (1991): 3-D Vermessung von Oberflächen und Bauteilen durch Photogrammetrie
und Bildverarbeitung, IDENT/VISION '91; rule and geometry as the expired patent DE 197 33 466 A1,
read by M. Petroff, "Photogrammetry targets" (2018), who compared them with Scanreference's targets.

A contour gives a disc to about a pixel; its size and the perspective of its ring are estimated from
the grey values.

Around each candidate, grey values are sampled on circles in the coordinates of the ellipse. A coded
target has its disc in one grey, a gap around it in the other, background outside its ring, and all
transitions in the ring on a raster of 12 or 14 bits. The code that was read is then drawn, blurred,
and compared with the samples. Only a ring that passes all these checks and has an existing code is
accepted, since the codes have little redundancy, but their shape has much.

The search is from the frequent to the rare: dark on light in a reduced image first, light on dark
at full size last, until enough codes are found for an orientation.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.arrays import eight_bit
from thermocald.errors import TestFieldError
from thermocald.photogrammetry.targets.circle import normal_cdf
from thermocald.photogrammetry.targets.markers import (
    detect_markers,
    is_marker,
    parse_marker,
)
from thermocald.photogrammetry.targets.outline import RING_INNER, RING_OUTER, LocalMap, find_circles

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Single
    from thermocald.photogrammetry.field.testfield import TestField


BITS = (12, 14)


@cache
def codes(bits: int) -> tuple[int, ...]:
    """Return all codes of 12 or 14 bits in increasing order; ValueError for other bits."""
    if bits not in BITS:
        raise ValueError(f"ring codes have {' or '.join(map(str, BITS))} bits, not {bits}")
    half, mask = bits // 2, (1 << bits) - 1
    return tuple(
        number
        for number in range(1, 1 << (bits - 1), 2)  # starts with a 0: a closed ring is not a code
        if number.bit_count() % 2 == 0
        and number & (number >> half) & ((1 << half) - 1)
        # the smallest of its rotations
        and number == min((number << k) & mask | number >> (bits - k) for k in range(bits))
    )


def is_ring(code: str) -> bool:
    """Return whether a test field's code is a ring code."""
    return code.startswith("RING")


def have_rings(testfield: TestField, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which targets (n,) of some rows (n,) of a test field have a code ring."""
    return np.array([is_ring(testfield.codes[row]) for row in rows], dtype=bool)


def parse(code: str) -> tuple[int, int]:
    """Parse `RING12:47` to (12, 47); TestFieldError if no such code exists."""
    family, _, number = code.partition(":")
    bits = {f"RING{n}": n for n in BITS}.get(family)
    if bits is None or not number.isascii() or not number.isdigit():
        raise TestFieldError(
            f"{code!r} is not a ring code; write RING12:<code> or RING14:<code>, such as RING12:"
            f"{codes(12)[0]}"
        )
    value = int(number[:9])
    if value >> bits or _code_table(bits)[value] != value:
        raise TestFieldError(
            f"{code!r}: there is no {bits}-bit ring code {value}; a code is the smallest number "
            "among its rotations, has an even number of ones, and a pair of opposite ones"
        )
    return bits, value


def write(bits: int, number: int) -> str:
    """Return the text of a code: the inverse of `parse`."""
    return f"RING{bits}:{number}"


def segments(bits: int, number: int) -> tuple[tuple[float, float], ...]:
    """Return the arcs of a code as (begin, end) in turns, clockwise from +x as the viewer sees it.

    Neighbouring ones are one arc; an arc may end beyond 1.0. With y down, the angle 2π·turns is
    from x to y; with y up, negate it.
    """
    ones = [bool(number >> (bits - 1 - i) & 1) for i in range(bits)]
    arcs = []
    for begin in (i for i in range(bits) if ones[i] and not ones[i - 1]):
        end = begin
        while ones[end % bits]:
            end += 1
        arcs.append((begin / bits, end / bits))
    return tuple(arcs)


ANGLES = 84  # a multiple of 12 and of 14
COARSE_ANGLES = 28
_PROFILE_ANGLES = 42
_PROFILE, _PROFILE_STEP, _PROFILE_REACH = (0.5, 3.55), 0.1, 0.45
_INSIDE = 0.6  # level of a sample, 0 background, 1 ink


def _circle(angles: int) -> Array:
    """Return unit vectors (2, angles), evenly around a circle."""
    turn = 2 * np.pi * np.arange(angles) / angles
    return np.stack([np.cos(turn), np.sin(turn)])


def sample(
    image: NDArray[np.uint8],
    maps: LocalMap,
    radii: Sequence[float],
    angles: int,
    ink: tuple[Single, Single] | None = None,
) -> Single:
    """Return grey values (n, radii, angles) on circles around discs, clockwise from the first axis.

    radii: of the circles, in radii of the disc; angles: samples per circle; ink: grey value (n,) of
    the gap and contrast (n,) of the disc; if given, levels are returned: 0 for the background, 1
    for the disc.
    """
    circle = _circle(angles)
    grey = np.empty((len(maps), len(radii), angles), dtype=np.float32)
    chunk = 32_000 // len(radii)  # cv2.remap is limited to 32,767 rows
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
    return grey if ink is None else (grey - ink[0][:, None, None]) / ink[1][:, None, None]


def in_perspective(
    image: NDArray[np.uint8], maps: LocalMap, ink: tuple[Single, Single]
) -> LocalMap:
    """Return the maps (n,) of discs with the perspective of their rings, whatever their codes.

    ink: as in `sample`. The edges of disc and ring are measured along each radius. With perspective
    w, an error e of the centre, and an error A of the ellipse they are at R − e·u − uᵀA u R −
    (w·u) R² in the direction u, instead of at R = 1, 2, 3.
    """
    rho = np.arange(_PROFILE[0], _PROFILE[1], _PROFILE_STEP)
    level = sample(image, maps, rho.tolist(), _PROFILE_ANGLES, ink)
    u = _circle(_PROFILE_ANGLES)
    # away from the ends of an arc, whose corners blur rounds
    ring = level[:, np.argmin(np.abs(rho - 2.5))] > _INSIDE
    ring &= np.roll(ring, 1, axis=1) & np.roll(ring, -1, axis=1)
    normal, rhs = np.zeros((len(maps), 7, 7)), np.zeros((len(maps), 7))
    for radius, rising in ((1.0, False), (RING_INNER, True), (RING_OUTER, False)):
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
        inwards = np.where(known, radius - place, 0.0)
        design = np.stack(
            [
                u[0], u[1], radius * u[0] ** 2, 2 * radius * u[0] * u[1], radius * u[1] ** 2,
                radius**2 * u[0], radius**2 * u[1],
            ]
        )  # fmt: skip
        normal += (design * known[:, None]) @ design.T
        rhs += inwards @ design.T
    ex, ey, a, b, d, *w = np.linalg.solve(normal + 1e-3 * np.eye(7), rhs[..., None])[..., 0].T
    e, shape = np.stack([ex, ey], axis=-1), np.stack([a, b, b, d], axis=-1).reshape(-1, 2, 2)
    linear = maps.linear @ (np.eye(2) - shape)
    first, second = linear[:, :, 0], linear[:, :, 1]
    ws, wt = w[0][:, None], w[1][:, None]
    bend = np.stack([-2 * ws * first, -ws * second - wt * first, -2 * wt * second], axis=-1)
    return LocalMap(maps.centre - (maps.linear @ e[..., None])[..., 0], linear, bend)


RADII = (1.75, 2.05, 2.25, 2.5, 2.75, 2.95, 3.25)
_BLURS_PX = (1.0, 1.6)  # with which a code is drawn
# Largest RMS of the samples against the drawn code, in levels; less for large targets, whose edges
# are a smaller part of the ring.
_MISFIT = 0.13
_MISFIT_LARGE, _MISFIT_EDGE_PX = 0.03, 0.45


def ring_misfit(
    level: Single, maps: LocalMap, ones: NDArray[np.bool_], which: NDArray[np.int64], within: Array
) -> Array:
    """Return the RMS (n,) of samples against the ring that was read, drawn with one of two blurs.

    level (n, radii, angles): samples at `RADII`, 0 background, 1 ink; ones (n, bits): the code that
    was read; which, within (n, angles): the segment of each angle, and its place in it, 0 to 1.
    """
    bits = ones.shape[1]
    mine = np.take_along_axis(ones, which, 1)
    left = np.take_along_axis(ones, (which - 1) % bits, 1) != mine
    right = np.take_along_axis(ones, (which + 1) % bits, 1) != mine
    # angle to the nearest transition, rad, positive on ink; the neighbouring segments are enough
    angle = np.minimum(np.where(left, within, within + 1), np.where(right, 1 - within, 2 - within))
    angle = np.where(mine, angle, -angle) * (2 * np.pi / bits)
    u = _circle(ANGLES)
    # px per radius: across the circles, and across a radial edge at this radius
    px = 1 / np.linalg.norm(np.swapaxes(maps.inverse, 1, 2) @ u, axis=1)
    along = np.abs(np.linalg.det(maps.linear))[:, None] / np.linalg.norm(maps.linear @ u, axis=1)
    across, side = px.astype(np.float32), (angle * along).astype(np.float32)
    rho = np.array(RADII, dtype=np.float32)[:, None]
    misfits = []
    for blur in map(np.float32, _BLURS_PX):
        scale = (across / blur)[:, None]
        drawn = normal_cdf((rho - np.float32(RING_INNER)) * scale)
        drawn += normal_cdf((np.float32(RING_OUTER) - rho) * scale)
        drawn -= np.float32(1)
        drawn *= normal_cdf(rho * (side / blur)[:, None])
        misfits.append(np.mean((level - drawn) ** 2, axis=(1, 2), dtype=float))
    rms: Array = np.sqrt(np.min(misfits, axis=0))
    return rms


_COARSE_RADII = (0.5, 1.5, 2.5, 3.4)
_MIDDLE = slice(2, 5)
_OUTSIDE = 0.4  # level of a sample, 0 background, 1 ink
_LEAST_RELIEF = 0.35  # range of levels in the ring; a plain circle has none
_SHARE = 0.85  # of the samples on a circle that must agree
_LEAST_CONTRAST_DN = 10.0
_SMALLEST_SEMI_AXIS_PX = 2.6  # a smaller gap is not resolved
_RASTER_PX = 0.5  # tolerance of a transition on the raster: px plus turns
_RASTER_TURNS = 0.006
# A closed ring with a bar across it reads as one arc, a line through a dot as two single bits.
_MISFIT_OF_FEW = 0.06


def read_codes(
    image: NDArray[np.uint8], candidates: LocalMap, polarity: int
) -> dict[tuple[int, int], int]:
    """Read the ring codes around discs; return the candidate's index of each code (bits, number).

    polarity: -1 dark on light, 1 light on dark. Both families are read, since a ring of one may be
    mistaken for one of the other. A code that is read twice is dropped, since one is wrong.
    """
    rows, gap, contrast = _disc_and_gap(image, candidates, polarity)
    ink = gap, contrast
    # Seen from near and obliquely, a large ring is eccentric to its disc by pixels.
    maps = in_perspective(image, candidates.select(rows), ink)
    level = sample(image, maps, RADII, ANGLES, ink)
    readings = zip(*(_read_family(level, maps, n) for n in BITS), strict=True)
    numbers, misfits = (np.stack(column) for column in readings)
    best, at = np.argmin(misfits, axis=0), np.arange(len(maps))
    misfit = misfits[best, at]
    misfits[best, at] = np.inf
    # a ring that fits both families is ambiguous
    good = np.isfinite(misfit) & (
        misfits.min(axis=0, initial=np.inf) > 1.2 * np.where(np.isfinite(misfit), misfit, 0)
    )
    read = [
        (BITS[k], n)
        for k, n in zip(best[good].tolist(), numbers[best, at][good].tolist(), strict=True)
    ]
    count = Counter(read)
    return {code: int(row) for code, row in zip(read, rows[good], strict=True) if count[code] == 1}


def _disc_and_gap(
    image: NDArray[np.uint8], candidates: LocalMap, polarity: int
) -> tuple[NDArray[np.int64], Single, Single]:
    """Select candidates in the image with a disc, gap, marks in the ring, and background outside.

    Returns their rows, the grey values of the gaps, and the contrasts.
    """
    height, width = image.shape
    reach = candidates.half_extent * RING_OUTER
    low, high = candidates.centre - reach, candidates.centre + reach
    inside = np.all((low > 0) & (high < (width - 1, height - 1)), axis=1)
    large = candidates.semi_axes[:, 1] >= _SMALLEST_SEMI_AXIS_PX
    rows = np.nonzero(inside & large)[0]
    grey = sample(image, candidates.select(rows), _COARSE_RADII, COARSE_ANGLES)
    ink, gap = grey[:, 0].mean(axis=1), grey[:, 1].mean(axis=1)
    contrast = ink - gap
    enough = contrast * polarity >= _LEAST_CONTRAST_DN
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
    """Return the code of each number of `bits` bits, -1 if there is none."""
    table = np.full(1 << bits, -1, dtype=np.int64)
    words = np.array(codes(bits))
    for k in range(bits):
        table[((words << k) | (words >> (bits - k))) & ((1 << bits) - 1)] = words
    return table


def _read_family(level: Single, maps: LocalMap, bits: int) -> tuple[NDArray[np.int64], Array]:
    """Read codes with a raster of `bits` bits.

    Returns the codes (n,), -1 for none, and their misfits (n,), infinite for rings not read.
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
    offset = np.arctan2(sine, cosine) / (2 * np.pi * bits)  # beginning of the raster, in turns
    off = np.zeros(n)
    np.maximum.at(
        off, target, np.abs((phase / (2 * np.pi) - offset[target] * bits + 0.5) % 1 - 0.5) / bits
    )
    # a pixel is a larger angle on a smaller target, along the minor semi-axis
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
        allowed = _MISFIT_LARGE + _MISFIT_EDGE_PX / maps.semi_axes[:, 1]
        misfit[misfit > np.minimum(allowed, _MISFIT)] = np.inf
        one_arc = np.sum(ones != np.roll(ones, 1, axis=1), axis=1) == 2
        misfit[(one_arc | (ones.sum(axis=1) <= 2)) & (misfit > _MISFIT_OF_FEW)] = np.inf
    return codes, misfit


SEARCHES = ((2, -1), (2, 1), (1, -1), (1, 1))
"""Scale and polarity (-1 dark on light) of the searches, until there are enough codes."""
_ENOUGH_CODES = 0.5
_LARGE_WIDTH = 1200
_MARKER_NEIGHBOURHOOD = 2.0  # of the sides of the marker that names a circle


def find_coded(
    image: Image, testfield: TestField, fewest: int, needed: bool
) -> tuple[NDArray[np.int64], LocalMap, bool]:
    """Find circles with ring codes and circles named by markers.

    fewest: targets that determine an orientation; needed: whether to search for more than these,
    until enough are found. Returns rows, maps, and whether codes of another field were seen.
    """
    row_of: dict[tuple[int, int], int] = {}
    named: dict[str, dict[int, int]] = {}
    for row in np.flatnonzero(testfield.circles).tolist():
        if is_ring(code := testfield.codes[row]):
            row_of[parse(code)] = row
        elif is_marker(code):
            dictionary, marker, corner = parse_marker(code)
            if corner is None:
                named.setdefault(dictionary, {})[marker] = row
    best: dict[int, int] = {}  # place among the candidates by row
    maps, foreign = LocalMap.none(), False
    if row_of or named:
        grey = eight_bit(image)
        enough = max(fewest + 2, _ENOUGH_CODES * (len(row_of) + sum(map(len, named.values()))))
        for scale, polarity in SEARCHES if image.shape[1] > _LARGE_WIDTH else SEARCHES[2:]:
            candidates = find_circles(grey, scale, polarity)
            codes = read_codes(grey, candidates, polarity)
            ours = {row_of[code]: place for code, place in codes.items() if code in row_of}
            foreign = foreign or len(ours) < len(codes)
            for row, place in _circles_by_marker(grey, candidates, named):
                if place not in ours.values():
                    ours[row] = place
            if len(ours) > len(best):
                best = ours
                maps = candidates.select(np.array(list(ours.values()), dtype=np.int64))
            if len(best) >= enough or (not needed and len(best) >= fewest):
                break
    return np.array(list(best), dtype=np.int64), maps, foreign


def _circles_by_marker(
    grey: NDArray[np.uint8], candidates: LocalMap, named: dict[str, dict[int, int]]
) -> list[tuple[int, int]]:
    """Return (row, candidate) of the circles named by markers: those nearest to their centres."""
    pairs: list[tuple[int, int]] = []
    for dictionary, row_of in named.items():
        for number, quad in detect_markers(grey, dictionary, frozenset(row_of))[0].items():
            side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).mean()
            distance = np.linalg.norm(candidates.centre - quad.mean(axis=0), axis=1)
            outside = np.array(
                [cv2.pointPolygonTest(quad.astype(np.float32), tuple(c), True) < 0
                 for c in candidates.centre], dtype=bool,
            )  # fmt: skip
            near = np.nonzero(outside & (distance < _MARKER_NEIGHBOURHOOD * side))[0]
            if len(near):
                pairs.append((row_of[number], int(near[np.argmin(distance[near])])))
    return pairs
