"""A thermal model as code, in C and in Python without dependencies, and as a certificate to read.

The code evaluates the camera that has long been at a temperature T: the ten parameters as
polynomials in T, OpenCV's camera matrix and distortion coefficients, and the projection itself,
which holds also where C1 or C2 are not zero and OpenCV has no place for them.

The certificate says how the camera follows its temperature, and how far.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.figures import BAND, PALETTE, Curve, Figure, Panel
from thermocald.files import write_text
from thermocald.numbers import UNITS, parameter_label, plain, signed, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.report import Answer, Chapter, Section, Table, of_figure, render_report

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera


_C = """\
/* {name}: thermal camera model, written by thermocald. No dependencies; C99 and C++.

   double K[9], dist[5];
   {id}_opencv(35.0, K, dist);          OpenCV's camera matrix (row by row) and k1 k2 p1 p2 k3
   double X[3] = {{0.1, 0.2, 5.0}}, uv[2];
   {id}_project(35.0, X, uv);           X in OpenCV's camera frame: x right, y down, z forward

   T is the temperature in degC of {reference}, of a camera that has long been there.
   Fitted from {low} to {high} degC; beyond (2 K of margin) {id}_valid, {id}_interior, {id}_opencv
   and {id}_project return 0 and write nothing, else 1. {exact} */
#ifndef {guard}
#define {guard}

static const int {id}_width = {width}, {id}_height = {height};
static const double {id}_pitch = {pitch}; /* mm */

static inline int {id}_valid(double T) {{ return T >= {low} - 2.0 && T <= {high} + 2.0; }}

/* c, x0, y0 (mm), A1, A2, A3, B1, B2, C1, C2 at T */
static inline int {id}_interior(double T, double p[10])
{{
    static const double p0[10] = {{{p0}}};
    static const double p1[10] = {{{p1}}};
    static const double p2[10] = {{{p2}}};
    static const double knee[{n} + 1][11] = {{{knees}}};
    double d = T - ({T0});
    int i, k;
    if (!{id}_valid(T))
        return 0;
    for (i = 0; i < 10; i++)
        p[i] = p0[i] + d * (p1[i] + d * p2[i]);
    for (k = 0; k < {n}; k++)
        if (T > knee[k][0])
            for (i = 0; i < 10; i++)
                p[i] += (T - knee[k][0]) * knee[k][i + 1];
{follow_c}    return 1;
}}

static inline int {id}_opencv(double T, double K[9], double dist[5])
{{
    double p[10], c2;
    int i;
    if (!{id}_interior(T, p))
        return 0;
    c2 = p[0] * p[0];
    for (i = 0; i < 9; i++)
        K[i] = 0.0;
    K[0] = (1.0 + p[8]) * p[0] / {id}_pitch;
    K[4] = p[0] / {id}_pitch;
    K[2] = ({id}_width - 1) / 2.0 + p[1] / {id}_pitch;
    K[5] = ({id}_height - 1) / 2.0 - p[2] / {id}_pitch;
    K[8] = 1.0;
    dist[0] = p[3] * c2;
    dist[1] = p[4] * c2 * c2;
    dist[2] = -p[7] * p[0];
    dist[3] = p[6] * p[0];
    dist[4] = p[5] * c2 * c2 * c2;
    return 1;
}}

/* The image point in px, (0, 0) the centre of the upper left pixel; 0 behind the camera too */
static inline int {id}_project(double T, const double X[3], double uv[2])
{{
    double p[10], x, y, r2, radial, dx, dy;
    if (!(X[2] > 0.0) || !{id}_interior(T, p))
        return 0;
    x = p[0] * X[0] / X[2];
    y = -p[0] * X[1] / X[2];
    r2 = x * x + y * y;
    radial = r2 * (p[3] + r2 * (p[4] + r2 * p[5]));
    dx = x * radial + p[6] * (r2 + 2 * x * x) + 2 * p[7] * x * y + p[8] * x + p[9] * y;
    dy = y * radial + p[7] * (r2 + 2 * y * y) + 2 * p[6] * x * y;
    uv[0] = ({id}_width - 1) / 2.0 + (p[1] + x + dx) / {id}_pitch;
    uv[1] = ({id}_height - 1) / 2.0 - (p[2] + y + dy) / {id}_pitch;
    return 1;
}}

#endif
"""

_PYTHON = '''\
"""{name}: thermal camera model, written by thermocald. No dependencies.

T is the temperature in degC of {reference}, of a camera that has long been there. Fitted from {low}
to {high} degC; beyond (2 K of margin) every function raises ValueError. {exact}
"""

WIDTH, HEIGHT, PITCH = {width}, {height}, {pitch}  # px, px, mm
VALID = ({low}, {high})
T0 = {T0}
P0 = ({p0})
P1 = ({p1})
P2 = ({p2})
KNEES = ({knees})


def interior(T):
    """c, x0, y0 (mm), A1, A2, A3, B1, B2, C1, C2 at T."""
    if not VALID[0] - 2 <= T <= VALID[1] + 2:
        raise ValueError("%r degC lies outside the %g to %g degC of the fit" % (T, *VALID))
    d = T - T0
    p = [a + d * (b + d * c) for a, b, c in zip(P0, P1, P2)]
    for knee, *rate in KNEES:
        if T > knee:
            p = [v + (T - knee) * r for v, r in zip(p, rate)]
{follow_python}    return p


def opencv(T):
    """OpenCV's camera matrix, as rows, and (k1, k2, p1, p2, k3)."""
    c, x0, y0, A1, A2, A3, B1, B2, C1, _ = interior(T)
    K = (
        ((1 + C1) * c / PITCH, 0.0, (WIDTH - 1) / 2 + x0 / PITCH),
        (0.0, c / PITCH, (HEIGHT - 1) / 2 - y0 / PITCH),
        (0.0, 0.0, 1.0),
    )
    return K, (A1 * c**2, A2 * c**4, -B2 * c, B1 * c, A3 * c**6)


def project(T, X, Y, Z):
    """Image point (u, v) px of a point in OpenCV's camera frame: x right, y down, z forward."""
    if not Z > 0:
        raise ValueError("the point is behind the camera")
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2 = interior(T)
    x, y = c * X / Z, -c * Y / Z
    r2 = x * x + y * y
    radial = r2 * (A1 + r2 * (A2 + r2 * A3))
    dx = x * radial + B1 * (r2 + 2 * x * x) + 2 * B2 * x * y + C1 * x + C2 * y
    dy = y * radial + B2 * (r2 + 2 * y * y) + 2 * B1 * x * y
    return (WIDTH - 1) / 2 + (x0 + x + dx) / PITCH, (HEIGHT - 1) / 2 - (y0 + y + dy) / PITCH
'''

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
    """The model as one C header; UsageError where it needs more than one thermometer."""
    fields = _fields(camera, name)
    knees = [f"{{{_row(k)}}}" for k in camera.steady_knees()] or []
    fields["knees"] = ", ".join([*knees, "{0}"])
    return _C.format(**fields)


def python_module(camera: ThermalCamera, name: str) -> str:
    """The model as a Python module; UsageError where it needs more than one thermometer."""
    fields = _fields(camera, name)
    fields["knees"] = "".join(f"({_row(k)}), " for k in camera.steady_knees()).strip()
    return _PYTHON.format(**fields)


def write_code(camera: ThermalCamera, path: Path) -> tuple[Path, Path]:
    """Write PATH.h and PATH.py; OutputError where they cannot be written."""
    header, module = path.with_suffix(".h"), path.with_suffix(".py")
    texts = {header: c_header(camera, path.stem), module: python_module(camera, path.stem)}
    for file, text in texts.items():
        write_text(file, text)
    return header, module


def _fields(camera: ThermalCamera, name: str) -> dict[str, object]:
    model = camera.model
    sensor = model.sensor
    p = camera.steady_polynomials()
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"camera_{identifier}"
    reference, limits = next(iter(model.validity.items()), ("the thermometer", (-273.0, 1000.0)))
    affine = any(any(row[8:]) for row in p) or any(any(k[9:]) for k in camera.steady_knees())
    follow = model.distortion == "angle"
    c0 = repr(float(model.interior.c))
    exact = "C1 or C2 are not zero: OpenCV's parameters are then not exact, the projection is."
    return {
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
        "follow_c": _FOLLOW_C.format(c0=c0) if follow else "",
        "follow_python": _FOLLOW_PYTHON.format(c0=c0) if follow else "",
        "exact": exact if affine else "OpenCV's parameters are exact.",
    }


def _plain(text: str) -> str:
    """Text that neither a comment of C nor a docstring ends at."""
    return re.sub(r"[^\w .:()+-]", "?", text, flags=re.ASCII)


def _row(values: NDArray[np.float64] | tuple[float, ...]) -> str:
    return ", ".join(repr(float(v)) for v in values)


_DISTANCE_MM = 10_000.0
_STEPS = 41


def render_certificate(camera: ThermalCamera, made: datetime | None = None) -> str:
    """Return the page as HTML text; made: the time that it bears, by default now."""
    document = camera.as_dict()
    low, high = next(iter(document["validity"].values()))
    T = np.linspace(low, high, _STEPS)
    states = [camera.at(float(t)) for t in T]
    values = np.array([state.interior.as_array() for state in states])
    sds = np.array([[state.sd.get(name, 0.0) for name in IOP_NAMES] for state in states])
    missing = bool(document.get("effect_missing"))
    chapter = Chapter(
        f"Thermal model of {document['camera']}",
        Answer(
            _sentence(document, camera.model.sensor.pixel_pitch, low, high),
            of_figure(_drift(T, values, sds, missing)),
            tuple(_judged(document)),
            ("Find what is missing: thermocald discover.",) if missing
            else ("Correct measurements with: thermocald correct.",),
            (
                f"Temperatures below {low:g} and above {high:g} °C.",
                "Focus or lens moved since: calibrate again.",
                "Errors of the camera model itself, which no standard deviation here holds.",
            ),
        ),
        (
            Section("The model", tables=(_values(document), *_effects(document))),
            Section("What it rests on", tables=tuple(t for t in _evidence(document) if t.rows)),
        ),
        about=(_about(camera, document),),
        notes=tuple(f"Doubtful: {text}." for text in document.get("doubts", ())),
    )  # fmt: skip
    return render_report(chapter.title, [chapter], made=made)


def _about(camera: ThermalCamera, document: Mapping[str, Any]) -> str:
    sensor = camera.model.sensor
    text = f"{sensor.width} × {sensor.height} px of {sensor.pixel_pitch * 1000:g} µm"
    series = ", ".join(str(s["name"]) for s in document.get("series", ()))
    return f"{text}; fitted to {series}." if series else f"{text}."


def _sentence(document: Mapping[str, Any], pitch: float, low: float, high: float) -> str:
    """The largest of the rates with its sd, the range, and what that is on a plane."""
    rates = {n: (r["value"], r.get("sd", float("nan"))) for n, r in document["rates"].items()}
    if not rates:
        return f"The camera does not follow the temperature between {low:.0f} and {high:.0f} °C."
    name = max(rates, key=lambda n: abs(rates[n][0]))
    rate, sd = rates[name]
    text = (
        f"{parameter_label(name)} moves by {signed(rate / pitch, sd / pitch, 'px/K')} between "
        f"{low:.0f} and {high:.0f} °C"
    )
    if name != "c":
        c = document["interior"]["c"]["value"]
        text += f"; at 10 m that is {plain(abs(rate) * (high - low) / c * _DISTANCE_MM, 'mm', 3)}"
    return f"{text}."


def _judged(document: Mapping[str, Any]) -> list[str]:
    if why := document.get("not_examined"):
        return [f"Whether an effect is missing was not examined: {why}."]
    if document.get("effect_missing"):
        left = document.get("misfit_px")
        size = "" if left is None else f" of {left:.3f} px"
        return [(f"An effect is missing: the model leaves smooth trajectories{size}. The standard "
                "deviations are widened by that, and no 95 % band is stated.")]  # fmt: skip
    return ["The model leaves no more than noise."]


def _drift(T: np.ndarray, values: np.ndarray, sds: np.ndarray, missing: bool) -> Figure:
    middle = len(T) // 2
    panels = []
    for name in ("c", "x0", "y0"):
        k = IOP_NAMES.index(name)
        y, half = 1e3 * (values[:, k] - values[middle, k]), 1e3 * BAND * sds[:, k]
        curve = (
            Curve("", T, y, "line", PALETTE[0]) if missing
            else Curve("", T, y, "band", PALETTE[0], y - half, y + half)
        )  # fmt: skip
        label = parameter_label(name)
        panels.append(Panel(label, "temperature in °C", f"Δ{label} in µm", (curve,)))
    band = "no band is stated" if missing else "bands hold 95 %, the level's uncertainty included"
    return Figure(
        "drift", "How the camera follows its temperature",
        f"Each parameter less its value in the middle of the range, of a camera that has long been "
        f"at a temperature; {band}.",
        tuple(panels),
    )  # fmt: skip


def _shown(entry: Mapping[str, Any], scale: float, unit: str) -> str:
    return with_sd(scale * entry["value"], scale * entry.get("sd", float("nan")), unit)


def _values(document: Mapping[str, Any]) -> Table:
    rates = document["rates"]
    rows = tuple(
        (
            parameter_label(name),
            _shown(entry, 1.0, UNITS.get(name, "")),
            _shown(rates[name], 1e3, "µm/K") if name in rates else "",
        )
        for name, entry in document["interior"].items()
    )
    T0 = f"at {document['reference_temperature']:g} °C"
    return Table("Interior orientation", ("parameter", T0, "rate"), rows)


def _effects(document: Mapping[str, Any]) -> list[Table]:
    rows = tuple(
        (effect["effect"], name, _shown(entry, 1.0, "" if entry["unit"] == "1" else entry["unit"]))
        for effect in document["effects"]
        for name, entry in effect["parameters"].items()
        if isinstance(entry, dict)
    )
    return [Table("Effects", ("effect", "parameter", "value ± sd"), rows)] if rows else []


def _evidence(document: Mapping[str, Any]) -> list[Table]:
    return [
        Table(
            "Series",
            ("series", "epochs", "left over px RMS", "noise px", "thermometer ± K"),
            tuple(
                (s["name"], str(s["epochs"]), f"{s['rms_px']:.4f}", f"{s['noise_px']:.4f}",
                 f"{s['thermometer_sd']:.3f}")
                for s in document.get("series", ())
            ),
        ),
        Table(
            "Each series predicted from the others",
            ("series", "error px RMS", "noise alone px", "mm at 10 m"),
            tuple(
                (h["name"], f"{h['rms_px']:.4f}", f"{h['floor_px']:.4f}", f"{h['object_mm']:.2f}")
                for h in document.get("prediction_test", ())
            ),
        ),
    ]  # fmt: skip
