"""Boards drawn as by other programs: ChArUco boards, chessboards."""

from __future__ import annotations

import cv2
import numpy as np

from tests.photogrammetry.printed_sheets import Sheet


def _sheet(image: np.ndarray, px_per_mm: float, margin_px: int) -> Sheet:
    """Return the board with a white margin; the lower left corner of the board is the origin."""
    image = np.pad(image, margin_px, constant_values=255)
    size = (image.shape[1] / px_per_mm, image.shape[0] / px_per_mm)
    origin = np.array([-margin_px / px_per_mm, -margin_px / px_per_mm, 0.0])
    return Sheet(image, size, origin, np.eye(3)[:2])


def charuco_sheet(
    columns: int, rows: int, square: float, marker: float, name: str, legacy: bool
) -> Sheet:
    """Draw OpenCV's ChArUco board."""
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, family)
    board.setLegacyPattern(legacy)
    px = 240
    return _sheet(board.generateImage((columns * px, rows * px), marginSize=0), px / square, 100)


def chessboard_sheet(columns: int, rows: int, square: float) -> Sheet:
    """Draw a chessboard with columns × rows inner corners, its upper left square black."""
    y, x = np.mgrid[: rows + 1, : columns + 1]
    cells = (255 * ((x + y) % 2)).astype(np.uint8)
    return _sheet(np.kron(cells, np.ones((240, 240), np.uint8)), 240 / square, 100)
