"""The set-up of the demo and of the rendering mock camera: a known camera before a known field.

The camera is a Raspberry Pi camera v2.1 (sensor data: `presets`); its drift is of the size the
reference reports (Elias et al. 2020, section 4.2).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.simulation.model import ThermalModel
from thermocald.simulation.testfields import corner_field, corner_view
from thermocald.store.recording.reader import read_testfield

if TYPE_CHECKING:
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["FieldKind", "demonstration_field", "demonstration_model", "load_field"]

FieldKind = Literal["markers", "circles", "plain"]


def demonstration_field(kind: FieldKind = "markers") -> TestField:
    """A corner field that fills the image: 192 marker corners, or 147 circles."""
    if kind == "markers":
        return corner_field("markers", per_side=4, pitch_mm=150.0)
    return corner_field(kind, per_side=7, pitch_mm=90.0)


def load_field(kind_or_path: str) -> TestField:
    """One of the demonstration's fields by its kind, or the field in a testfield.csv."""
    if kind_or_path in ("markers", "circles", "plain"):
        return demonstration_field(cast("FieldKind", kind_or_path))
    return read_testfield(Path(kind_or_path))


def demonstration_model(field: TestField) -> ThermalModel:
    """The camera 1.3 m before a corner field: half a pixel of drift per kelvin, T₀ = 25 °C."""
    return ThermalModel(
        camera="rpi-v2.1",
        sensor=Sensor(3280, 2464, 0.00112),
        T0=25.0,
        interior=InteriorOrientation(
            c=3.04, x0=0.012, y0=-0.018, A1=-0.004, A2=0.0005, B1=1e-4, B2=-2e-4
        ),
        rates={"c": 2.0e-4, "x0": -4.5e-4, "y0": -3.0e-4},
        exterior=corner_view(field, 1300.0),
        name="demonstration",
    )
