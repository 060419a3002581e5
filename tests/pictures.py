"""Photographs as cameras write them, and rendered ones of a corner of markers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor, project
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.physics.model import ThermalModel
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.testfield_file import write_testfield

MAKE, MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
TAKEN, SUBSECONDS, OFFSET, FOCAL, F35, SERIAL = 0x9003, 0x9291, 0x9011, 0x920A, 0xA405, 0xA431
GREY = np.full((48, 64), 90, np.uint8)


def save_photograph(
    file: Path | BinaryIO, tags: Mapping[int, Any], grey: np.ndarray = GREY, **options: Any
) -> None:
    """Save a picture with tags of EXIF; options: as PIL's."""
    from PIL import Image

    exif = Image.Exif()
    for tag, value in tags.items():
        (exif if tag in (MAKE, MODEL, ORIENTATION) else exif.get_ifd(0x8769))[tag] = value
    Image.fromarray(grey).save(file, exif=exif, **options)


def from_five_places(field: TestField, model: ThermalModel) -> list[Observations]:
    """What a camera sees of a field, with 0.04 px of noise."""
    rng = np.random.default_rng(5)
    seen = []
    for turn in (0.0, 0.05, -0.05, 0.1, -0.1):
        eop = model.exterior.as_array() + np.array([0, 1, 20, 400, 0, 0]) * turn
        points = project(model.sensor, model.interior.as_array(), eop, field.points)
        points = points + rng.normal(0, 0.04, points.shape)
        seen.append(Observations(np.arange(len(field)), points, np.full(points.shape, 0.04)))
    return seen


def write_markers(
    folder: Path, sensor: Sensor | None = None, interior: InteriorOrientation | None = None
) -> ThermalModel:
    """Three photographs of a corner of markers, 0.png to 2.png, and its field.csv; the camera."""
    field = demonstration_field("markers")
    model = demonstration_model(field)
    scene = Scene(sensor or model.sensor, field)
    for k, turn in enumerate((0.0, 0.05, -0.05)):
        pose = model.exterior.as_array() + np.array([0, turn, 20 * turn, 400 * turn, 0, 0])
        picture = scene.render((interior or model.interior).as_array(), pose, None, [k], 1.0)
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    write_testfield(folder / "field.csv", field)
    return model
