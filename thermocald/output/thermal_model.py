"""The certificate of a thermal model, and its code in C and in Python without dependencies.

The certificate states how the camera changes with its temperature, and over which range. The code
evaluates the camera at a steady temperature T: the ten parameters as polynomials in T, OpenCV's
camera matrix and distortion coefficients, and the projection itself, which is also valid if C1 or
C2 are not zero, for which OpenCV has no parameters.
"""

from __future__ import annotations

import re
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.figures import BAND, Curve, Figure, Panel
from thermocald.files import write_text
from thermocald.numbers import UNITS, parameter_label, signed, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.report import Answer, Chapter, Section, Table, as_sentence
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array

_DISTANCE_MM = 10_000.0
_STEPS = 41


def render_certificate(camera: ThermalCamera) -> str:
    """Return the page as HTML text."""
    document = camera.as_dict()
    low, high = next(iter(document["validity"].values()))
    T = np.linspace(low, high, _STEPS)
    states = [camera.at(float(t)) for t in T]
    values = np.array([state.interior.as_array() for state in states])
    sds = np.array([[state.sd.get(name, 0.0) for name in IOP_NAMES] for state in states])
    missing = bool(document.get("effect_missing"))
    series = ", ".join(str(s["name"]) for s in document.get("series", ()))
    return Chapter(
        f"Thermal model of {document['camera']}",
        Answer(
            _sentence(document, camera.model.sensor.pixel_pitch, low, high),
            _drift(T, values, sds, missing),
            tuple(_assess_misfit(document)),
            ("Find the missing effect: thermocald discover.",) if missing
            else ("Correct measurements with: thermocald correct.",),
            (
                f"Temperatures below {low:g} and above {high:g} °C.",
                "A change of focus or lens after the series: calibrate again.",
                "Errors of the camera model itself, which no standard deviation here includes.",
            ),
        ),
        (
            _section("The model", _values(document), _effects(document)),
            _section("Evidence", *_evidence(document)),
        ),
        about=(f"{camera.model.sensor}{f'; fitted to {series}' if series else ''}.",),
        notes=tuple(as_sentence(line) for line in doubt_lines(document.get("doubts", ()))),
    ).page()  # fmt: skip


def _section(title: str, *tables: Table) -> Section:
    return Section(title, tables=tuple(table for table in tables if table.rows))


def _sentence(document: Mapping[str, Any], pitch: float, low: float, high: float) -> str:
    """State the largest rate with its sd, the range, and the effect of both on a plane at 10 m."""
    rates = {n: (r["value"], r.get("sd", float("nan"))) for n, r in document["rates"].items()}
    if not rates:
        return f"The camera does not change with temperature between {low:.0f} and {high:.0f} °C."
    name = max(rates, key=lambda n: abs(rates[n][0]))
    rate, sd = rates[name]
    text = (
        f"{parameter_label(name)} moves by {signed(rate / pitch, sd / pitch, 'px/K')} between "
        f"{low:.0f} and {high:.0f} °C"
    )
    if name != "c":
        c = document["interior"]["c"]["value"]
        per_rate = (high - low) / c * _DISTANCE_MM
        text += f", in all {with_sd(abs(rate) * per_rate, sd * per_rate, 'mm')} at 10 m"
    return f"{text}."


def _assess_misfit(document: Mapping[str, Any]) -> list[str]:
    if why := document.get("not_examined"):
        return [f"Whether an effect is missing was not examined: {why}."]
    if document.get("effect_missing"):
        left = document.get("misfit_px")
        size = "" if left is None else f" of {left:.3f} px"
        return [(f"An effect is missing: the residuals have smooth trajectories{size}. They are "
                "included in the standard deviations, and no 95 % band is given.")]  # fmt: skip
    return ["The residuals are no larger than the noise."]


def _drift(T: Array, values: Array, sds: Array, missing: bool) -> Figure:
    middle = len(T) // 2
    panels = []
    for name in ("c", "x0", "y0"):
        k = IOP_NAMES.index(name)
        y, half = 1e3 * (values[:, k] - values[middle, k]), 1e3 * BAND * sds[:, k]
        curve = Curve("", T, y, half=None if missing else half)
        label = parameter_label(name)
        panels.append(Panel(label, "temperature in °C", f"Δ{label} in µm", (curve,)))
    band = "no band is given" if missing else "bands: 95 %, with the uncertainty of the level"
    return Figure(
        "drift", "Change of the camera with its temperature",
        "Each parameter minus its value in the middle of the range, at steady temperatures; "
        f"{band}.",
        tuple(panels),
    )  # fmt: skip


def _shown(entry: Mapping[str, Any], unit: str, scale: float = 1.0) -> str:
    return with_sd(scale * entry["value"], scale * entry.get("sd", float("nan")), unit)


def _values(document: Mapping[str, Any]) -> Table:
    rates = document["rates"]
    return Table.of(
        "Interior orientation",
        document["interior"].items(),
        {
            "parameter": lambda r: parameter_label(r[0]),
            f"at {document['reference_temperature']:g} °C": lambda r: _shown(
                r[1], UNITS.get(r[0], "")
            ),
            "rate": lambda r: _shown(rates[r[0]], "µm/K", 1e3) if r[0] in rates else "",
        },
    )


def _effects(document: Mapping[str, Any]) -> Table:
    found = [
        (effect["effect"], name, entry)
        for effect in document["effects"]
        for name, entry in effect["parameters"].items()
        if isinstance(entry, dict)
    ]
    return Table.of(
        "Effects",
        found,
        {
            "effect": lambda r: str(r[0]),
            "parameter": lambda r: str(r[1]),
            "value ± sd": lambda r: _shown(r[2], "" if r[2]["unit"] == "1" else r[2]["unit"]),
        },
    )


def _evidence(document: Mapping[str, Any]) -> list[Table]:
    return [
        Table.of(
            "Series",
            document.get("series", ()),
            {
                "series": lambda s: str(s["name"]),
                "epochs": lambda s: str(s["epochs"]),
                "residual px RMS": lambda s: f"{s['rms_px']:.4f}",
                "noise px": lambda s: f"{s['noise_px']:.4f}",
                "thermometer ± K": lambda s: f"{s['thermometer_sd']:.3f}",
            },
        ),
        Table.of(
            "Each series predicted from the others",
            document.get("prediction_test", ()),
            {
                "series": lambda s: str(s["name"]),
                "error px RMS": lambda s: f"{s['rms_px']:.4f}",
                "noise alone px": lambda s: f"{s['floor_px']:.4f}",
                "mm at 10 m": lambda s: f"{s['object_mm']:.2f}",
            },
        ),
    ]


_TEMPLATES = Path(__file__).parent / "templates"
_FOLLOW_C = """\
    /* the lens preserves the angles of its rays: the distortion scales with c */
    double s = {c0} / p[0];
    p[3] *= s * s;
    p[4] *= s * s * s * s;
    p[5] *= s * s * s * s * s * s;
    p[6] *= s;
    p[7] *= s;
"""

_FOLLOW_PYTHON = """\
    s = {c0} / p[0]  # the lens preserves the angles of its rays: the distortion scales with c
    p[3:8] = p[3] * s**2, p[4] * s**4, p[5] * s**6, p[6] * s, p[7] * s
"""


def write_code(camera: ThermalCamera, path: Path) -> tuple[Path, Path]:
    """Write PATH.h and PATH.py and return their paths; OutputError if they cannot be written."""
    header, module = path.with_suffix(".h"), path.with_suffix(".py")
    texts = [code_of(camera, path.stem, kind) for kind in ("h", "py")]
    for file, text in zip((header, module), texts, strict=True):
        write_text(file, text)
    return header, module


def code_of(camera: ThermalCamera, name: str, kind: Literal["h", "py"]) -> str:
    """Return the model as a C header or a Python module.

    Raises UsageError for a model that needs more than one thermometer.
    """
    model = camera.model
    sensor = model.sensor
    p = camera.steady_polynomials()
    rows = [_row(k) for k in camera.steady_knees()]
    if kind == "h":
        follow, knees = _FOLLOW_C, ", ".join([*(f"{{{row}}}" for row in rows), "{0}"])
    else:
        follow, knees = _FOLLOW_PYTHON, "".join(f"({row}), " for row in rows).strip()
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"camera_{identifier}"
    reference, limits = next(iter(model.validity.items()), ("the thermometer", (-273.0, 1000.0)))
    affine = any(any(row[8:]) for row in p) or any(any(k[9:]) for k in camera.steady_knees())
    c0 = repr(float(model.interior.c))
    exact = "C1 or C2 are not zero: the projection is exact, OpenCV's parameters are not."
    fields = {
        "name": _plain(model.name or model.camera), "id": identifier,
        "guard": f"THERMOCALD_{identifier.upper()}_H", "reference": _plain(reference),
        "low": repr(float(limits[0])), "high": repr(float(limits[1])), "width": sensor.width,
        "height": sensor.height, "pitch": repr(float(sensor.pixel_pitch)),
        "T0": repr(float(model.T0)), "p0": _row(p[0]), "p1": _row(p[1]), "p2": _row(p[2]),
        "n": len(rows), "knees": knees,
        "follow": follow.format(c0=c0) if model.distortion == "angle" else "",
        "exact": exact if affine else "OpenCV's parameters are exact.",
    }  # fmt: skip
    text = (_TEMPLATES / f"model.{kind}.txt").read_text(encoding="utf-8")
    return Template(text).substitute(fields)


def _plain(text: str) -> str:
    """Replace characters that could end a comment in C or a docstring."""
    return re.sub(r"[^\w .:()+-]", "?", text, flags=re.ASCII)


def _row(values: Array | tuple[float, ...]) -> str:
    return ", ".join(repr(float(v)) for v in values)
