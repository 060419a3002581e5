"""Printed boards of other programs: OpenCV detects them in the PDF, the program in photographs."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.commands import invoke, succeed
from tests.marks import mostly_slow
from tests.photogrammetry.printed_sheets import rasterised
from thermocald.errors import ThermocaldError
from thermocald.output.testfield.sheets import filled
from thermocald.photogrammetry.frame.measurement import measure
from thermocald.photogrammetry.targets.boards import Board
from thermocald.photogrammetry.targets.markers import corner_shift
from thermocald.store.recording.testfield_file import read_testfield

DPI = 200.0
BOARDS = {
    "charuco": ("--charuco", "11x8", "--dictionary", "DICT_5X5_250", "--paper", "A4"),
    "old charuco": ("--charuco", "9x6", "--dictionary", "DICT_4X4_50", "--legacy"),
    "chessboard": ("--chessboard", "9x6", "--square", 22.0, "--paper", "A4"),
    "aprilgrid": ("--aprilgrid", "4x5", "--marker", 28.0, "--paper", "A4", "--spacing", 0.3),
}


def found_by_opencv(kind, image, document):
    """{name of the target: place px}, as OpenCV has it in the page itself."""
    if kind == "chessboard":
        done, corners = cv2.findChessboardCornersSB(image, (9, 6))
        assert done
        upright = sorted(corners.reshape(6, 9, 2).tolist(), key=lambda row: row[0][1])
        return {f"C{i}": p for i, p in enumerate(q for row in upright for q in sorted(row))}
    if kind == "aprilgrid":
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = 2
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        corners, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(image)
        shift = corner_shift("DICT_APRILTAG_36h11")
        return {
            f"{number}.{k}": quad[0, (k - shift) % 4]
            for number, quad in zip(ids.ravel().tolist(), corners, strict=True)
            for k in range(4)
        }
    columns, rows, name = (11, 8, "DICT_5X5_250") if kind == "charuco" else (9, 6, "DICT_4X4_50")
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    sides = document["square"], document["marker"]
    board = cv2.aruco.CharucoBoard((columns, rows), *sides, family)
    board.setLegacyPattern(kind == "old charuco")
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    numbers = ids.ravel().tolist()
    return {f"C{i}": p for i, p in zip(numbers, corners.reshape(-1, 2), strict=True)}


@pytest.mark.parametrize("kind", mostly_slow(BOARDS, "charuco", "aprilgrid"))
def test_a_printed_board_is_found_where_its_csv_says(tmp_path, kind):
    result = succeed("testfield", "print", *BOARDS[kind], "--out", tmp_path, "--json", "-")
    document = json.loads(result.stdout)
    field = read_testfield(tmp_path / "testfield.csv")
    image = rasterised(tmp_path / "testfield.pdf", 0, DPI)

    theirs = found_by_opencv(kind, image, document)
    expected = [n for n, k in zip(field.names, field.kinds, strict=True) if k == "chess_corner"]
    assert set(theirs) == set(expected or field.names)
    plane = np.column_stack([field.points[:, :2], np.ones(len(field))])

    def errors(rows, seen):
        placed = np.linalg.lstsq(plane[rows], seen, rcond=None)[0]
        # the page's scale with y down: only the board's position is free
        assert placed[:2] == pytest.approx(np.diag([1, -1]) * DPI / 25.4, rel=2e-3, abs=0.01)
        return np.linalg.norm(plane[rows] @ placed - seen, axis=1)

    off = errors([field.index[name] for name in theirs], np.array(list(theirs.values())))
    # OpenCV does not refine tags: accurate to a pixel or two
    assert off.max() < (2.5 if kind == "aprilgrid" else 0.5)
    # the program finds it too, in a picture whose paper is at three quarters of full scale
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = measure((30 + 0.63 * small).astype(np.uint8), field)
    assert found.status.ok
    assert sorted(found.observations.targets) == list(range(len(field)))
    off = errors(found.observations.targets, 2 * found.observations.points + 0.5)
    # the rasteriser rounds the sides of squares to whole pixels
    assert np.sqrt(np.mean(off**2)) < 0.6


def test_a_board_is_as_large_as_the_paper_allows():
    for kind, counts in (("charuco", (11, 8)), ("chessboard", (9, 6)), ("aprilgrid", (6, 6))):
        for page in ((297.0, 420.0), (210.0, 297.0), (841.0, 1189.0)):
            black = filled(Board(kind, *counts), page).black
            for length, side in zip(sorted(black), page, strict=True):
                assert 0.5 * (side - 30.0) < length < side - 30.0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--charuco", "11x8", "--square", 60), "larger paper"),
        (("--chessboard", "8x6"), "looks the same"),
        (("--chessboard", "9by6"), "COLUMNSxROWS"),
        (("--chessboard", "9x6", "--aprilgrid", "6x6"), "one board at a time"),
        (("--chessboard", "9x6", "--marker", 20), "a chessboard has no tags"),
        (("--aprilgrid", "6x6", "--square", 20), "that of its tags"),
        (("--charuco", "11x8", "--dictionary", "DICT_4X4_50", "--paper", "A0", "--marker", 99),
         "smaller than squares"),
        (("--charuco", "12x12", "--dictionary", "DICT_4X4_50", "--paper", "A0"), "50 markers"),
        (("--aprilgrid", "900x900"), "1 to 100 tags"),
        (("--aprilgrid", "30x20", "--paper", "A0"), "587 markers.* up to 599"),
        (("--charuco", "11x8", "--square", 60, "--marker", 60), "smaller than squares"),
        (("--chessboard", "999x998"), "3 to 100"),
    ],
)  # fmt: skip
def test_boards_that_cannot_be_are_refused(tmp_path, options, reason):
    with pytest.raises(ThermocaldError, match=reason):
        invoke("testfield", "print", *options, "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()
