"""A printed sheet is found at any image scale."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.photogrammetry.network_cases import looking_at
from tests.photogrammetry.printed_sheets import photograph, put_up
from thermocald.output.testfield.sheets import TRIM, Design, paper_size, print_testfield
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.frame.measurement import measure

CAMERA = CameraModel(Sensor(3280, 2464, 0.00112), InteriorOrientation(3.04, A1=-2e-3))
PAGE = paper_size("A3", landscape=True)
STANDS = {
    "near and aslant": (120.0, -150.0, 330.0),
    "very oblique": (0.0, -300.0, 250.0),
    "straight": (0.0, 0.0, 380.0),
    "far": (300.0, 0.0, 600.0),
}


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    printed = print_testfield(Design(PAGE, 12.0), folder)
    return printed.field, put_up(folder / "testfield.pdf", PAGE, TRIM)


@pytest.mark.slow
@pytest.mark.parametrize("stand", STANDS)
def test_seventeen_scales(sheet, stand):
    field, sheets = sheet
    middle = field.points.mean(axis=0)
    station = looking_at(middle + np.array(STANDS[stand]), middle, 0.4)
    seen = int(CAMERA.sensor.contains(CAMERA.project(station, field.points), 30.0).sum())
    frame = photograph(sheets, CAMERA, station, noise=2.0, blur=0.4, finer=2)
    found = []
    for scale in np.linspace(0.2, 1.0, 17):
        small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found.append(len(measure(small, field).observations))
    assert min(found) >= 0.97 * seen, found
    assert seen >= 50
