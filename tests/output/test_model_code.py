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


TEMPERATURES = (20.0, 31.7, 35.0, 55.0)
OUTSIDE = (17.9, 57.1, 95.0, float("nan"))


def assert_opencv_sees(truth, X, K, distortion):
    """OpenCV with a camera matrix and its coefficients gives the true image points."""
    seen, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), np.array(K), np.array(distortion))
    assert np.abs(seen[:, 0] - truth).max() < 1e-9


@pytest.mark.parametrize(
    ("affine", "distortion"), [(False, "angle"), (True, "angle"), (False, "image")]
)
def test_the_python_module_is_the_model(tmp_path, affine, distortion):
    camera = thermal_camera(affine, distortion)
    (tmp_path / "m.py").write_text(code_of(camera, "m", "py"))
    module = runpy.run_path(str(tmp_path / "m.py"))
    X = points()
    for T in TEMPERATURES:
        true = truth(camera, T, X)
        assert np.abs([module["project"](T, *x) for x in X] - true).max() < 1e-9
        if not affine:
            assert_opencv_sees(true, X, *module["opencv"](T))
    with pytest.raises(ValueError, match="behind"):
        module["project"](35.0, 0.0, 0.0, -1.0)
    for T in OUTSIDE:
        for call in (module["interior"], module["opencv"], lambda T: module["project"](T, 0, 0, 1)):
            with pytest.raises(ValueError, match="outside the 20 to 55 degC"):
                call(T)
    assert len(module["interior"](18.1)) == 10


MAIN = """#include <stdio.h>
#include "rpi-2.h"
int main(void)
{
    double t, X[3], uv[2] = {0, 0}, K[9] = {0}, d[5] = {0}, p[10];
    while (scanf("%lf %lf %lf %lf", &t, X, X + 1, X + 2) == 4) {
        int seen = rpi_2_project(t, X, uv);
        if (rpi_2_opencv(t, K, d) != rpi_2_valid(t) || rpi_2_interior(t, p) != rpi_2_valid(t))
            return 1;
        printf("%d %d %.17g %.17g", rpi_2_valid(t), seen, uv[0], uv[1]);
        for (int k = 0; k < 9; k++) printf(" %.17g", K[k]);
        printf(" %.17g %.17g %.17g %.17g %.17g\\n", d[0], d[1], d[2], d[3], d[4]);
    }
    return 0;
}
"""


@pytest.mark.parametrize(("compiler", "flags"), [("cc", ["-std=c99"]), ("c++", ["-x", "c++"])])
def test_the_header_compiles_without_warnings_and_is_the_model(tmp_path, compiler, flags):
    """Its comments hold the camera's name, which ends a comment in C."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    camera = thermal_camera()
    header, _ = write_code(camera, tmp_path / "rpi-2.h")
    assert len(header.read_text().splitlines()) < 200
    X = points(50)
    (tmp_path / "main.c").write_text(MAIN)
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(
        [compiler, *flags, *warnings, "-O1", "main.c", "-o", "main"], cwd=tmp_path, check=True
    )
    given = [(t, 0.1, 0.1, 2.0) for t in OUTSIDE]
    given += [(T, *x) for T in TEMPERATURES for x in X.tolist()]
    said = subprocess.check_output(
        [tmp_path / "main"], input="".join(f"{t!r} {x!r} {y!r} {z!r}\n" for t, x, y, z in given),
        text=True,
    )  # fmt: skip
    rows = np.array([line.split() for line in said.splitlines()], dtype=float)
    assert not rows[:4].any()
    assert np.all(rows[4:, :2] == 1)
    for k, T in enumerate(TEMPERATURES):
        part, true = rows[4 + 50 * k : 54 + 50 * k], truth(camera, T, X)
        assert np.abs(part[:, 2:4] - true).max() < 1e-9
        assert_opencv_sees(true, X, part[0, 4:13].reshape(3, 3), part[0, 13:])
