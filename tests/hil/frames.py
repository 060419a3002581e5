"""The laboratory's scene: a camera that warms up before a test field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.physics.history import History
from thermocald.physics.model import ThermalModel
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import demonstration_field, demonstration_model


def subject(width: int, height: int) -> tuple[TestField, ThermalModel]:
    """Return the demonstration's field and camera, with a sensor of this size."""
    field = demonstration_field("markers")
    model = demonstration_model(field)
    pitch = model.sensor.pixel_pitch * model.sensor.width / width
    return field, replace(model, sensor=Sensor(width, height, pitch))


def heating(
    width: int, height: int, count: int, low_c: float = 25.0, high_c: float = 45.0
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return frames (count, height, width) and temperatures (count,), °C, of a linear warm-up."""
    field, model = subject(width, height)
    temperatures = np.linspace(low_c, high_c, count)
    times = np.arange(count, dtype=np.float64)
    history = History(times, times, {"temperature": temperatures}, "temperature", model.T0)
    truth = model.predict(history, field)
    scene = Scene(model.sensor, field)
    images = [scene.render(truth.iop[k], truth.eop[k], seed=k) for k in range(count)]
    return np.stack(images), temperatures
