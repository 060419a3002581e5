"""A thermal model as code: a C header and a Python module without dependencies.

Both evaluate the camera that has long been at a temperature T: the ten parameters as polynomials in
T, OpenCV's camera matrix and distortion coefficients, and the projection itself, which holds also
where C1 or C2 are not zero and OpenCV has no place for them.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from thermocald.files import write_text

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
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
