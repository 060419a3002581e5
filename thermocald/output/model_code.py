"""A thermal model as code, in C and in Python without dependencies.

The code evaluates the camera that has long been at a temperature T: the ten parameters as
polynomials in T, OpenCV's camera matrix and distortion coefficients, and the projection itself,
which holds also where C1 or C2 are not zero and OpenCV has no place for them.
"""

from __future__ import annotations

import re
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from thermocald.files import write_text

if TYPE_CHECKING:
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array


_TEMPLATES = Path(__file__).parent / "templates"
_FOLLOW_C = """\
    /* the lens keeps its rays' angles: distortion follows c */
    double s = {c0} / p[0];
    p[3] *= s * s;
    p[4] *= s * s * s * s;
    p[5] *= s * s * s * s * s * s;
    p[6] *= s;
    p[7] *= s;
"""

_FOLLOW_PYTHON = """\
    s = {c0} / p[0]  # the lens keeps its rays' angles: distortion follows c
    p[3:8] = p[3] * s**2, p[4] * s**4, p[5] * s**6, p[6] * s, p[7] * s
"""


def c_header(camera: ThermalCamera, name: str) -> str:
    """Return the model as a C header; UsageError where it needs more than one thermometer."""
    knees = ", ".join([*(f"{{{_row(k)}}}" for k in camera.steady_knees()), "{0}"])
    return _filled("model.h.txt", camera, name, _FOLLOW_C, knees)


def python_module(camera: ThermalCamera, name: str) -> str:
    """Return the model as a Python module; UsageError where it needs more than one thermometer."""
    knees = "".join(f"({_row(k)}), " for k in camera.steady_knees()).strip()
    return _filled("model.py.txt", camera, name, _FOLLOW_PYTHON, knees)


def write_code(camera: ThermalCamera, path: Path) -> tuple[Path, Path]:
    """Write PATH.h and PATH.py; OutputError where they cannot be written."""
    header, module = path.with_suffix(".h"), path.with_suffix(".py")
    texts = {header: c_header(camera, path.stem), module: python_module(camera, path.stem)}
    for file, text in texts.items():
        write_text(file, text)
    return header, module


def _filled(file: str, camera: ThermalCamera, name: str, follow: str, knees: str) -> str:
    """Return a template with the model's numbers; follow: what lets the distortion follow c."""
    model = camera.model
    sensor = model.sensor
    p = camera.steady_polynomials()
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"camera_{identifier}"
    reference, limits = next(iter(model.validity.items()), ("the thermometer", (-273.0, 1000.0)))
    affine = any(any(row[8:]) for row in p) or any(any(k[9:]) for k in camera.steady_knees())
    c0 = repr(float(model.interior.c))
    exact = "C1 or C2 are not zero: OpenCV's parameters are then not exact, the projection is."
    fields = {
        "name": _plain(model.name or model.camera),
        "id": identifier,
        "guard": f"THERMOCALD_{identifier.upper()}_H",
        "reference": _plain(reference),
        "low": repr(float(limits[0])),
        "high": repr(float(limits[1])),
        "width": sensor.width,
        "height": sensor.height,
        "pitch": repr(float(sensor.pixel_pitch)),
        "T0": repr(float(model.T0)),
        "p0": _row(p[0]),
        "p1": _row(p[1]),
        "p2": _row(p[2]),
        "n": len(camera.steady_knees()),
        "knees": knees,
        "follow": follow.format(c0=c0) if model.distortion == "angle" else "",
        "exact": exact if affine else "OpenCV's parameters are exact.",
    }
    return Template((_TEMPLATES / file).read_text(encoding="utf-8")).substitute(fields)


def _plain(text: str) -> str:
    """Text that neither a comment of C nor a docstring ends at."""
    return re.sub(r"[^\w .:()+-]", "?", text, flags=re.ASCII)


def _row(values: Array | tuple[float, ...]) -> str:
    return ", ".join(repr(float(v)) for v in values)
