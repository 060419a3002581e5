"""Thermal calibration of low-cost cameras: live, with realistic standard deviations.

    import thermocald as tc
    epochs = tc.open("M1").calibrate()
    camera = tc.fit(tc.open("M1"), tc.open("M2")).at(35.0)

A name is imported when it is first used (PEP 562), so that `import thermocald` takes next to no
time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermocald.analysis.camera.camera import Camera as Camera
    from thermocald.analysis.series.epochs import Epochs as Epochs
    from thermocald.analysis.thermal.modelled_camera import Along as Along
    from thermocald.analysis.thermal.thermal_camera import LiveCamera as LiveCamera
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera as ThermalCamera
    from thermocald.analysis.thermal.thermal_camera import load_camera as load_camera
    from thermocald.api import calibrate as calibrate
    from thermocald.api import catalogue as catalogue
    from thermocald.api import discover as discover
    from thermocald.api import fit as fit
    from thermocald.api import plan as plan
    from thermocald.api import read_testfield as read_testfield
    from thermocald.api import reference_study as reference_study
    from thermocald.api import simulate as simulate
    from thermocald.api import study as study
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation as ExteriorOrientation,
    )
    from thermocald.photogrammetry.epoch.measuring import Line as Line
    from thermocald.photogrammetry.epoch.measuring import Plane as Plane
    from thermocald.photogrammetry.epoch.measuring import Profile as Profile
    from thermocald.photogrammetry.field.testfield import TestField as TestField
    from thermocald.results import Calibration as Calibration
    from thermocald.results import Discovery as Discovery
    from thermocald.results import Study as Study
    from thermocald.series import Series as Series
    from thermocald.series import open as open  # noqa: A004
    from thermocald.series import open_all as open_all
    from thermocald.toolbox import check_testfield as check_testfield
    from thermocald.toolbox import compare_cameras as compare_cameras
    from thermocald.toolbox import convert_camera as convert_camera
    from thermocald.toolbox import correct as correct
    from thermocald.toolbox import fit_calibrations as fit_calibrations
    from thermocald.toolbox import follow_scene as follow_scene
    from thermocald.toolbox import import_photographs as import_photographs
    from thermocald.toolbox import measure as measure
    from thermocald.toolbox import predict as predict
    from thermocald.toolbox import survey_testfield as survey_testfield

__version__ = "0.1.0"

# module → names, so that a camera alone does not import the analysis of series
_PLACES = {
    "analysis.camera.camera": "Camera",
    "analysis.series.epochs": "Epochs",
    "analysis.thermal.modelled_camera": "Along",
    "analysis.thermal.thermal_camera": "LiveCamera ThermalCamera load_camera",
    "api": ("calibrate catalogue discover fit plan read_testfield reference_study simulate study"),
    "photogrammetry.camera.camera_model": "ExteriorOrientation",
    "photogrammetry.epoch.measuring": "Line Plane Profile",
    "photogrammetry.field.testfield": "TestField",
    "results": "Calibration Discovery Study",
    "series": "Series open open_all",
    "toolbox": (
        "check_testfield compare_cameras convert_camera correct fit_calibrations follow_scene "
        "import_photographs measure predict survey_testfield"
    ),
}
_MODULES = {name: module for module, names in _PLACES.items() for name in names.split()}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module 'thermocald' has no attribute {name!r}")
    from importlib import import_module
    from inspect import isfunction

    value = getattr(import_module(f"thermocald.{_MODULES[name]}"), name)
    if isfunction(value):
        from thermocald.names import checked

        value = checked(value)
        value.__module__ = __name__  # where pickle finds it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
