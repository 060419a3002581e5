"""The generator's arrays as the program's input, without files."""

from __future__ import annotations

import numpy as np

from tests.blind.case import CAMERAS
from tests.blind.generator import Series
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.thermal.series import SeriesInput


def series_input(series: Series) -> SeriesInput:
    width, height, pitch, c, _ = CAMERAS[series.camera]
    n = len(series.field_nominal)
    points = np.full((len(series.epoch), n, 2), np.nan)
    weights = np.zeros((len(series.epoch), n, 3))
    points[series.row_epoch, series.row_target] = np.round(series.xy, 4)
    weights[series.row_epoch, series.row_target, :2] = 1 / series.sigma**2
    return SeriesInput(
        series.name, series.camera, Sensor(width, height, pitch),
        TestField.build([str(i + 1) for i in range(n)], series.field_nominal, 0.02), c,
        series.frame_time, series.temperature_time, series.temperatures,
        dict.fromkeys(series.temperatures, 0.0625), ObservationGrid(points, weights),
        series.epoch, columns=series.columns,
    )  # fmt: skip
