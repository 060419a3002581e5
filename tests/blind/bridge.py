"""Blind recordings as the program's input, without files."""

from __future__ import annotations

import numpy as np

from tests.blind.case import CAMERAS, Case
from tests.blind.generator import Series, generate
from tests.blind.world import corner_field
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.thermal.series import SeriesInput


def generated(case: Case) -> tuple[list[SeriesInput], dict]:
    """Generate a case; return its recordings and the truth."""
    series, truth = generate(case)
    return [series_input(s) for s in series], truth


def series_input(series: Series) -> SeriesInput:
    width, height, pitch, c, _ = CAMERAS[series.camera]
    places = corner_field()
    weights = np.zeros((*series.points.shape[:2], 3))
    weights[np.isfinite(series.points[..., 0]), :2] = 1 / series.sigma**2
    return SeriesInput(
        series.name, series.camera, Sensor(width, height, pitch),
        TestField.build([str(i + 1) for i in range(len(places))], places, 0.02), c,
        series.times, series.reading_times, series.temperatures,
        dict.fromkeys(series.temperatures, 0.0625),
        ObservationGrid(np.round(series.points, 4), weights), series.numbers,
        columns=series.columns,
    )  # fmt: skip
