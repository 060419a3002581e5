"""Surveys of rendered test fields: bent paper, corners put up by hand, photographs of a print."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.photogrammetry import network_cases as cases
from thermocald.errors import GeometryError, ImageError
from thermocald.output.testfield.layout import TRIM, Design, field_of, lay_out, paper_size
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.network.datum import Distance
from thermocald.photogrammetry.survey import survey
from thermocald.physics.scene import Scene

# The binned mode of a Raspberry Pi camera v2.1.
CAMERA = CameraModel(
    Sensor(1640, 1232, 0.00224),
    InteriorOrientation(
        c=3.05, x0=0.021, y0=-0.013, A1=-2.1e-3, A2=4.0e-4, A3=-2.0e-5, B1=4e-5, B2=-3e-5,
        C1=3e-4, C2=-2e-4,
    ),
)  # fmt: skip


def bent(field, size, sag=5.0):
    """The nominal field of a sheet as it really is: bent, twisted, and stretched by the printer."""
    points = field.points * [1.002, 0.999, 1.0]
    u, v = field.points[:, 0] / size[0] - 0.5, field.points[:, 1] / size[1] - 0.5
    points[:, 2] = sag * (1 - 4 * u * u) + 0.6 * sag * u * v
    return TestField.build(field.names, points, 0.0, field.diameters, field.kinds, field.codes)


def photograph(truth, stations, camera=CAMERA):
    """Pictures of a field by the program's own renderer."""
    scene = Scene(camera.sensor, truth)
    pictures = {}
    for i, station in enumerate(stations):
        frame = scene.render(camera.interior.as_array(), station.as_array(), seed=i)
        pictures[f"photo{i}.png"] = lambda frame=frame: frame
    return pictures


def measured_distance(truth, a, b, sigma, seed=0):
    length = float(np.linalg.norm(truth.points[truth.index[a]] - truth.points[truth.index[b]]))
    return Distance(a, b, length + np.random.default_rng(seed).normal(0, sigma), sigma)


def assert_true(result, truth, least_accuracy=1 / 20_000):
    """Coordinates within three stated standard deviations, and the accuracy of the issue."""
    known = truth.points[[truth.index[name] for name in result.network.names]]
    errors, normalised = cases.normalised_errors(result.network, known)
    assert np.mean(np.abs(normalised) < 3.0) > 0.99
    assert np.abs(normalised).max() < 4.5
    assert np.sqrt(np.mean(errors**2)) / result.network.extent < least_accuracy
    assert result.network.relative_accuracy < least_accuracy
    return errors, normalised


@pytest.fixture(scope="module")
def sheet():
    (sheet,) = lay_out(Design(paper_size("A2", landscape=True), 16.0))
    nominal = field_of((sheet,))
    truth = bent(nominal, sheet.size)
    stations = cases.convergent_stations(truth.points, 12, distance=620.0)
    a, b = (target.name for target in sheet.scale_bar)
    return nominal, truth, photograph(truth, stations), measured_distance(truth, a, b, 0.02)


def test_bent_sheet_with_its_nominal_field(sheet):
    nominal, truth, pictures, distance = sheet
    result = survey(pictures, [distance], CAMERA.sensor.pixel_pitch, nominal=nominal)
    assert set(result.network.names) == set(truth.names)
    assert_true(result, truth)
    interior = result.network.camera.interior.as_array() - CAMERA.interior.as_array()
    sd = np.sqrt(np.diag(result.network.interior_covariance))
    assert np.abs(interior / sd).max() < 3.7
    assert 0.8 < result.network.sigma0 < 1.25
    assert result.field.names == truth.names
    assert result.field.codes == nominal.codes
    assert np.allclose(
        result.field.points[[result.field.index[n] for n in result.network.names]],
        result.network.points,
    )


def test_bent_sheet_of_which_nothing_is_known(sheet):
    """Codes alone: names from the codes, diameters from the pictures."""
    _, truth, pictures, distance = sheet
    result = survey(pictures, [distance], CAMERA.sensor.pixel_pitch)
    coded = {name for name, code in zip(truth.names, truth.codes, strict=True) if code}
    assert set(result.network.names) == coded
    assert_true(result, truth)
    assert result.field.diameters == pytest.approx(np.full(len(coded), 16.0), rel=0.01)
    for name, code in zip(result.field.names, result.field.codes, strict=True):
        assert truth.codes[truth.index[name]] == code


def test_a_black_and_a_foreign_photograph_are_named_and_do_no_harm(sheet):
    nominal, truth, pictures, distance = sheet
    shape = pictures["photo0.png"]().shape
    rng = np.random.default_rng(0)
    noise = rng.integers(60, 180, (77, 103), dtype=np.uint8)
    clutter = cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)
    black = np.zeros(shape, dtype=np.uint8)
    photographs = {**pictures, "black.png": lambda: black, "wall.png": lambda: clutter}
    result = survey(photographs, [distance], CAMERA.sensor.pixel_pitch, nominal=nominal)
    assert_true(result, truth)
    assert "black.png" not in {s.photo for s in result.network.stations}
    assert "wall.png" not in {s.photo for s in result.network.stations}
    assert result.measured["wall.png"] == "0 coded targets"
    assert "coded targets" not in result.measured["black.png"]


def test_pictures_that_do_not_belong_together_are_refused(sheet):
    nominal, _, pictures, distance = sheet
    turned = {"portrait.png": lambda: np.ascontiguousarray(pictures["photo1.png"]().T)}
    with pytest.raises(ImageError, match=r"portrait\.png.*1232×1640"):
        survey(pictures | turned, [distance], 0.00224, nominal=nominal)
    black = {"night.png": lambda: np.zeros((1232, 1640), dtype=np.uint8)}
    with pytest.raises(ImageError, match="no photograph shows a coded target"):
        survey(black, [distance], 0.00224, nominal=nominal)
    with pytest.raises(GeometryError, match="2 photographs"):
        survey(dict([*pictures.items()][:2]), [distance], 0.00224, nominal=nominal)
    nowhere = Distance("R65", "P9999", 100.0, 0.1)
    with pytest.raises(GeometryError, match="P9999"):
        survey(pictures, [nowhere], 0.00224, nominal=nominal)


@pytest.mark.slow
def test_corner_put_up_by_hand():
    """Three sheets, each bent, shifted and turned by millimetres; cameras look into the corner."""
    sheets = lay_out(Design(paper_size("A3"), 12.0, sheets=3))
    nominal = field_of(sheets)
    rng = np.random.default_rng(4)
    points = nominal.points.copy()
    for axis, rows in ((a, np.abs(nominal.points[:, a]) < 1e-9) for a in range(3)):
        centre = points[rows].mean(axis=0)
        turn = cv2.Rodrigues(rng.normal(0, 0.01, 3))[0]
        flat = (points[rows] - centre) / 200
        bulge = np.zeros((rows.sum(), 3))
        bulge[:, axis] = 3.0 * (1 - np.sum(flat**2, axis=1))
        points[rows] = (points[rows] - centre + bulge) @ turn.T + centre + rng.normal(0, 3, 3)
    truth = TestField.build(
        nominal.names, points, 0.0, nominal.diameters, nominal.kinds, nominal.codes
    )
    spot = points.mean(axis=0)
    stations = []
    for i in range(12):
        azimuth, height = np.radians(20 + 50 * (i % 4) / 3), np.radians(20 + 15 * (i // 4))
        out = np.array(
            [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]
        )
        stations.append(cases.looking_at(spot + 780.0 * out, spot, (i % 4) * np.pi / 2))
    pictures = photograph(truth, stations)
    a, b = (target.name for target in sheets[0].scale_bar)
    distance = measured_distance(truth, a, b, 0.02)
    result = survey(pictures, [distance], CAMERA.sensor.pixel_pitch, nominal=nominal)
    assert len(result.network.names) > 0.95 * len(truth)
    assert_true(result, truth)


def _print_on_paper(tmp_path, design, dpi):
    """The raster of a print, and the function from the sheet's mm to its pixels."""
    from thermocald.output.testfield.print import print_testfield

    pdfium = pytest.importorskip("pypdfium2")
    printed = print_testfield(design, tmp_path)
    document = pdfium.PdfDocument(tmp_path / "testfield.pdf")
    try:
        bitmap = document[0].render(scale=dpi / 72, grayscale=True)
        raster = bitmap.to_numpy().copy().reshape(bitmap.height, bitmap.width)
    finally:
        document.close()
    scale = np.array(raster.shape[::-1]) / design.page
    return printed, raster, scale


def _photograph_of_paper(raster, scale, page, surface, station, seed, over=3):
    """A picture of a printed sheet that is bent: rays through every pixel meet the paper.

    Shares nothing with the program's renderer. surface(x, y) is the height of the paper over
    sheet coordinates in mm; the raster is sampled `over` times finer than the pixels, averaged,
    blurred by 0.7 px, and given noise of 2 DN.
    """
    sensor = CAMERA.sensor
    y, x = np.mgrid[0 : sensor.height, 0 : sensor.width]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    rays = CAMERA.rays(pixels) @ station.rotation.T
    X0 = station.centre
    z = np.zeros(len(rays))
    for _ in range(12):
        s = (z - X0[2]) / rays[:, 2]
        z = surface(X0[0] + s * rays[:, 0], X0[1] + s * rays[:, 1])
    sheet = np.column_stack([X0[0] + s * rays[:, 0], X0[1] + s * rays[:, 1]])
    at = np.column_stack([sheet[:, 0] + TRIM, page[1] - sheet[:, 1] - TRIM]) * scale - 0.5
    shape = (sensor.height, sensor.width)
    fine = [
        cv2.resize(
            at[:, k].reshape(shape).astype(np.float32), None, fx=over, fy=over,
            interpolation=cv2.INTER_CUBIC,
        )
        for k in range(2)
    ]  # fmt: skip
    sampled = cv2.remap(raster, *fine, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
                        borderValue=150)  # fmt: skip
    sampled = sampled.reshape(shape[0], over, shape[1], over).mean(axis=(1, 3))
    grey = cv2.GaussianBlur(20 + sampled * (190 / 255), (0, 0), 0.7)
    grey += np.random.default_rng(seed).normal(0, 2, shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_photographs_of_a_printed_pdf(tmp_path):
    """`testfield print`, its PDF rasterised, bent, photographed from 12 stations, surveyed.

    All that is on the page is in the pictures: names, rulers, crop marks, legend.
    """
    page = paper_size("A3", landscape=True)
    design = Design(page, 11.0)
    printed, raster, scale = _print_on_paper(tmp_path, design, 300)
    size = printed.sheets[0].size

    def surface(x, y):
        u, v = x / size[0] - 0.5, y / size[1] - 0.5
        return 4.0 * (1 - 4 * u * u) + 2.0 * u * v

    nominal = printed.field
    points = nominal.points.copy()
    points[:, 2] = surface(points[:, 0], points[:, 1])
    truth = TestField.build(
        nominal.names, points, 0.0, nominal.diameters, nominal.kinds, nominal.codes
    )
    pictures = {}
    for i, station in enumerate(cases.convergent_stations(points, 12, distance=430.0)):
        frame = _photograph_of_paper(raster, scale, page, surface, station, i)
        pictures[f"photo{i}"] = lambda frame=frame: frame
    a, b = (target.name for target in printed.sheets[0].scale_bar)
    distance = measured_distance(truth, a, b, 0.02)
    result = survey(pictures, [distance], CAMERA.sensor.pixel_pitch, nominal=nominal)
    assert set(result.network.names) == set(truth.names)
    assert len(result.network.stations) == 12
    assert_true(result, truth)
