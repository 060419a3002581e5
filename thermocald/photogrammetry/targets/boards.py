"""Test fields that people own: ChArUco boards, chessboards, AprilGrids, rings of other programs.

Coordinates are mm on the board, X right, Y up, Z towards the viewer. A print is worth what its
printer is worth: 0.1 mm, 1 mm in a metre, and paper that lies flat to half a millimetre, unless a
better standard deviation is stated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.chessboard import chess_code
from thermocald.photogrammetry.targets.markers import corner_shift
from thermocald.photogrammetry.targets.markers import dictionary as markers_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array

__all__ = ["aprilgrid", "board_of", "charuco", "chessboard", "numbered_rings"]

_SIGMA_PRINT, _SIGMA_SCALE, _SIGMA_FLAT = 0.1, 0.001, 0.5
_MOST_TARGETS = 20_000


def board_of(
    names: Sequence[str],
    points: Array,
    kinds: Sequence[str],
    codes: Sequence[str],
    sigma: float | None = None,
) -> TestField:
    """A board from targets at points (n, 3) mm; sigma: mm, of each coordinate, None for a print."""
    if not 4 <= len(names) <= _MOST_TARGETS:
        raise TestFieldError(f"a board of {len(names)} targets: 4 to {_MOST_TARGETS} are possible")
    if sigma is None:
        local = points - points.mean(axis=0)
        sigmas = np.hypot(_SIGMA_PRINT, _SIGMA_SCALE * local)
        sigmas[:, 2] = _SIGMA_FLAT
    else:
        sigmas = np.full(points.shape, sigma)
    return TestField.build(names, points, sigmas, np.nan, kinds, codes)


def aprilgrid(
    columns: int,
    rows: int,
    size: float,
    spacing: float,
    *,
    first: int = 0,
    dictionary: str = "DICT_APRILTAG_36h11",
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
                codes.append(f"{dictionary}:{number}:{k}")
    kinds = ["marker_corner"] * len(names)
    return board_of(names, np.array(points), kinds, codes, sigma)


def charuco(
    columns: int,
    rows: int,
    square: float,
    marker: float,
    dictionary: str,
    *,
    first: int = 0,
    legacy: bool = False,
    sigma: float | None = None,
) -> TestField:
    """A ChArUco board of columns × rows squares as OpenCV and calib.io draw it.

    square, marker: sides mm; first: number of the first marker; legacy: the pattern of OpenCV
    before 4.6, whose upper left square is another where the number of rows is even. Targets are the
    corners of squares (C0, C1 …, OpenCV's numbers) and of markers (M0.0 …).
    """
    import cv2

    if not (2 <= columns <= 100 and 2 <= rows <= 100 and 0 < marker < square):
        raise TestFieldError(
            f"a ChArUco board of {columns} × {rows} squares of {square:g} mm with markers of "
            f"{marker:g} mm: 2 to 100 squares, and markers smaller than squares"
        )
    known = markers_of(dictionary)
    numbers = np.arange(first, first + columns * rows // 2, dtype=np.int32)
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
    field = board_of(
        [str(n) for n in numbers], points, ["circle"] * len(numbers),
        [ring_code.write(bits, codes[n - 1]) for n in numbers],
    )  # fmt: skip
    spread = field.sigmas if sigmas is None else sigmas
    return TestField.build(field.names, points, spread, diameter, field.kinds, field.codes)
