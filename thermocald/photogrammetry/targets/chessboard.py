"""Corners of chessboards: where four squares meet.

On a ChArUco board they are measured where the orientation from its markers says they are; a plain
chessboard is found as a whole by OpenCV, and numbered from the corner at a black outer square. The
positions are our own fit of a saddle (`corner`).

A test field names corner 17 of a plain board of 9 × 6 inner corners `CHESS:9x6:17`, row by row from
the upper left, whose outer square is black.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.targets.markers import MarkerCorners, measure_corners, to_8_bit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.orientation.identification import Orientation

__all__ = ["chess_code", "find_chessboards", "is_chess", "locate_chess_corners", "parse_chess"]

_CODE = re.compile(r"CHESS:(\d{1,3})x(\d{1,3}):(\d{1,5})")
_QUIET_SHARE = 0.45  # of the distance between corners, where no marker stands nearer
_LARGE_PIXELS = 3_000_000


def is_chess(code: str) -> bool:
    """Whether a test field's code names a corner of a plain chessboard."""
    return code.startswith("CHESS:")


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
    image: NDArray[Any], testfield: TestField, missed: dict[int, str] | None = None
) -> Observations:
    """Find and measure the plain chessboards of a field; `missed` receives {row: reason}."""
    boards: dict[tuple[int, int], dict[int, int]] = {}
    for row, code in enumerate(testfield.codes):
        if is_chess(code):
            columns, rows, number = parse_chess(code)
            boards.setdefault((columns, rows), {})[number] = row
    missed = {} if missed is None else missed
    found = _nothing()
    grey = to_8_bit(image)
    for (columns, rows), row_of in boards.items():
        grid = _find(grey, columns, rows)
        if grid is None:
            missed.update(dict.fromkeys(row_of.values(), "not found"))
            continue
        numbers = np.arange(columns * rows)
        known = np.array([n in row_of for n in numbers.tolist()], dtype=bool)
        along, across = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
        at = grid.reshape(-1, 2)[known]
        before, after = (v.reshape(-1, 2)[known] for v in (across, along))
        size = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
        places = np.array([row_of[n] for n in numbers[known].tolist()], dtype=np.int64)
        corners = MarkerCorners(places, at, at + before, at + after, _QUIET_SHARE * size)
        found = measure_corners(image, corners, missed)
    return found


def _find(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """The inner corners (rows, columns, 2) px of one board, right-handed, from its black corner."""
    scale = 2 if grey.size > _LARGE_PIXELS else 1
    small = grey
    if scale > 1:
        small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
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


def locate_chess_corners(
    testfield: TestField, corners: Sequence[int], orientation: Orientation
) -> MarkerCorners:
    """Where corners of squares (rows of the field) must be, given an orientation, and two edges."""
    rows = np.array(corners, dtype=np.int64)
    first, second, quiet = _edges(testfield, rows)
    points = testfield.points[rows]
    project = orientation.camera.project
    at = project(orientation.exterior, points)
    before, after = (project(orientation.exterior, points + v) for v in (first, second))
    size = np.minimum(*(np.linalg.norm(end - at, axis=1) for end in (before, after)))
    cell = size * quiet / np.maximum(np.linalg.norm(first, axis=1), 1e-9)
    inside = orientation.camera.sensor.contains(np.nan_to_num(at, nan=-1e9), 3.0)
    inside &= np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    return MarkerCorners(rows[inside], at[inside], before[inside], after[inside], cell[inside])


def _edges(testfield: TestField, rows: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """For each corner two directions (n, 3) mm along its edges, to neighbours, and how far (n,) mm
    from the edges nothing but squares is.
    """
    points = testfield.points[rows]
    kinds = np.array(testfield.kinds)
    corners = testfield.points[kinds == "chess_corner"]
    markers = testfield.points[kinds == "marker_corner"]
    first, second = np.zeros_like(points), np.zeros_like(points)
    quiet = np.zeros(len(points))
    for i, point in enumerate(points):
        offset = corners - point
        distance = np.linalg.norm(offset, axis=1)
        order = np.argsort(distance, kind="stable")[1:9]
        first[i] = offset[order[0]] if len(order) else (1.0, 0, 0)
        for other in order.tolist():
            cosine = offset[other] @ first[i] / (distance[other] * np.linalg.norm(first[i]))
            if abs(cosine) < 0.3:
                second[i] = offset[other]
                break
        quiet[i] = _QUIET_SHARE * float(np.linalg.norm(first[i]))
        if len(markers):
            # a marker's corner lies on the diagonal of its square
            nearest = float(np.linalg.norm(markers - point, axis=1).min())
            quiet[i] = min(quiet[i], nearest / np.sqrt(2))
    return first, second, quiet


def _nothing() -> Observations:
    none = np.zeros(0)
    return Observations(
        np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)), none,
        dict.fromkeys(("blur", "contrast", "grey", "noise", "saturation"), none),
    )  # fmt: skip
