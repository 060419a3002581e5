"""Thermal calibration of low-cost cameras: live, with true standard deviations.

    import thermocald as tc
    epochs = tc.open("M1").calibrate()
    camera = tc.fit(tc.open("M1"), tc.open("M2")).at(35.0)

Names are resolved when they are used (PEP 562): importing the package costs next to nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.series.epochs import Epochs
    from thermocald.analysis.thermal.live_camera import LiveCamera
    from thermocald.analysis.thermal.thermal_camera import Along, ThermalCamera, load_camera
    from thermocald.api import (
        calibrate,
        catalogue,
        discover,
        fit,
        import_photographs,
        open,  # noqa: A004
        open_all,
        plan,
        read_testfield,
        reference_study,
        simulate,
        study,
    )
    from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.results import Calibration, Discovery, Study
    from thermocald.series import Series
    from thermocald.toolbox import (
        check_testfield,
        compare_cameras,
        convert_camera,
        correct,
        fit_calibrations,
        predict,
        survey_testfield,
    )

__version__ = "0.1.0"

__all__ = [
    "Along",
    "Calibration",
    "Camera",
    "Discovery",
    "Epochs",
    "ExteriorOrientation",
    "LiveCamera",
    "Series",
    "Study",
    "TestField",
    "ThermalCamera",
    "calibrate",
    "catalogue",
    "check_testfield",
    "compare_cameras",
    "convert_camera",
    "correct",
    "discover",
    "fit",
    "fit_calibrations",
    "import_photographs",
    "load_camera",
    "open",
    "open_all",
    "plan",
    "predict",
    "read_testfield",
    "reference_study",
    "simulate",
    "study",
    "survey_testfield",
]

# the others are in `api`; a camera alone has not to wait for what analyses series
_PLACES = {
    "Along": "analysis.thermal.thermal_camera",
    "Calibration": "results",
    "Camera": "analysis.camera.camera",
    "Discovery": "results",
    "Epochs": "analysis.series.epochs",
    "ExteriorOrientation": "photogrammetry.camera.camera_model",
    "LiveCamera": "analysis.thermal.live_camera",
    "Series": "series",
    "Study": "results",
    "check_testfield": "toolbox",
    "compare_cameras": "toolbox",
    "convert_camera": "toolbox",
    "correct": "toolbox",
    "fit_calibrations": "toolbox",
    "load_camera": "analysis.thermal.thermal_camera",
    "predict": "toolbox",
    "survey_testfield": "toolbox",
    "TestField": "photogrammetry.field.testfield",
    "ThermalCamera": "analysis.thermal.thermal_camera",
}


def __getattr__(name: str) -> Any:
    """One of the public names, imported now."""
    if name not in __all__:
        raise AttributeError(f"module 'thermocald' has no attribute {name!r}")
    from importlib import import_module

    found = getattr(import_module(f"thermocald.{_PLACES.get(name, 'api')}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
