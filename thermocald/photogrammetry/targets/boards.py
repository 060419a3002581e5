"""Standard boards: ChArUco boards, chessboards, AprilGrids, ring codes of other programs.

Coordinates are mm on the board, X right, Y up, Z towards the viewer. Unless a standard deviation is
given, that of a print is assumed: 0.1 mm, 1 mm per metre, and half a millimetre of flatness.

The corners where four squares meet are measured by fitting a saddle (`corner`). On a ChArUco board
the orientation from its markers predicts their places. A plain chessboard is found as a whole by
OpenCV. A test field names corner 17 of a plain board of 9 × 6 inner corners `CHESS:9x6:17`, counted
row by row from the upper left one, whose outer square is black.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.arrays import eight_bit
from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.corner import Corners
from thermocald.photogrammetry.targets.markers import (
    LARGE_PIXELS,
    SMALLEST_SIDE_PX,
    corner_shift,
    halved,
    marker_rows,
    parse_marker,
)
from thermocald.photogrammetry.targets.markers import dictionary as markers_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

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
    sigma: float | None = None,
    diameter: float = np.nan,
) -> TestField:
    """Build a board of targets at points (n, 3) mm.

    sigma: of each coordinate, mm, None for a print; diameter: of discs, mm.
    """
    if not 4 <= len(names) <= _MOST_TARGETS:
        raise TestFieldError(f"a board of {len(names)} targets: it must have 4 to {_MOST_TARGETS}")
    spread = np.hypot(_SIGMA_PRINT, _SIGMA_SCALE * (points - points.mean(axis=0)))
    spread[:, 2] = _SIGMA_FLAT
    sigmas = spread if sigma is None else sigma
    return TestField.build(names, points, sigmas, diameter, kinds, codes)


def _markers(name: str, last: int) -> Any:
    """Return a dictionary of OpenCV's; TestFieldError unless it has the marker of number `last`."""
    found = markers_of(name)
    if last >= (count := len(found.bytesList)):
        raise TestFieldError(
            f"{name} has {count} markers, 0 to {count - 1}, but the board needs them up to {last}"
        )
    return found


def aprilgrid(
    columns: int,
    rows: int,
    size: float,
    spacing: float,
    *,
    first: int = 0,
    sigma: float | None = None,
) -> TestField:
    """Build Kalibr's AprilGrid.

    size: mm, of a tag with its black border; spacing: between tags, as a ratio of the size. Tag
    `first` is at the lower left; numbers increase to the right, then upwards. The corners of an
    upright tag are numbered clockwise from the bottom right one (`targets.markers`).
    """
    if not (1 <= columns <= 100 and 1 <= rows <= 100 and size > 0 and 0 <= spacing <= 1):
        raise TestFieldError(
            f"an AprilGrid of {columns} × {rows} tags of {size:g} mm, spacing {spacing:g}: it must "
            "have 1 to 100 tags each way, of more than 0 mm, and a spacing (a ratio) from 0 to 1"
        )
    _markers("DICT_APRILTAG_36h11", first + columns * rows - 1)
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
    """Build a ChArUco board of columns × rows squares as OpenCV and calib.io draw it.

    square, marker: sides, mm; legacy: the pattern of OpenCV before 4.6, with the other colour of
    the upper left square if the number of rows is even. Targets are the corners of squares
    (C0, C1 …, OpenCV's numbers) and of markers (M0.0 …).
    """
    if not (2 <= columns <= 100 and 2 <= rows <= 100 and 0 < marker < square):
        raise TestFieldError(
            f"a ChArUco board of {columns} × {rows} squares of {square:g} mm with markers of "
            f"{marker:g} mm: it must have 2 to 100 squares, and markers smaller than squares"
        )
    numbers = np.arange(columns * rows // 2, dtype=np.int32)
    markers = _markers(dictionary, int(numbers[-1]))
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, markers, numbers)
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
    # y of OpenCV's board is down
    upright = np.concatenate(points) * np.array([1.0, -1.0, 0.0]) + np.array([0, rows * square, 0])
    return board_of(names, upright, kinds, codes, sigma)


def chessboard(
    columns: int, rows: int, square: float, square_y: float | None = None,
    *, sigma: float | None = None,
) -> TestField:  # fmt: skip
    """Build a plain chessboard of columns × rows inner corners, whose upper left square is black.

    square, square_y: sides, mm. TestFieldError for a board that looks the same upside down.
    """
    if not (3 <= columns <= 100 and 3 <= rows <= 100 and square > 0):
        raise TestFieldError(
            f"a chessboard of {columns} × {rows} inner corners, squares of {square:g} mm: it must "
            "have 3 to 100 corners each way, and squares above 0 mm"
        )
    height = square if square_y is None else square_y
    x, y = np.meshgrid(np.arange(1, columns + 1) * square, np.arange(rows, 0, -1) * height)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    names = [f"C{i}" for i in range(len(points))]
    codes = [chess_code(columns, rows, i) for i in range(len(points))]
    return board_of(names, points, ["chess_corner"] * len(points), codes, sigma)


@dataclass(frozen=True, slots=True)
class Board:
    """A board of columns × rows: squares of a ChArUco board, inner corners of a chessboard, tags.

    square, height mm: sides of a square (not of an AprilGrid), height None if they are equal;
    marker mm: side of a marker or tag with its black border; spacing: gap between tags over their
    side; dictionary: of a ChArUco board, by its OpenCV name; legacy: ChArUco as drawn by OpenCV
    before 4.6; first: number of the first tag.
    """

    kind: str  # charuco, chessboard or aprilgrid
    columns: int
    rows: int
    square: float = 0.0
    marker: float = 0.0
    spacing: float = 0.3
    dictionary: str = "DICT_5X5_1000"
    legacy: bool = False
    first: int = 0
    height: float | None = None

    @property
    def has_tags(self) -> bool:
        """Whether the board is an AprilGrid, whose sizes are those of its tags."""
        return self.kind == "aprilgrid"

    def field(self, sigma: float | None = None) -> TestField:
        """Return the test field, origin at the board's lower left; sigma: mm, None for a print."""
        counts = self.columns, self.rows
        if self.has_tags:
            return aprilgrid(*counts, self.marker, self.spacing, first=self.first, sigma=sigma)
        if self.kind == "chessboard":
            return chessboard(*counts, self.square, self.height, sigma=sigma)
        sides = self.square, self.marker
        return charuco(*counts, *sides, self.dictionary, legacy=self.legacy, sigma=sigma)

    @property
    def name(self) -> str:
        """The kind and size of the board, in words."""
        kind, unit = {
            "charuco": ("a ChArUco board", "squares"),
            "chessboard": ("a chessboard", "inner corners"),
            "aprilgrid": ("an AprilGrid", "tags"),
        }[self.kind]
        return f"{kind} of {self.columns} × {self.rows} {unit}"

    @property
    def measures(self) -> str:
        """The dimensions of squares, markers or tags, in words."""
        if self.has_tags:
            return f"tags {self.marker:g} mm, {self.spacing * self.marker:g} mm apart"
        sides = f"{self.square:g}" if self.height is None else f"{self.square:g} × {self.height:g}"
        words = f"squares {sides} mm"
        if self.kind == "charuco":
            words += f", markers {self.marker:g} mm of {self.dictionary}"
        return words + (", as OpenCV drew it before 4.6" if self.legacy else "")

    @property
    def lattice(self) -> tuple[int, int, float, float]:
        """The columns and rows of the black squares that are no markers, their step, and side."""
        more = self.kind != "charuco"
        gap = self.spacing * self.marker
        step, side = (self.marker + gap, gap) if self.has_tags else (self.square, self.square)
        return self.columns + more, self.rows + more, step, side

    @property
    def black(self) -> tuple[float, float]:
        """The width and height of the black area, mm."""
        columns, rows, step, side = self.lattice
        return (columns - 1) * step + side, (rows - 1) * step + side

    def squares(self) -> Iterator[tuple[float, float, float]]:
        """Yield the black squares that are not markers: lower left x, y and side, mm."""
        columns, rows, step, side = self.lattice
        low = -side if self.has_tags else 0.0
        white = self.legacy and self.rows % 2 == 0  # the upper left one
        for j, i in product(range(rows), range(columns)):
            if self.has_tags or (i + rows - 1 - j) % 2 == white:
                yield i * step + low, j * step + low, side


def numbered_rings(
    numbers: Sequence[int],
    points: Array,
    bits: int,
    diameter: float,
    sigma: float | None = None,
) -> TestField:
    """Build ring-coded targets numbered as by Metashape and AICON: the n-th code of `bits` bits.

    numbers: n, from 1; points (n, 3) mm; diameter: of the inner disc, mm; sigma: as in `board_of`.
    """
    codes = ring_code.codes(bits)
    for number in numbers:
        if not 1 <= number <= len(codes):
            raise TestFieldError(
                f"target {number}: there are {len(codes)} codes of {bits} bits, from 1"
            )
    return board_of(
        [str(n) for n in numbers], points, ["circle"] * len(numbers),
        [ring_code.write(bits, codes[n - 1]) for n in numbers], sigma, diameter,
    )  # fmt: skip


_CODE = re.compile(r"CHESS:(\d{1,3})x(\d{1,3}):(\d{1,5})")
_QUIET_SHARE = 0.45  # of the distance between corners, if no marker is nearer
_QUADRANGLES_PIXELS = 700_000  # a search without a board takes minutes in a larger image


def chess_code(columns: int, rows: int, number: int) -> str:
    """Return an inner corner's code; TestFieldError for a board that looks the same upside down."""
    if (columns + rows) % 2 == 0:
        raise TestFieldError(
            f"a chessboard of {columns} × {rows} inner corners looks the same turned by 180°, and "
            "cannot be numbered; use one with an even and an odd count, or a ChArUco board"
        )
    return f"CHESS:{columns}x{rows}:{number}"


def locate_chessboards(
    image: NDArray[Any], testfield: TestField, missed: dict[int, str]
) -> Corners:
    """Find a field's plain chessboards; `missed` receives {row: reason} for corners not found."""
    boards: dict[tuple[int, int], dict[int, int]] = {}
    for row, code in enumerate(testfield.codes):
        if not code.startswith("CHESS:"):
            continue
        parsed = _CODE.fullmatch(code)
        if parsed is None:
            raise TestFieldError(f"{code!r} is not a corner of a chessboard: write CHESS:9x6:17")
        columns, rows, number = (int(n) for n in parsed.groups())
        if not (columns >= 3 and rows >= 3 and number < columns * rows):
            raise TestFieldError(
                f"{code!r}: a board has at least 3 × 3 inner corners, numbered from 0"
            )
        chess_code(columns, rows, number)  # refuses a board that looks the same upside down
        boards.setdefault((columns, rows), {})[number] = row
    found = Corners.none()
    grey = eight_bit(image)
    for (columns, rows), row_of in boards.items():
        grid = _find_board(grey, columns, rows)
        if grid is None:
            missed.update(dict.fromkeys(row_of.values(), "not found"))
            continue
        numbers = sorted(row_of)
        at, across, along = (
            v.reshape(-1, 2)[numbers] for v in (grid, *np.gradient(grid, axis=(0, 1)))
        )
        size = np.minimum(np.linalg.norm(across, axis=1), np.linalg.norm(along, axis=1))
        places = np.array([row_of[n] for n in numbers], dtype=np.int64)
        found = found.joined(Corners(places, at, at + across, at + along, _QUIET_SHARE * size))
    return found


def _find_board(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """Return a board's inner corners (rows, columns, 2) px, right-handed, from its black corner."""
    scale, small, size = 1, grey, (columns, rows)
    if grey.size > LARGE_PIXELS:
        scale, small = 2, halved(grey)
    done, corners = cv2.findChessboardCornersSB(small, size, flags=0)
    if not done:  # an oblique or blurred board: by its quadrangles
        while small.size > _QUADRANGLES_PIXELS:
            scale, small = 2 * scale, halved(small)
        done, corners = cv2.findChessboardCorners(small, size)
    if not done:
        return None
    grid = scale * corners.reshape(rows, columns, 2).astype(float) + (scale - 1) / 2
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid = grid[::-1]
    # black: the square outside the first corner is darker than its neighbours
    right, down = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
    around = [-right - down, right + down, right - down, down - right]
    at = np.rint(grid[0, 0] + 0.4 * np.array(around))
    x, y = np.clip(at, 0, np.array(grey.shape[::-1]) - 1).astype(int).T
    values = grey[y, x].astype(float)
    begins_black = values[:2].sum() < values[2:].sum()
    return grid if begins_black else np.ascontiguousarray(grid[::-1, ::-1])


def predict_corners(
    testfield: TestField, rows: Sequence[int], orientation: Orientation, found: Corners
) -> Corners:
    """Predict the corners (rows of the field) in the image from an orientation.

    found: the detected markers, for the width of their border. A marker's corner is left out if a
    neighbour is not in the field, or if the marker is too small in the image.
    """
    at = np.array(rows, dtype=np.int64)
    chess = np.array([testfield.kinds[row] == "chess_corner" for row in at], dtype=bool)
    sides = np.full((2, len(at), 3), np.nan)
    side = np.linalg.norm(found.before - found.places, axis=1)
    border = float(np.median(found.quiet / np.maximum(side, 1e-9))) if len(found) else 0.1
    quiet = np.full(len(at), border)  # as a share of the shorter side
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
    """Return for each corner two vectors (2, n, 3) mm along its edges to its neighbours, and the
    width (n,) around the edges with only squares, as a share of the first vector.
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
            # a marker's corner is on the diagonal of its square
            nearest = float(np.linalg.norm(markers - point, axis=1).min())
            quiet[i] = min(quiet[i], nearest / np.sqrt(2) / length)
    return sides, quiet
