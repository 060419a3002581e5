"""Printed test fields: on the rasterised page, targets are where the CSV states."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from tests.marks import mostly_slow
from tests.photogrammetry.printed_sheets import rasterised
from thermocald.analysis.field import usual_station
from thermocald.errors import ThermocaldError, UsageError
from thermocald.output.testfield.sheets import (
    TRIM,
    Design,
    default_diameter,
    field_of,
    lay_out,
    paper_size,
    print_testfield,
)
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.targets import ring_code
from thermocald.store.recording.testfield_file import read_testfield

DPI = 200
MM = DPI / 25.4  # px
SHEET = Design(paper_size("A4"), 7.0, bits=12)
CORNER = Design(paper_size("A3"), 14.0, sheets=3)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Map a design to its printed field and its folder, made once."""

    @cache
    def print_once(design):
        folder = tmp_path_factory.mktemp("printed")
        return print_testfield(design, folder), folder

    return print_once


@pytest.fixture(scope="module")
def read(printed):
    """Map the design of a sheet to what its CSV says, the raster of its PDF, and places there."""

    @cache
    def read_once(design, dpi=DPI):
        _, folder = printed(design)
        field = read_testfield(folder / "testfield.csv")
        image = rasterised(folder / "testfield.pdf", 0, dpi)
        xy = field.points[:, :2] + TRIM
        # px, (0, 0) a pixel's centre; the renderer stretches the page to whole pixels
        scale = np.array(image.shape[::-1]) / design.page
        return field, image, np.column_stack([xy[:, 0], design.page[1] - xy[:, 1]]) * scale - 0.5

    return read_once


def centroid(image, centre, radius_px, light=False):
    """Grey-weighted centroid within a circle that holds nothing else."""
    x0, y0 = np.rint(centre).astype(int)
    n = int(radius_px) + 1
    window = image[y0 - n : y0 + n + 1, x0 - n : x0 + n + 1].astype(float)
    weight = window if light else 255.0 - window
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    weight *= np.hypot(x - (centre[0] - x0), y - (centre[1] - y0)) < radius_px
    return np.array(
        [x0 + np.sum(weight * x) / weight.sum(), y0 + np.sum(weight * y) / weight.sum()]
    )


@pytest.mark.parametrize(
    "design",
    [
        pytest.param(SHEET, id="A4"),
        # the markers' white surround reached the plain circles
        pytest.param(replace(SHEET, bits=None, light=True, dictionary="DICT_4X4_50"), id="light"),
    ],
)
def test_rasterised_discs_are_where_the_csv_says(read, design):
    field, image, places = read(design)
    assert image.shape == pytest.approx((297 * MM, 210 * MM), abs=1.01)
    assert field.circles.sum() >= 30
    # outside the disc, but without its ring and name
    reach = 1.3 / 2 * design.diameter * MM
    expected = places[field.circles]
    found = np.array([centroid(image, p, reach, design.light) for p in expected])
    # a hundredth of a millimetre: a tenth of a printer's dot
    assert np.abs(found - expected).max() / MM < 0.01


@pytest.mark.parametrize("bits", mostly_slow([12, 14], 12))
def test_rasterised_rings_carry_the_code_of_the_csv(read, bits):
    """The ring is read off the raster pixel by pixel, clockwise, without the program's decoder."""
    field, image, places = read(replace(SHEET, bits=bits))
    coded = [i for i, code in enumerate(field.codes) if code]
    assert len({field.codes[i] for i in coded}) == len(coded) >= 20
    middle = 0.5 * (ring_code.RING_INNER + ring_code.RING_OUTER) * 3.5 * MM
    turns = 2 * np.pi * (np.arange(bits) + 0.5) / bits  # y down: clockwise
    for i in coded:
        x, y = np.rint(places[i][:, None] + middle * np.array([np.cos(turns), np.sin(turns)]))
        word = "".join("1" if grey < 128 else "0" for grey in image[y.astype(int), x.astype(int)])
        smallest = min(int(word[k:] + word[:k], 2) for k in range(bits))
        assert f"RING{bits}:{smallest}" == field.codes[i]


def test_markers_are_found_by_opencv_where_the_csv_says(read):
    field, image, places = read(
        Design(paper_size("200x250"), 7.0, dictionary="DICT_APRILTAG_36h11")
    )
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    found = {
        f"DICT_APRILTAG_36h11:{int(number)}:{k}": corner[0, k]
        for number, corner in zip(ids.ravel(), corners, strict=True)
        for k in range(4)
    }
    rows = [i for i, kind in enumerate(field.kinds) if kind == "marker_corner"]
    assert {field.codes[i] for i in rows} == set(found)
    errors = [found[field.codes[i]] - places[i] for i in rows]
    assert np.abs(errors).max() / MM < 0.2  # OpenCV's corners without refinement: 1 to 2 px


def test_rulers_are_as_long_as_they_say(read):
    dark, mm = read(SHEET, 600.0)[1] < 128, 600 / 25.4
    # the ten-millimetre ticks stand 6 to 7 mm inside the trimmed edge, alone there
    level = int((TRIM + 6.5) * mm)
    for line in (dark[-level], dark[:, level]):
        ticks = np.flatnonzero(np.diff(line.astype(int), prepend=0) == 1)
        assert len(ticks) == 11
        assert (ticks[-1] - ticks[0]) / mm == pytest.approx(100.0, abs=0.05)
        assert np.diff(ticks) / mm == pytest.approx(10.0, abs=0.06)


def test_svg_draws_the_same_page(printed):
    root = ET.parse(printed(SHEET)[1] / "testfield.svg").getroot()
    size = [float(root.get(side).removesuffix("pt")) / 72 * 25.4 for side in ("width", "height")]
    assert size == pytest.approx(SHEET.page, abs=0.01)
    assert sum(1 for _ in root.iter("{http://www.w3.org/2000/svg}path")) > 40


def test_corner_is_three_perpendicular_sheets_with_distinct_codes_and_a_plan(printed):
    pdfium = pytest.importorskip("pypdfium2")
    done, folder = printed(CORNER)
    assert [f.name for f in done.files] == [
        "testfield.pdf", "testfield-1.svg", "testfield-2.svg", "testfield-3.svg", "testfield.csv",
    ]  # fmt: skip
    field = done.field
    planes = [np.flatnonzero(np.abs(field.points[:, axis]) < 1e-9) for axis in (2, 1, 0)]
    assert [len(p) for p in planes] == [len(s.field) for s in done.sheets]
    assert field.points.min() >= 0
    codes = [c for c in field.codes if c]
    assert len(set(codes)) == len(codes)
    # seen from outside, on each sheet the order right, up, towards the viewer is right-handed:
    # otherwise the ring codes of that sheet would be mirrored
    for rows, sheet, normal in zip(planes, done.sheets, np.eye(3)[[2, 1, 0]], strict=True):
        right, up, _ = placing_of(sheet, field.points[rows])
        assert np.cross(right, up) == pytest.approx(normal, abs=1e-9)
    with pdfium.PdfDocument(folder / "testfield.pdf") as document:
        assert len(document) == 4
        words = " ".join(document[3].get_textpage().get_text_bounded().split())
    for said in ("Glue", "brackets", "0.4°", "survey", "edges with the same letter meet"):
        assert said in words


def placing_of(sheet, points):
    """The space directions of a sheet's right and up, and the place of its origin, (3, 3)."""
    local = np.column_stack([sheet.field.points[:, :2], np.ones(len(points))])
    return np.linalg.lstsq(local, points, rcond=None)[0]


def test_the_plan_and_the_coordinates_agree_on_left_and_right(printed):
    """Looking into the corner, sheet 2 is on the left; letters are on edges that coincide."""
    done = printed(CORNER)[0]
    field, sheets = done.field, done.sheets
    camera = CameraModel(Sensor(3280, 2464, 0.00112), InteriorOrientation(3.04))
    image = camera.project(usual_station(camera, field), field.points)
    rows = [[field.index[name] for name in sheet.field.names] for sheet in sheets]
    floor, left, right = (image[r].mean(axis=0) for r in rows)
    assert left[0] < floor[0] < right[0]
    assert floor[1] > max(left[1], right[1])
    ends = {"left": ((0, 0), (0, 1)), "right": ((1, 0), (1, 1)), "lower": ((0, 0), (1, 0))}
    edges: dict[str, list[set[int]]] = {}
    for sheet, r in zip(sheets, rows, strict=True):
        placing = placing_of(sheet, field.points[r])
        for side, letter in sheet.edges.items():
            line = np.array([[*np.array(end) * sheet.size, 1.0] for end in ends[side]]) @ placing
            on = {axis for axis in range(3) if np.abs(line[:, axis]).max() < 1e-6}
            edges.setdefault(letter, []).append(on)
    # both sheets with a letter have that edge on the same axis, where the two others are 0
    assert sorted(edges) == ["A", "B", "C"]
    assert all(first == second and len(first) == 2 for first, second in edges.values())


def test_sigmas_are_those_of_an_unsurveyed_print(printed):
    flat = field_of(lay_out(SHEET))
    assert flat.sigmas[:, 2].min() > flat.sigmas[:, 0].max() > flat.sigmas[:, 0].min() > 0.09
    assert printed(CORNER)[0].field.sigmas.min() > 2.9


@pytest.mark.parametrize("name", ["A4", "A3", "A2", "A1", "A0"])
@pytest.mark.parametrize("landscape", [False, True])
def test_every_paper_has_a_sensible_default(name, landscape):
    page = paper_size(name, landscape=landscape)
    (sheet,) = lay_out(Design(page, default_diameter(page)))
    assert 60 < len(sheet.field) < 160
    a, b = (sheet.field.points[sheet.field.index[sheet.scale_bar[end]]] for end in "ab")
    assert a[1] == b[1]
    assert b[0] - a[0] > 0.6 * sheet.size[0]
    for (x, y, _), code in zip(sheet.field.points, sheet.field.codes, strict=True):
        reach = 3 * default_diameter(page) / 2 if code else default_diameter(page) / 2
        assert reach < x < sheet.size[0] - reach
        assert reach < y < sheet.size[1] - reach


@pytest.mark.parametrize(
    ("design", "reason"),
    [
        (Design((210, 297), 60.0), "smaller discs or larger paper"),
        (Design((841, 1189), 8.0, bits=12), "--bits 14"),
        (Design((841, 1189), 3.0, bits=14), "more than the 516"),
        (Design((210, 297), 7.0, first_code=516), "the 0 ring.*smaller --first-code"),
        (Design((210, 297), 7.0, bits=13), "12 or 14"),
        (Design((210, 297), 7.0, bits=0), "cannot be identified"),
        (Design((210, 297), 7.0, dictionary="DICT_KLINGON"), "DICT_KLINGON"),
        (Design((210, 297), 0.5), "0.5 mm"),
        (Design((210, 297), 7.0, sheets=2), "three of a corner"),
        (Design((210, 297), 7.0, pitch=300.0), "1 × 1 targets; use a smaller pitch"),
        (Design((210, 297), 7.0, pitch=10.0), "need at least 29.75 mm"),
    ],
)
def test_impossible_designs_are_refused(design, reason, tmp_path):
    with pytest.raises(ThermocaldError, match=reason):
        print_testfield(design, tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("text", ["A9", "20", "axb", "10x10", "9000x9000", "nanxnan"])
def test_unknown_paper_is_refused(text):
    with pytest.raises(UsageError, match="paper"):
        paper_size(text)
