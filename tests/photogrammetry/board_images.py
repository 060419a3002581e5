"""Boards drawn as by other programs: AprilGrids, ChArUco boards, chessboards."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import cv2
import numpy as np

from tests.photogrammetry.printed_sheets import Sheet

APRIL_TAG_0 = 0xD5D628584
"""Tag 0 of 36h11 as published: bits from the upper left, 1 is white."""


def _sheet(image: np.ndarray, px_per_mm: float, margin_px: int) -> Sheet:
    """Return the board with a white margin; the lower left corner of the board is the origin."""
    image = np.pad(image, margin_px, constant_values=255)
    size = (image.shape[1] / px_per_mm, image.shape[0] / px_per_mm)
    origin = np.array([-margin_px / px_per_mm, -margin_px / px_per_mm, 0.0])
    return Sheet(image, size, origin, np.eye(3)[:2])


def upright_tag(number: int, px: int, border: int) -> np.ndarray:
    """Draw a tag of 36h11 as published; some versions of OpenCV turn it by 180°."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    first = cv2.aruco.generateImageMarker(family, 0, 8)[1:7, 1:7] > 127
    upright = [bool(APRIL_TAG_0 >> (35 - i) & 1) for i in range(36)]
    turned = first.ravel().tolist() != upright
    assert (first[::-1, ::-1] if turned else first).ravel().tolist() == upright
    tag = cv2.aruco.generateImageMarker(family, number, px, borderBits=border)
    return tag[::-1, ::-1] if turned else tag


def aprilgrid_sheet(columns: int, rows: int, size: float, spacing: float, px: int = 300) -> Sheet:
    """Draw Kalibr's AprilGrid: borders of two bits, squares at the corners, tag 0 at lower left."""
    gap = round(spacing * px)
    step = px + gap
    image = np.full((rows * step + gap, columns * step + gap), 255, np.uint8)
    for j in range(rows):
        for i in range(columns):
            x, y = gap + i * step, len(image) - gap - j * step - px
            image[y : y + px, x : x + px] = upright_tag(columns * j + i, px, 2)
            for a, b in product((x - gap, x + px), (y - gap, y + px)):
                image[b : b + gap, a : a + gap] = 0
    sheet = _sheet(image, px / size, gap)
    # the origin is the lower left corner of tag 0
    return replace(sheet, origin=sheet.origin - np.array([1, 1, 0]) * gap * size / px)


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
    return _sheet(np.kron(cells, np.ones((100, 100), np.uint8)), 100 / square, 100)
