"""The demonstration camera with a sixteenth of its pixels: quick to render and measure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.model_file import write_model
from thermocald.physics.testfields import demonstration_field, demonstration_model


def write_small_camera(path: Path) -> Path:
    """Write the camera's model for the mock's option `model`."""
    model = demonstration_model(demonstration_field("markers"))
    write_model(path, replace(model, sensor=Sensor(820, 616, 0.00448)))
    return path
