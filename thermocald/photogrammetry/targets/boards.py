"""Boards that people own: ChArUco boards, chessboards, AprilGrids, rings of other programs.

Coordinates are mm on the board, X right, Y up, Z towards the viewer. A print is worth what its
printer is worth: 0.1 mm, 1 mm in a metre, and paper that lies flat to half a millimetre, unless a
better standard deviation is stated.

The corners where four squares meet are measured on a ChArUco board where the orientation from its
markers says they are; a plain chessboard is found as a whole by OpenCV, and numbered from the
corner at a black outer square. The positions are our own fit of a saddle (`corner`). A test field
names corner 17 of a plain board of 9 × 6 inner corners `CHESS:9x6:17`, row by row from the upper
left, whose outer square is black.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.corner import Corners, measure_corners
from thermocald.photogrammetry.targets.markers import (
    LARGE_PIXELS,
    SMALLEST_SIDE_PX,
    corner_shift,
    halved,
    marker_rows,
    parse_marker,
    to_8_bit,
)
from thermocald.photogrammetry.targets.markers import dictionary as markers_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.orientation import Orientation

_SIGMA_PRINT, _SIGMA_SCALE, _SIGMA_FLAT = 0.1, 0.001, 0.5
_MOST_TARGETS = 20_000


def board_of(
    names: Sequence[str],
    points: Array,
    kinds: Sequence[str],
    codes: Sequence[str],
    sigma: float | Array | None = None,
    diameter: float = np.nan,
) -> TestField:
    """Build a board of targets at points (n, 3) mm; sigma: mm, of each coordinate, None for a
    print; diameter: of discs, mm.
    """
    if not 4 <= len(names) <= _MOST_TARGETS:
        raise TestFieldError(f"a board of {len(names)} targets: 4 to {_MOST_TARGETS} are possible")
    if sigma is None:
        local = points - points.mean(axis=0)
        spread = np.hypot(_SIGMA_PRINT, _SIGMA_SCALE * local)
        spread[:, 2] = _SIGMA_FLAT
        sigma = spread
    return TestField.build(names, points, sigma, diameter, kinds, codes)


def aprilgrid(
    columns: int,
    rows: int,
    size: float,
    spacing: float,
    *,
    first: int = 0,
    sigma: float | None = None,
) -> TestField:
    """Kalibr's AprilGrid: size mm of a tag with its black border, spacing as a ratio of it.

    Tag `first` is at the lower left; numbers grow to the right, then upwards. The corners of an
    upright tag are numbered from its bottom right, clockwise (`targets.markers`).
    """
    if not (columns > 0 and rows > 0 and size > 0 and 0 <= spacing <= 1):
        raise TestFieldError(
            f"an AprilGrid of {columns} × {rows} tags of {size:g} mm, spacing {spacing:g} of it: "
            "counts and size must be above 0, the spacing (a ratio) between 0 and 1"
        )
    if columns * rows * 4 > _MOST_TARGETS:
        raise TestFieldError(f"{columns} × {rows} tags: at most {_MOST_TARGETS // 4} are possible")
    step = size * (1 + spacing)
    square = np.array([[size, 0.0], [0.0, 0.0], [0.0, size], [size, size]])
    names, points, codes = [], [], []
    for j in range(rows):
        for i in range(columns):
            number = first + columns * j + i
            for k, (x, y) in enumerate(square + np.array([i * step, j * step])):
                names.append(f"{number}.{k}")
                points.append((x, y, 0.0))
                codes.append(f"DICT_APRILTAG_36h11:{number}:{k}")
    kinds = ["marker_corner"] * len(names)
    return board_of(names, np.array(points), kinds, codes, sigma)


def charuco(
    columns: int,
    rows: int,
    square: float,
    marker: float,
    dictionary: str,
    *,
    legacy: bool = False,
    sigma: float | None = None,
) -> TestField:
    """A ChArUco board of columns × rows squares as OpenCV and calib.io draw it.

    square, marker: sides mm; legacy: the pattern of OpenCV before 4.6, whose upper left square is
    another where the number of rows is even. Targets are the corners of squares (C0, C1 …, OpenCV's
    numbers) and of markers (M0.0 …).
    """
    if not (2 <= columns <= 100 and 2 <= rows <= 100 and 0 < marker < square):
        raise TestFieldError(
            f"a ChArUco board of {columns} × {rows} squares of {square:g} mm with markers of "
            f"{marker:g} mm: 2 to 100 squares, and markers smaller than squares"
        )
    known = markers_of(dictionary)
    numbers = np.arange(columns * rows // 2, dtype=np.int32)
    if numbers[-1] >= len(known.bytesList):
        raise TestFieldError(
            f"{dictionary} has {len(known.bytesList)} markers, the board needs up to {numbers[-1]}"
        )
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, known, numbers)
    board.setLegacyPattern(legacy)
    corners = np.asarray(board.getChessboardCorners(), dtype=float)
    names = [f"C{i}" for i in range(len(corners))]
    kinds, codes = ["chess_corner"] * len(corners), [""] * len(corners)
    shift = corner_shift(dictionary)
    points = [corners]
    for number, quad in zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True):
        points.append(np.roll(np.asarray(quad, dtype=float).reshape(4, 3), shift, axis=0))
        names += [f"M{number}.{k}" for k in range(4)]
        kinds += ["marker_corner"] * 4
        codes += [f"{dictionary}:{number}:{k}" for k in range(4)]
    # OpenCV's board has y down
    upright = np.concatenate(points) * np.array([1.0, -1.0, 0.0]) + np.array([0, rows * square, 0])
    return board_of(names, upright, kinds, codes, sigma)


def chessboard(
    columns: int, rows: int, square: float, square_y: float | None = None,
    *, sigma: float | None = None,
) -> TestField:  # fmt: skip
    """A plain chessboard of columns × rows inner corners, squares in mm; its upper left square is
    black. TestFieldError for one that looks the same upside down.
    """
    if not (3 <= columns <= 100 and 3 <= rows <= 100 and square > 0):
        raise TestFieldError(
            f"a chessboard of {columns} × {rows} inner corners of {square:g} mm: 3 to 100 are "
            "possible, and a square above 0"
        )
    high = square if square_y is None else square_y
    x, y = np.meshgrid(np.arange(1, columns + 1) * square, np.arange(rows, 0, -1) * high)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    names = [f"C{i}" for i in range(len(points))]
    codes = [chess_code(columns, rows, i) for i in range(len(points))]
    return board_of(names, points, ["chess_corner"] * len(points), codes, sigma)


def numbered_rings(
    numbers: Sequence[int],
    points: Array,
    bits: int,
    diameter: float,
    *,
    sigmas: Array | None = None,
) -> TestField:
    """Ring-coded targets as Metashape and AICON number them: the n-th code of so many bits.

    numbers (n) from 1 on; points (n, 3), diameter of the inner disc and sigmas mm.
    """
    codes = ring_code.codes(bits)
    for number in numbers:
        if not 1 <= number <= len(codes):
            raise TestFieldError(f"target {number}: there are {len(codes)} codes of {bits} bits")
    return board_of(
        [str(n) for n in numbers], points, ["circle"] * len(numbers),
        [ring_code.write(bits, codes[n - 1]) for n in numbers], sigmas, diameter,
    )  # fmt: skip


_CODE = re.compile(r"CHESS:(\d{1,3})x(\d{1,3}):(\d{1,5})")
_QUIET_SHARE = 0.45  # of the distance between corners, where no marker stands nearer


def chess_code(columns: int, rows: int, number: int) -> str:
    """The code of an inner corner; TestFieldError for boards that look the same upside down."""
    if (columns + rows) % 2 == 0:
        raise TestFieldError(
            f"a chessboard of {columns} × {rows} inner corners looks the same turned by 180°: its "
            "corners cannot be numbered. Take one with an even and an odd count, or a ChArUco board"
        )
    return f"CHESS:{columns}x{rows}:{number}"


def parse_chess(code: str) -> tuple[int, int, int]:
    """`CHESS:9x6:17` → (9, 6, 17); TestFieldError for what is not such a code."""
    found = _CODE.fullmatch(code)
    if found is None:
        raise TestFieldError(f"{code!r} is not a corner of a chessboard: write CHESS:9x6:17")
    columns, rows, number = (int(n) for n in found.groups())
    if not (columns >= 3 and rows >= 3 and number < columns * rows):
        raise TestFieldError(f"{code!r}: a board has 3 × 3 inner corners at least, the first is 0")
    chess_code(columns, rows, number)
    return columns, rows, number


def find_chessboards(
    image: NDArray[Any], testfield: TestField, missed: dict[int, str]
) -> Observations:
    """Find and measure the plain chessboards of a field; `missed` receives {row: reason}."""
    boards: dict[tuple[int, int], dict[int, int]] = {}
    for row, code in enumerate(testfield.codes):
        if code.startswith("CHESS:"):
            columns, rows, number = parse_chess(code)
            boards.setdefault((columns, rows), {})[number] = row
    found = Observations.none()
    grey = to_8_bit(image)
    for (columns, rows), row_of in boards.items():
        grid = _find(grey, columns, rows)
        if grid is None:
            missed.update(dict.fromkeys(row_of.values(), "not found"))
            continue
        numbers = sorted(row_of)
        at, across, along = (
            v.reshape(-1, 2)[numbers] for v in (grid, *np.gradient(grid, axis=(0, 1)))
        )
        size = np.minimum(np.linalg.norm(across, axis=1), np.linalg.norm(along, axis=1))
        places = np.array([row_of[n] for n in numbers], dtype=np.int64)
        corners = Corners(places, at, at + across, at + along, _QUIET_SHARE * size)
        found = found.joined(measure_corners(image, corners, missed))
    return found


def _find(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """The inner corners (rows, columns, 2) px of one board, right-handed, from its black corner."""
    scale = 2 if grey.size > LARGE_PIXELS else 1
    small = halved(grey) if scale > 1 else grey
    size = (columns, rows)
    done, corners = cv2.findChessboardCornersSB(small, size, flags=0)
    if not done:  # oblique or soft boards: by the quadrangles
        done, corners = cv2.findChessboardCorners(small, size)
    if not done:
        return None
    grid = scale * corners.reshape(rows, columns, 2).astype(float) + (scale - 1) / 2
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid = grid[::-1]
    return grid if _begins_black(grey, grid) else np.ascontiguousarray(grid[::-1, ::-1])


def _begins_black(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Whether the square outside of the first corner is darker than its neighbours."""
    right, down = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
    diagonal = [grid[0, 0] - 0.4 * (right + down), grid[0, 0] + 0.4 * (right + down)]
    beside = [grid[0, 0] + 0.4 * (right - down), grid[0, 0] - 0.4 * (right - down)]

    def mean(places: list[Array]) -> float:
        at = np.array(places)
        at = np.clip(np.rint(at), 0, np.array(grey.shape[::-1]) - 1).astype(int)
        return float(grey[at[:, 1], at[:, 0]].mean())

    return mean(diagonal) < mean(beside)


def predict_corners(
    testfield: TestField, rows: Sequence[int], orientation: Orientation, found: Corners
) -> Corners:
    """Predict where corners (rows of the field) are by an orientation, those in the image.

    found: the markers that were detected, for the width of their border. A marker's corner of which
    a neighbour is not in the field, or that is seen small, is left out.
    """
    at = np.array(rows, dtype=np.int64)
    chess = np.array([testfield.kinds[row] == "chess_corner" for row in at], dtype=bool)
    sides = np.full((2, len(at), 3), np.nan)
    side = np.linalg.norm(found.before - found.places, axis=1)
    border = float(np.median(found.quiet / np.maximum(side, 1e-9))) if len(found) else 0.1
    quiet = np.full(len(at), border)  # over the shorter side
    sides[:, chess], quiet[chess] = _squares(testfield, at[chess])
    points = testfield.points[at]
    row_of = {(n, *key): row for n, m in marker_rows(testfield).items() for key, row in m.items()}
    for i in np.flatnonzero(~chess):
        name, marker, k = parse_marker(testfield.codes[at[i]])
        keys = [(name, marker, ((k or 0) + step) % 4) for step in (-1, 1)]
        if all(key in row_of for key in keys):
            sides[:, i] = testfield.points[[row_of[key] for key in keys]] - points[i]
    project = orientation.camera.project
    places, before, after = (
        project(orientation.exterior, p) for p in (points, points + sides[0], points + sides[1])
    )
    size = np.minimum(*(np.linalg.norm(end - places, axis=1) for end in (before, after)))
    inside = orientation.camera.sensor.contains(np.nan_to_num(places, nan=-1e9), 3.0)
    inside &= np.isfinite(size) & (chess | (size >= SMALLEST_SIDE_PX))
    return Corners(
        at[inside], places[inside], before[inside], after[inside], (quiet * size)[inside]
    )


def _squares(testfield: TestField, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """For each corner two directions (2, n, 3) mm along its edges, to neighbours, and how far (n,)
    from the edges nothing but squares is, over the first of them.
    """
    points = testfield.points[rows]
    kinds = np.array(testfield.kinds)
    corners = testfield.points[kinds == "chess_corner"]
    markers = testfield.points[kinds == "marker_corner"]
    sides = np.zeros((2, *points.shape))
    quiet = np.full(len(points), _QUIET_SHARE)
    for i, point in enumerate(points):
        offset = corners - point
        distance = np.linalg.norm(offset, axis=1)
        order = np.argsort(distance, kind="stable")[1:9]
        sides[0, i] = offset[order[0]] if len(order) else (1.0, 0, 0)
        length = max(float(np.linalg.norm(sides[0, i])), 1e-9)
        for other in order.tolist():
            if abs(offset[other] @ sides[0, i] / (distance[other] * length)) < 0.3:
                sides[1, i] = offset[other]
                break
        if len(markers):
            # a marker's corner lies on the diagonal of its square
            nearest = float(np.linalg.norm(markers - point, axis=1).min())
            quiet[i] = min(quiet[i], nearest / np.sqrt(2) / length)
    return sides, quiet
