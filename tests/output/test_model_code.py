"""The model as C and as Python: compiled, run, and equal to the model to 1e-9 px."""

from __future__ import annotations

import runpy
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.output.thermal_model import code_of, write_code
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics.model import ModelEffect, ThermalModel

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(3.04, 0.012, -0.018, A1=-4e-3, A2=5e-4, A3=-2e-5, B1=1e-4, B2=-2e-4)
RATES = {"c": 2e-4, "x0": -4e-4, "y0": 2e-4}


def thermal_camera(affine=False, distortion="angle"):
    interior = replace(INTERIOR, C1=1e-3, C2=-5e-4) if affine else INTERIOR
    effects = (
        ModelEffect("nonlinear_expansion", {"c": 1e-6, "x0": 2e-6, "y0": 0.0}),
        ModelEffect("thermal_lag", {"tau": 70.0}),
    )
    return ThermalCamera(
        ThermalModel(
            camera="rpi */ x", sensor=SENSOR, T0=35.0, interior=interior, rates=RATES,
            effects=effects, distortion=distortion, validity={"housing": (20.0, 55.0)},
        )
    )  # fmt: skip


def points(n=200):
    rng = np.random.default_rng(1)
    Z = rng.uniform(0.5, 20.0, n)
    return np.column_stack([rng.uniform(-0.5, 0.5, n) * Z, rng.uniform(-0.4, 0.4, n) * Z, Z])


def truth(camera, T, X):
    """The program's own projection, through its own frames."""
    state = camera.at(T)
    interior = InteriorOrientation.from_array(state.values)
    model = CameraModel(SENSOR, interior)
    return model.project(ExteriorOrientation.from_array(np.zeros(6)), X * np.array([1.0, -1, -1]))


KINDS = [(False, "angle"), (True, "angle"), (False, "image")]
TEMPERATURES = (20.0, 31.7, 35.0, 55.0)


@pytest.mark.parametrize(("affine", "distortion"), KINDS)
def test_the_python_module_is_the_model(tmp_path, affine, distortion):
    camera = thermal_camera(affine, distortion)
    (tmp_path / "m.py").write_text(code_of(camera, "m", "py"))
    module = runpy.run_path(str(tmp_path / "m.py"))
    X = points()
    for T in TEMPERATURES:
        found = np.array([module["project"](T, *x) for x in X])
        assert np.abs(found - truth(camera, T, X)).max() < 1e-9
        if not affine:
            K, distortion = module["opencv"](T)
            image = cv2.projectPoints(
                X, np.zeros(3), np.zeros(3), np.array(K), np.array(distortion)
            )
            assert np.abs(image[0][:, 0] - truth(camera, T, X)).max() < 1e-9
    with pytest.raises(ValueError, match="behind"):
        module["project"](35.0, 0.0, 0.0, -1.0)
    for T in (17.9, 57.1, 95.0, float("nan")):
        for call in (module["interior"], module["opencv"], lambda T: module["project"](T, 0, 0, 1)):
            with pytest.raises(ValueError, match="outside the 20 to 55 degC"):
                call(T)
    assert len(module["interior"](18.1)) == 10


@pytest.mark.parametrize(("compiler", "flags"), [("cc", ["-std=c99"]), ("c++", ["-x", "c++"])])
def test_the_header_compiles_without_warnings_and_is_the_model(tmp_path, compiler, flags):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    camera = thermal_camera()
    header, _ = write_code(camera, tmp_path / "rpi-2.h")
    assert len(header.read_text().splitlines()) < 200
    X = points(50)
    (tmp_path / "main.c").write_text(
        """#include <stdio.h>
#include "rpi-2.h"
int main(void)
{
    double t, X[3], uv[2] = {0, 0}, K[9] = {0}, d[5] = {0}, p[10];
    while (scanf("%lf %lf %lf %lf", &t, X, X + 1, X + 2) == 4) {
        int seen = rpi_2_project(t, X, uv);
        if (rpi_2_opencv(t, K, d) != rpi_2_valid(t) || rpi_2_interior(t, p) != rpi_2_valid(t))
            return 1;
        printf("%d %d %.17g %.17g", rpi_2_valid(t), seen, uv[0], uv[1]);
        printf(" %.17g %.17g %.17g %.17g", K[0], K[4], K[2], K[5]);
        printf(" %.17g %.17g %.17g %.17g %.17g\\n", d[0], d[1], d[2], d[3], d[4]);
    }
    return 0;
}
"""
    )
    subprocess.run(
        [compiler, *flags, "-Wall", "-Wextra", "-Werror", "-O1", "main.c", "-o", "main"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    outside = [17.9, 57.1, 95.0]
    said = subprocess.run(
        [tmp_path / "main"], input="".join(f"{t} 0.1 0.1 2\n" for t in [*outside, "nan"]),
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert [line.split() for line in said.splitlines()] == 4 * [13 * ["0"]]
    given = "".join(f"{t!r} {x!r} {y!r} {z!r}\n" for t in TEMPERATURES for x, y, z in X.tolist())
    said = subprocess.run(
        [tmp_path / "main"], input=given, capture_output=True, text=True, check=True
    ).stdout
    rows = np.array([line.split() for line in said.splitlines()], dtype=float)
    assert np.all(rows[:, :2] == 1)
    for k, T in enumerate(TEMPERATURES):
        part = rows[50 * k : 50 * (k + 1)]
        true = truth(camera, T, X)
        assert np.abs(part[:, 2:4] - true).max() < 1e-9
        fx, fy, cx, cy, *d = part[0, 4:]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        image = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, np.array(d))[0][:, 0]
        assert np.abs(image - true).max() < 1e-9


def test_names_cannot_break_out_of_the_comment():
    text = code_of(thermal_camera(), "x*/y", "h")
    assert text.split("*/")[0].count("/*") == 1
    assert "*/ x" not in text
