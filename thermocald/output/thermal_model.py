"""The code of a thermal model in C and in Python without dependencies.

It evaluates the camera at a steady temperature T: the ten parameters as polynomials in T, OpenCV's
camera matrix and distortion coefficients, and the projection itself, which is also valid if C1 or
C2 are not zero, for which OpenCV has no parameters.
"""

from __future__ import annotations

import re
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Literal

from thermocald.files import write_text

if TYPE_CHECKING:
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array

_TEMPLATES = Path(__file__).parent / "templates"
_LENSES = {
    "angle": "the lens preserves the angles of its rays: the distortion scales with c",
    "image": "the distortion in the image does not change with c",
}


def write_code(camera: ThermalCamera, path: Path) -> tuple[Path, Path]:
    """Write PATH.h and PATH.py and return their paths; OutputError if they cannot be written."""
    files = path.with_suffix(".h"), path.with_suffix(".py")
    texts = [code_of(camera, path.stem, kind) for kind in ("h", "py")]
    for file, text in zip(files, texts, strict=True):
        write_text(file, text)
    return files


def code_of(camera: ThermalCamera, name: str, kind: Literal["h", "py"]) -> str:
    """Return the model as a C header or a Python module.

    Raises UsageError for a model that needs more than one thermometer.
    """
    model = camera.model
    sensor = model.sensor
    p, bends = camera.steady_tables()
    rows = [_row(k) for k in bends]
    if kind == "h":
        knees = ", ".join([*(f"{{{row}}}" for row in rows), "{0}"])
    else:
        knees = "".join(f"({row}), " for row in rows).strip()
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"camera_{identifier}"
    reference, limits = next(iter(model.validity.items()), ("the thermometer", (-273.0, 1000.0)))
    affine = any(any(row[8:]) for row in p) or any(any(k[9:]) for k in bends)
    scale = f"{float(model.interior.c)!r} / p[0]" if model.distortion == "angle" else "1.0"
    exact = "C1 or C2 are not zero: the projection is exact, OpenCV's parameters are not."
    fields = {
        "name": _plain(model.name or model.camera), "id": identifier,
        "guard": f"THERMOCALD_{identifier.upper()}_H", "reference": _plain(reference),
        "low": repr(float(limits[0])), "high": repr(float(limits[1])), "width": sensor.width,
        "height": sensor.height, "pitch": repr(float(sensor.pixel_pitch)),
        "T0": repr(float(model.T0)), "p0": _row(p[0]), "p1": _row(p[1]), "p2": _row(p[2]),
        "n": len(rows), "knees": knees,
        "scale": scale, "lens": _LENSES[model.distortion],
        "exact": exact if affine else "OpenCV's parameters are exact.",
    }  # fmt: skip
    text = (_TEMPLATES / f"model.{kind}.txt").read_text(encoding="utf-8")
    return Template(text).substitute(fields)


def _plain(text: str) -> str:
    """Replace characters that could end a comment in C or a docstring."""
    return re.sub(r"[^\w .:()+-]", "?", text)


def _row(values: Array | tuple[float, ...]) -> str:
    return ", ".join(repr(float(v)) for v in values)
