"""Common boards and printed sheets: all targets found, measured and numbered."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.marks import mostly_slow
from tests.photogrammetry import board_images as images
from tests.photogrammetry import exact_rendering
from tests.photogrammetry.exact_rendering import rms
from tests.photogrammetry.fields import PI_CAMERA, draw_marker
from tests.photogrammetry.network_cases import looking_at
from tests.photogrammetry.printed_sheets import photograph, put_up
from tests.photogrammetry.test_markers import jpeg
from thermocald.errors import TestFieldError
from thermocald.output.testfield.sheets import TRIM, Design, paper_size, print_testfield
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.frame.measurement import measure
from thermocald.photogrammetry.targets import boards, markers
from thermocald.store.recording.testfield_file import read_board, read_rings

CAMERA = CameraModel(Sensor(820, 616, 0.00448), InteriorOrientation(3.05, 0.02, -0.01, A1=-2e-3))
LARGE = CameraModel(Sensor(1640, 1232, 0.00224), CAMERA.interior)


def stood(field, stand, roll=0.3):
    """Return the orientation of a camera at `stand` from the middle of a field."""
    middle = field.points.mean(axis=0)
    return looking_at(middle + np.array(stand), middle, roll)


APRIL_TAG_0 = 0xD5D628584
"""Tag 0 of 36h11 as published: bits from the upper left, 1 is white."""


def drawn_exactly(field, columns, rows, size, spacing):
    """Draw Kalibr's AprilGrid from polygons of computed area instead of a raster."""
    scene = exact_rendering.Scene(paper=205.0, ink=35.0)
    gap = spacing * size
    for x in np.arange(columns + 1) * (size + gap) - gap:
        for y in np.arange(rows + 1) * (size + gap) - gap:
            scene.patch([(x, y, 0), (x + gap, y, 0), (x + gap, y + gap, 0), (x, y + gap, 0)])
    for tag in range(columns * rows):
        draw_marker(scene, "DICT_APRILTAG_36h11", tag, field.points[4 * tag : 4 * tag + 4], 2)
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("stand", [(0, 0, 300), (-200, 50, 220), (-260, 90, 180)])
def test_standard_deviations_of_an_aprilgrid_are_true_at_any_obliquity(stand):
    """For 384 coordinates with white noise, error over sd is 1 ± 0.036."""
    field = boards.aprilgrid(4, 4, 40.0, 0.3)
    station = stood(field, stand)
    clean = drawn_exactly(field, 4, 4, 40.0, 0.3).render(LARGE, station, blur=0.7, finer=3)
    truth = LARGE.project(station, field.points)
    ratios = []
    for seed in range(3):
        frame = exact_rendering.noisy(clean, np.random.default_rng(seed), 1.5)
        found = measure(frame, field).observations
        assert len(found) >= 60
        ratios.append((found.points - truth[found.targets]) / found.sigmas)
    assert 0.9 < rms(np.concatenate(ratios)) < 1.1


def test_an_aprilgrid_is_found_in_a_coarse_jpeg():
    """OpenCV finds the inner outlines of the wide borders: four corners were measured."""
    field = boards.aprilgrid(4, 4, 40.0, 0.3)
    station = stood(field, (0, 0, 300))
    clean = drawn_exactly(field, 4, 4, 40.0, 0.3).render(LARGE, station, blur=0.6, finer=2)
    frame = exact_rendering.noisy(clean, np.random.default_rng(1), 1.0)
    assert len(measure(jpeg(frame, 30), field).observations) == 64


def test_an_aprilgrid_in_16_bit_with_a_reflection_and_without():
    """OpenCV's corners were too far off in 44 of 64; the light gave an error/sd of 2 to 3."""
    field = boards.aprilgrid(4, 4, 40.0, 0.3)
    station = stood(field, (-200.0, 50.0, 220.0), 0.1)
    clean = drawn_exactly(field, 4, 4, 40.0, 0.3).render(CAMERA, station, finer=2)
    y, x = np.mgrid[:616, :820]
    lamp = 300 * np.exp(-((x - 400) ** 2 + (y - 300) ** 2) / 7200)
    for share in (0.0, 0.2):
        lit = (1 - share) * clean + share * lamp
        frame = exact_rendering.noisy(lit, np.random.default_rng(1), 1.5).astype(np.uint16) * 257
        found = measure(frame, field).observations
        errors = found.points - CAMERA.project(station, field.points)[found.targets]
        assert len(found) == 64
        assert rms(errors / found.sigmas) < 1.4


def test_of_two_prints_of_a_board_one_is_measured():
    """Of tags that something hid on one print, corners of both were measured, and all was ok."""
    field = boards.aprilgrid(4, 4, 40.0, 0.3)
    shift = np.array([230.0, 10.0, 0.0])
    scene = drawn_exactly(field, 4, 4, 40.0, 0.3)
    scene.shapes += [shape + shift for shape in scene.shapes]
    station = stood(field, (60.0, -60.0, 750.0))
    frame = exact_rendering.noisy(scene.render(LARGE, station), np.random.default_rng(1))
    prints = [LARGE.project(station, points) for points in (field.points, field.points + shift)]
    assert [*measure(frame, field).missed.values()].count("seen twice") >= 56
    for number in range(13):  # on the second print, but for four
        x, y = np.rint(prints[number in (2, 3, 7, 11)][4 * number : 4 * number + 4].mean(axis=0))
        cv2.circle(frame, (int(x), int(y)), 25, 120, -1)
    seen = measure(frame, field).observations
    off = [np.linalg.norm(seen.points - p[seen.targets], axis=1) for p in prints]
    assert len(seen) >= 48
    assert min(errors.max() for errors in off) < 0.2


def test_small_overexposed_markers_are_not_measured():
    """Cut at full scale, of 12 bit too, their narrow surround gave error/sd of 8 to 19."""
    field = boards.charuco(8, 6, 30.0, 22.0, "DICT_5X5_100")
    sheet = images.charuco_sheet(8, 6, 30.0, 22.0, "DICT_5X5_100", legacy=False)
    station = stood(field, (130.0, -30.0, 450.0), 2.9)
    for gain in (1.35, 1.6):
        frame = photograph([sheet], CAMERA, station, finer=2, paper=205 * gain, ink=35 * gain)
        for sensor in (frame, (frame * (4095 / 255)).astype(np.uint16)):
            assert len(measure(sensor, field).observations) < 5


def test_the_tags_of_an_aprilgrid_are_the_published_ones():
    """Some versions of OpenCV turn them by 180°."""
    cells = markers.marker_cells("DICT_APRILTAG_36h11", 0)[1:7, 1:7]
    word = "".join("01"[int(not black)] for black in cells[::-1, ::-1].ravel())
    assert int(word, 2) == APRIL_TAG_0


def test_corners_in_another_order_are_not_ok():
    field = boards.aprilgrid(3, 3, 40.0, 0.3)
    scene = drawn_exactly(field, 3, 3, 40.0, 0.3)
    clean = scene.render(CAMERA, stood(field, (-150.0, 40.0, 250.0)), finer=1)
    frame = exact_rendering.noisy(clean, np.random.default_rng(1))
    for turn in (0, 1, 2):
        codes = tuple(f"{c[:-1]}{(int(c[-1]) + turn) % 4}" for c in field.codes)
        status = measure(frame, replace(field, codes=codes)).status
        assert status.ok == (turn == 0)
        assert ("another order" in status.reason) == (turn > 0)
        assert ("turned by 180°" in status.reason) == (turn == 2)


CHESSBOARD = boards.chessboard(9, 6, 25.0)


@pytest.mark.parametrize("roll", mostly_slow([0.0, 1.5, 3.1, 4.5], 1.5))
def test_a_chessboard_is_numbered_at_any_roll(roll):
    """ChArUco boards of all kinds: `test_a_printed_board_is_found_where_its_csv_says`."""
    station = stood(CHESSBOARD, (150.0, -120.0, 330.0), roll)
    sheet = images.chessboard_sheet(9, 6, 25.0)
    found = measure(photograph([sheet], CAMERA, station, finer=2), CHESSBOARD).observations
    errors = found.points - CAMERA.project(station, CHESSBOARD.points)[found.targets]
    assert len(found) == 54
    assert rms(errors) < 0.02
    assert 0.7 < rms(errors / found.sigmas) < 1.4


KALIBR = "{target_type: 'aprilgrid', tagCols: 6, tagRows: 6, tagSize: 0.04, tagSpacing: 0.3}"
OPENCV = """{"type": "charuco", "squaresX": 11, "squaresY": 8, "squareLength": 0.03,
"markerLength": 0.0225, "dictionary": "5X5_250"}"""
UNDERSCORES = """{num_squares_x: 11, num_squares_y: 8, square_size_mm: 30, marker_size_mm: 22.5,
aruco_dict: DICT_5X5_250}"""
CAPITALS = """{BOARD_ROWS: 8, BOARD_COLS: 11, SQUARE_SIZE: 0.03, MARKER_SIZE: 0.0225,
DICT_NAME: DICT_5X5_250}"""
CHECKER = """{target_type: checkerboard, targetCols: 9, targetRows: 6, rowSpacingMeters: 0.025,
colSpacingMeters: 0.025}"""
SQUARES = '{"type": "checkerboard", "squaresX": 10, "squaresY": 7, "squareLength": 25}'
CORNERS = "{type: chessboard, cols: 9, rows: 6, square_size: 0.025}"
CHARUCO = boards.charuco(11, 8, 30.0, 22.5, "DICT_5X5_250")
OF_CALIB_IO = boards.charuco(11, 8, 34.0, 25.0, "DICT_5X5_1000")


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("board.yaml", KALIBR, boards.aprilgrid(6, 6, 40.0, 0.3)),
        *(("board.yaml", text, CHARUCO) for text in (OPENCV, UNDERSCORES, CAPITALS)),
        *(("board.yaml", text, CHESSBOARD) for text in (CHECKER, SQUARES, CORNERS)),
        ("calib.io_charuco_420x297_8x11_34_25_DICT_5X5.pdf", "", OF_CALIB_IO),
        ("calib.io_checker_200x150_8x11_15.pdf", "", boards.chessboard(10, 7, 15.0)),
        ("calib.io_checker_A4_7x8_18.5", "", boards.chessboard(7, 6, 18.5)),
    ],
)
def test_boards_by_a_file_that_describes_them_or_by_calib_ios_name(tmp_path, name, text, expected):
    """Keys may have underscores and units; a chessboard has one more square than corners."""
    if text:
        (tmp_path / name).write_text(text)
    field = read_board(tmp_path / name).field()
    assert field.names == expected.names
    assert field.codes == expected.codes
    assert field.points == pytest.approx(expected.points)


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        *(("board.yaml", KALIBR.replace("}", f", start_id: {id_}}}"), r"board\.yaml, key startid")
          for id_ in ("abc", "-3", "[1]")),
        ("board.yaml", KALIBR.replace("0.04", "-0.04"), "tagsize"),
        ("board.yaml", KALIBR.replace("tagCols: 6", "tagCols: 1e9"), "tagcols"),
        ("board.yaml", KALIBR.replace("aprilgrid", "circlegrid"), "aprilgrid, checkerboard"),
        ("board.yaml", OPENCV.replace("5X5_250", "9X9"), "9X9"),
        ("board.yaml", "[1, 2]", "key: value"),
        ("board.yaml", CORNERS.replace("9", "8"), "looks the same turned by 180°"),
        ("calib.io_checker_A4_7x8_1.8.5.pdf", "%PDF-1.4\n", r"1\.8\.5\.pdf"),
        # without the marker size, the option to give is named
        ("calib.io_charuco_279x215_8x11_24_DICT_4X4.pdf", "",
         "--charuco 11x8 --square 24 with --marker"),
    ],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, name, text, reason):
    if text:
        (tmp_path / name).write_bytes(text.encode() + b"\xff" * text.startswith("%"))
    with pytest.raises(TestFieldError, match=reason):
        read_board(tmp_path / name).field()


def test_ring_targets_are_numbered_as_in_other_programs(tmp_path):
    (tmp_path / "targets.txt").write_text(
        "# Metashape\ntarget 1, 0, 0, 0\ntarget 2, 200, 0, 0.5\ntarget 147,0,200,1\n4 200 200 2\n"
    )
    field = read_rings(tmp_path / "targets.txt", 12, 10.0)
    assert field.codes[0] == "RING12:65"
    assert len(set(field.codes)) == 4
    assert field.points[1].tolist() == [200, 0, 0.5]
    (tmp_path / "targets.txt").write_text("target 148, 0, 0, 0\n1,0,0,0\n2,0,1,0\n3,1,0,0\n")
    with pytest.raises(TestFieldError, match="147 codes"):
        read_rings(tmp_path / "targets.txt", 12, 10.0)


PAGE = paper_size("A3", landscape=True)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    printed = print_testfield(Design(PAGE, 12.0), folder)
    return printed.field, put_up(folder / "testfield.pdf", PAGE, TRIM)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stand",
    [
        pytest.param((120.0, -150.0, 330.0), id="near and aslant"),
        pytest.param((0.0, -300.0, 250.0), id="very oblique"),
        pytest.param((0.0, 0.0, 380.0), id="straight"),
        pytest.param((300.0, 0.0, 600.0), id="far"),
    ],
)
def test_a_printed_sheet_is_found_at_seventeen_scales(sheet, stand):
    field, sheets = sheet
    station = stood(field, stand, 0.4)
    seen = int(PI_CAMERA.sensor.contains(PI_CAMERA.project(station, field.points), 30.0).sum())
    frame = photograph(sheets, PI_CAMERA, station, noise=2.0, blur=0.4, finer=2)
    found = []
    for scale in np.linspace(0.2, 1.0, 17):
        small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found.append(len(measure(small, field).observations))
    assert min(found) >= 0.97 * seen, found
    assert seen >= 50
