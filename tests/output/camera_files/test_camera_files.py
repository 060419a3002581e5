"""Camera files: other programs' own readers and formulas give the same pixels; round trips."""

from __future__ import annotations

import json
import re
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from thermocald.errors import ConfigurationError, UsageError
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)

TOLERANCE_PX = 1e-6
SENSOR = Sensor(3280, 2464, 0.00112)
PINHOLE = InteriorOrientation(c=3.05, x0=0.021, y0=-0.013)
PLAIN = replace(PINHOLE, A1=-2.1e-3, A2=4.0e-4, A3=-2.0e-5, B1=4e-5, B2=-3e-5)
FORMATS, OURS = set(camera_files.FORMATS), {"json", "yaml"}
CAMERAS = {
    "plain": (PLAIN, FORMATS - {"kalibr"}),
    "without A3": (replace(PLAIN, A3=0.0), FORMATS),
    "affinity": (replace(PLAIN, C1=3e-4), OURS),
    "shear": (replace(PLAIN, C2=3e-4), OURS),
    "all": (replace(PLAIN, C1=3e-4, C2=-2e-4), OURS),
    "pinhole with affinity": (replace(PINHOLE, C1=3e-4), FORMATS),
    "pinhole with both": (replace(PINHOLE, C1=2e-3, C2=-1e-3), OURS | {"metashape", "aicon"}),
}
"""By name: the camera, and the formats whose convention holds it exactly."""

X, Y = (v.ravel() for v in np.meshgrid(np.linspace(-0.58, 0.58, 23), np.linspace(-0.43, 0.43, 17)))
VIEW = (
    np.column_stack([X, Y, np.ones(X.size)]) * (1e3 + 300 * np.sin(7 * X) * np.cos(5 * Y))[:, None]
)
"""Points (n, 3) before a camera, in OpenCV's axes, that fill the image of `plain`."""


def _camera():
    return CameraModel(SENSOR, PLAIN)


def _pixels(model, view=VIEW):
    """The truth: our own projection of points in OpenCV's axes."""
    return model.project(ExteriorOrientation(0, 0, 0, 0, 0, 0), view * [1, -1, -1])


# --- other programs: OpenCV's and mrcal's own readers; formulas from the others' manuals -------


def _projected(fx, fy, cx, cy, *distortion):
    """OpenCV's projection, which ROS, COLMAP and Kalibr share."""
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return cv2.projectPoints(VIEW, np.zeros(3), np.zeros(3), K, np.array(distortion))[0][:, 0]


def _opencv(path):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, d = (storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients"))
    assert [int(storage.getNode(n).real()) for n in ("image_width", "image_height")] == [3280, 2464]
    storage.release()
    return _projected(*K[[0, 1, 0, 1], [0, 1, 2, 2]], *d.ravel())


_MRCAL = """
import json, sys
import numpy as np
import mrcal
model = mrcal.cameramodel(sys.argv[1])
assert list(model.imagersize()) == [3280, 2464]
points = np.array(json.load(sys.stdin))
print(json.dumps(mrcal.project(points, *model.intrinsics()).tolist()))
"""


def _mrcal(path):
    """What Debian's python3-mrcal makes of it, in the system's interpreter."""
    if not Path("/usr/lib/python3/dist-packages/mrcal").exists():
        pytest.skip("python3-mrcal is not installed (apt install python3-mrcal)")
    command = ["/usr/bin/python3", "-c", _MRCAL, path]
    given = json.dumps(VIEW.tolist())
    return np.array(json.loads(subprocess.check_output(command, input=given, text=True)))


def _ros(path):
    info = yaml.safe_load(path.read_text())
    assert (info["camera_name"], info["distortion_model"]) == ("left", "plumb_bob")
    K, d, _, _ = (
        np.reshape(info[key]["data"], (info[key]["rows"], info[key]["cols"]))
        for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix",
                    "projection_matrix")
    )  # fmt: skip
    return _projected(*K[[0, 1, 0, 1], [0, 1, 2, 2]], *d.ravel())


def _colmap(path):
    """The upper left pixel's centre is (0.5, 0.5)."""
    (line,) = [row for row in path.read_text().splitlines() if not row.startswith("#")]
    _, model, width, height, *parameters = line.split()
    assert (int(width), int(height)) == (3280, 2464)
    assert (model, len(parameters)) in [("FULL_OPENCV", 12), ("OPENCV", 8)]
    return _projected(*(float(p) for p in parameters)) - 0.5


def _kalibr(path):
    cam = yaml.safe_load(path.read_text())["cam0"]
    assert (cam["camera_model"], cam["distortion_model"]) == ("pinhole", "radtan")
    assert cam["resolution"] == [3280, 2464]
    return _projected(*cam["intrinsics"], *cam["distortion_coeffs"])


def _metashape(path):
    """u = w/2 + cx + x'f + x'B1 + y'B2, the upper left pixel's centre is (0.5, 0.5)."""
    root = ET.parse(path).getroot()
    assert (root.tag, root.findtext("projection")) == ("calibration", "frame")
    tags = ("width", "height", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    v = {tag: float(root.findtext(tag)) for tag in tags}
    x, y = (VIEW[:, :2] / VIEW[:, 2:]).T
    r2 = x * x + y * y
    f = 1 + v["k1"] * r2 + v["k2"] * r2**2 + v["k3"] * r2**3 + v["k4"] * r2**4
    xd = x * f + v["p1"] * (r2 + 2 * x * x) + 2 * v["p2"] * x * y
    yd = y * f + v["p2"] * (r2 + 2 * y * y) + 2 * v["p1"] * x * y
    u = v["width"] * 0.5 + v["cx"] + xd * v["f"] + xd * v["b1"] + yd * v["b2"]
    return np.column_stack([u, v["height"] * 0.5 + v["cy"] + yd * v["f"]]) - 0.5


def _aicon(path):
    """FlowVeloTool splits the whole file at single blanks and counts fields; its formulas, in mm.

    This is that program's reading of the format, not a check against the vendor's own.
    """
    fields = path.read_text().split(" ")
    ck, xh, yh, a1, a2, r0, a3, b1, b2, c1, c2 = (float(f) for f in fields[2:13])
    width, height, columns, rows = (float(f) for f in fields[13:17])
    assert ck < 0 < r0
    x, y = -ck * VIEW[:, 0] / VIEW[:, 2], ck * VIEW[:, 1] / VIEW[:, 2]
    r2, q = x * x + y * y, r0**2
    radial = a1 * (r2 - q) + a2 * (r2**2 - q**2) + a3 * (r2**3 - q**3)
    x, y = (
        x + x * radial + b1 * (r2 + 2 * x * x) + 2 * b2 * x * y,
        y + y * radial + b2 * (r2 + 2 * y * y) + 2 * b1 * x * y,
    )
    x, y = xh + (1 + c1) * x + c2 * y, yh + y
    return np.column_stack(
        [x * columns / width + (columns - 1) / 2, -y * rows / height + (rows - 1) / 2]
    )


READERS = {
    "opencv": _opencv, "mrcal": _mrcal, "ros": _ros, "colmap": _colmap, "kalibr": _kalibr,
    "metashape": _metashape, "aicon": _aicon,
}  # fmt: skip


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("name", camera_files.FORMATS)
def test_the_other_program_and_ours_project_the_same_pixels(tmp_path, camera, name):
    """Exactly where the format's convention allows, else as well as the file states."""
    (interior, exact_in), path = CAMERAS[camera], tmp_path / "camera"
    model = CameraModel(SENSOR, interior)
    comment = "21 °C\nin workshop 3"
    statement = camera_files.write(model, path, name, name="left", comment=comment)
    text = path.read_text(encoding="utf-8")
    assert "in workshop 3" in text
    assert name == "json" or statement in text
    assert statement.startswith("exact") is (name in exact_in)
    # three digits are printed
    stated = re.search(r"largest residual ([\d.e-]+) px", statement)
    allowed = (1.01 * float(stated[1]) if stated else 0.0) + TOLERANCE_PX
    if name in READERS:
        assert np.linalg.norm(READERS[name](path) - _pixels(model), axis=1).max() < allowed
    back = camera_files.read(path)
    assert back.format == name
    sensor = back.model.sensor
    assert (sensor.width, sensor.height) == (3280, 2464)
    assert sensor.pixel_pitch == pytest.approx(SENSOR.pixel_pitch, rel=1e-15)
    off = np.linalg.norm(_pixels(back.model) - _pixels(model), axis=1).max()
    assert off < allowed + 1.01 * back.largest_px
    if name in exact_in:
        values = back.model.interior.as_array()
        assert values == pytest.approx(interior.as_array(), rel=1e-9, abs=1e-13)


def test_pixel_pitch_is_asked_for_where_nobody_states_it_and_must_be_the_files(tmp_path):
    path = tmp_path / "camera.yaml"
    camera_files.write(_camera(), path, "json")
    with pytest.raises(ConfigurationError, match=r"0\.002 mm was given"):
        camera_files.read(path, pixel_pitch=0.002)
    camera_files.write(_camera(), path, "opencv")
    path.write_text(re.sub("(?m)^.*pixel_pitch.*$", "", path.read_text()))
    with pytest.raises(ConfigurationError, match="--pixel-pitch"):
        camera_files.read(path)
    back = camera_files.read(path, pixel_pitch=0.00112)
    assert back.model.interior.as_array() == pytest.approx(PLAIN.as_array(), rel=1e-9)


# --- imports that nobody writes here -----------------------------------------------------------


def test_rational_model_is_imported_by_a_fit_that_states_its_residual(tmp_path):
    K = np.array([[2723.0, 0, 1650.0], [0, 2720.0, 1220.0], [0, 0, 1]])
    d = np.array([0.11, -0.2, 1e-4, -2e-4, 0.02, 0.08, -0.15, 0.01])
    path = tmp_path / "rational.yaml"
    document = {"image_width": 3280, "image_height": 2464, "camera_matrix": K.ravel().tolist(),
                "distortion_coefficients": d.tolist()}  # fmt: skip
    path.write_text(f"%YAML:1.0\n---\n{yaml.safe_dump(document)}")
    back = camera_files.read(path, pixel_pitch=0.00112)
    assert not back.exact
    inside = VIEW[np.abs(VIEW[:, 0] / VIEW[:, 2]) < 0.55]
    image, _ = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), K, d)
    off = np.linalg.norm(image[:, 0] - _pixels(back.model, inside), axis=1)
    assert off.max() < 1.05 * back.largest_px
    assert 0 < back.rms_px < back.largest_px < 1.0


@pytest.mark.parametrize("suffix", ["xml", "json"])
def test_all_files_of_opencv_are_read(tmp_path, suffix):
    camera_files.write(_camera(), tmp_path / "a.yaml", "opencv", _covariance())
    given = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_READ)
    out = cv2.FileStorage(str(tmp_path / f"a.{suffix}"), cv2.FILE_STORAGE_WRITE)
    out.write("calibration_time", "Mon")
    for name in ("image_width", "image_height"):
        out.write(name, int(given.getNode(name).real()))
    for name in ("camera_matrix", "distortion_coefficients", "intrinsics_covariance"):
        out.write(name, given.getNode(name).mat())
    out.release()
    back = camera_files.read(tmp_path / f"a.{suffix}", pixel_pitch=SENSOR.pixel_pitch)
    assert back.model.interior.as_array() == pytest.approx(PLAIN.as_array(), rel=1e-9, abs=1e-13)
    assert back.covariance is not None


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 SIMPLE_PINHOLE 4000 3000 3500 2000.5 1500.5", {"c": 3.5, "x0": 0.0005, "C1": 0.0}),
        ("1 PINHOLE 4000 3000 3600 3500 2000 1500", {"c": 3.5, "x0": 0.0, "C1": 0.1 / 3.5}),
        ("7 SIMPLE_RADIAL 4000 3000 3500 2000 1500 0.1", {"A1": 0.1 / 3.5**2}),
        ("1 RADIAL 4000 3000 3500 2000 1500 0.1 -0.05", {"A2": -0.05 / 3.5**4}),
    ],
)
def test_colmap_simple_models(tmp_path, line, expected):
    path = tmp_path / "cameras.txt"
    path.write_text(f"# Camera list\n{line}\n")
    back = camera_files.read(path, pixel_pitch=0.001)
    assert back.exact
    found = {name: getattr(back.model.interior, name) for name in expected}
    assert found == pytest.approx(expected, abs=1e-12)


def test_metashape_sensor_with_covariance(tmp_path):
    text = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk><sensors><sensor id="0" type="frame">
<calibration type="frame" class="adjusted"><resolution width="2256" height="1504"/>
<f>1940.44</f><cx>13.17</cx><cy>9.91</cy><k1>-0.1</k1></calibration>
<covariance><params>f cx k1</params><coeffs>4 0 0 0 1 0 0 0 1e-6</coeffs></covariance>
</sensor></sensors></chunk></document>"""
    path = tmp_path / "cameras.xml"
    path.write_text(text)
    back = camera_files.read(path, pixel_pitch=0.002)
    i = back.model.interior
    assert (i.c, i.x0, i.y0) == pytest.approx((1940.44 * 0.002, 13.17 * 0.002, -9.91 * 0.002))
    sd = np.sqrt(np.diag(back.covariance))
    assert sd[:3] == pytest.approx([0.004, 0.002, 0.0], abs=1e-9)
    # A1 = k1/c²: the covariance knows both
    assert sd[3] == pytest.approx(np.hypot(1e-3 / i.c**2, 2 * 0.1 / i.c**3 * 0.004), rel=1e-4)
    path.write_text(text.replace("<params>f cx k1</params>", ""))
    assert camera_files.read(path, pixel_pitch=0.002).covariance is None


@pytest.mark.parametrize("r0", [0.0, 1.5])
def test_balanced_terms_at_the_measured_point_are_imported(tmp_path, r0):
    """The two conventions of CONVENTIONS §2 that are accepted on import, in one file."""
    v = {"Ck": -8.2 if r0 else 8.2, "Xh": 0.03, "Yh": -0.02, "A1": -1.2e-3, "A2": 2e-5,
         "R0": r0, "A3": 0.0, "B1": 2e-5, "B2": -1e-5, "C1": 1e-4, "C2": -5e-5,
         "sensor_width_mm": 8.0, "sensor_height_mm": 6.0, "pixels_x": 2000,
         "pixels_y": 1500}  # fmt: skip
    path = tmp_path / "camera.ior"
    path.write_text("camera x\n" + "".join(f"{k} {value}\n" for k, value in v.items()))
    back = camera_files.read(path)
    assert not back.exact
    assert 0 < back.rms_px < back.largest_px < 0.05
    grid = np.array([[10, 10], [1990, 20], [1000, 700], [100, 1480], [1500, 300.0]])
    x, y = (grid[:, 0] - 999.5) * 0.004 - 0.03, -(grid[:, 1] - 749.5) * 0.004 + 0.02
    r2 = x * x + y * y
    radial = -1.2e-3 * (r2 - r0**2) + 2e-5 * (r2**2 - r0**4)
    dx = x * radial + 2e-5 * (r2 + 2 * x * x) - 2e-5 * x * y + 1e-4 * x - 5e-5 * y
    dy = y * radial - 1e-5 * (r2 + 2 * y * y) + 4e-5 * x * y
    rays = back.model.rays(grid)
    off = np.column_stack([(x - dx) / 8.2 + rays[:, 0] / rays[:, 2],
                           (y - dy) / 8.2 + rays[:, 1] / rays[:, 2]])  # fmt: skip
    assert np.abs(off).max() * 8.2 / 0.004 < 1.1 * back.largest_px


# --- covariance --------------------------------------------------------------------------------


def _covariance():
    """A full covariance of a realistic size, with strong correlations."""
    rng = np.random.default_rng(3)
    sd = np.array([3e-4, 2e-4, 2e-4, 3e-5, 1e-5, 1e-6, 3e-6, 3e-6, 1e-5, 1e-5])
    mix = rng.normal(size=(10, 10)) + 2 * np.eye(10)
    R = mix @ mix.T
    d = np.sqrt(np.diag(R))
    return R / np.outer(d, d) * np.outer(sd, sd)


@pytest.mark.parametrize("name", ["opencv", "json", "aicon"])
def test_covariance_comes_back(tmp_path, name):
    """AICON's file has only standard deviations, of other terms than ours but for x0, y0."""
    Q, path = _covariance(), tmp_path / "camera"
    if name == "opencv":
        Q[9:], Q[:, 9:] = 0, 0  # shear has no slot
    camera_files.write(_camera(), path, name, Q)
    back, sd = np.sqrt(np.diag(camera_files.read(path).covariance)), np.sqrt(np.diag(Q))
    if name == "opencv":
        document = yaml.safe_load(re.sub("(?m)^%.*|!!opencv-matrix", "", path.read_text()))
        _, *fy_cx = document["std_deviation_intrinsics"]["data"][:3]
        assert fy_cx == pytest.approx(sd[:2] / SENSOR.pixel_pitch, rel=1e-4)
    if name == "aicon":
        stated = re.search(r"# sd +Xh +([\d.e-]+)", path.read_text())
        assert float(stated[1]) == pytest.approx(sd[1], rel=0.01)
    same = slice(1, 2) if name == "aicon" else slice(None)
    assert back[same] == pytest.approx(sd[same], rel=2e-2, abs=1e-7)


@pytest.mark.parametrize("to", ["json", "aicon", "opencv"])
def test_what_was_held_keeps_no_standard_deviation(tmp_path, to):
    """Regression: rounding left a negative variance; the next file got NaN, or was not written."""
    for held in (slice(8, 10), slice(5, 10), slice(3, 10)):
        Q = _covariance()
        Q[held], Q[:, held] = 0, 0
        first, second = tmp_path / "first.yml", tmp_path / f"second-{to}"
        camera_files.write(_camera(), first, "opencv", Q)
        camera_files.convert(first, second, to, pixel_pitch=SENSOR.pixel_pitch)
        sds = np.sqrt(np.diag(camera_files.read(second).covariance))
        assert sds[[8, 9]].tolist() == [0.0, 0.0]
        assert np.isfinite(sds).all()


# --- wrong files -------------------------------------------------------------------------------


def _own(**changes):
    """Return the text of a file of our own, with some keys changed."""
    sensor = {"width": 100, "height": 100, "pixel_pitch": 0.001}
    document = {"format": "thermocald-camera/1", "interior": {"c": 0.1}, "sensor": sensor}
    return json.dumps(document | changes)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("%YAML:1.0\n---\ncamera_matrix: [1, 2\n", "its YAML, line 4"),
        ("%YAML:1.0\n---\ncamera_matrix: [0,05]\n", "line 3, column 19: 05 .* for a decimal comma"),
        ("cam0: {}\ncamera_model: x\ncam0: {}\n", "its YAML, line 3, column 1: key 'cam0' is dup"),
        ("<opencv_storage><a/><camera_matrix/><a/></opencv_storage>", "<a> is duplicated"),
        ("<calibration><f>944</f><cx>0</cx><f>950</f></calibration>", "<f> is duplicated"),
        ("<calibration><f>944</f><skew>0.1</skew></calibration>", "<skew> cannot be read: only f"),
        ("{'lensmodel': 1, 'imagersize': 1, 'lensmodel': 1}", "a key is duplicated"),
        (_own(interior={"c": 0.1, "x0": True}), "interior.x0 is True, not a number"),
        (_own().replace('"c"', '"c": 0.2, "c"'), "key 'c' is duplicated"),
        ("hello: 1\n", "not a camera file of any"),
        ("image_width: 10\ndistortion_model: equidistant\n", "equidistant"),
        ("cam0:\n  camera_model: omni\n", "omni"),
        ("1 OPENCV_FISHEYE 100 100 1 2 3 4 5 6 7 8\n", "OPENCV_FISHEYE"),
        ("1 PINHOLE 100 100 90 90 50 50\n2 PINHOLE 100 100 90 90 50 50\n", "2 cameras"),
        ("{'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC', 'imagersize': 1}", "SPLINED"),
        ("__import__('os') # lensmodel imagersize", "Python's notation"),
        ("<calibration><projection>fisheye</projection></calibration>", "fisheye"),
        ("<!DOCTYPE x><calibration/>", "DOCTYPE"),
        ("<calibration><f>nan</f></calibration>", "finite"),
        ("Ck -8\nCk -9\n", "line 2: Ck is duplicated"),
        ("Ck\n", "no value"),
        ("Ck -8\nfoo 3\n", "foo"),
        ("1 1 -8 0 0 1e-3 0 0 0 0 0 0 0 8 6 2000 1500", "R0 is 0"),
        ("1 1 -8 0 0 0 0 2 0 0 0 0 0 8 6 0 1500", "columns"),
        ("1 1 -8 0 0 0 0 2 0 0 0 0 0 6 8 2000 1500", "width and height exchanged"),
        ("1 1 -8 0 0 0 0 2 0 0 0 0 0 8 6 2000 1500", "0.001 mm was given, but .* 0.004 mm"),
        ('{"format": "thermocald-camera/1"}', "sensor or interior"),
        (_own(covariance=[]), "covariance.matrix"),
        (_own(covariance={"parameters": ["x0", "c"]}), "covariance.parameters"),
        (_own(covariance={"matrix": (-np.eye(10)).tolist()}), "negative variance"),
        (_own(covariance={"matrix": np.tri(10).tolist()}), "not symmetric"),
        (_own(covariance={"matrix": (2 - np.eye(10)).tolist()}), "above 1"),
        (_own(interior={"c": 0.1, "a1": 2.0}), "interior.a1 is none of c"),
        (_own(sensor={"width": 100.5, "height": 100, "pixel_pitch": 0.001}), "100.5 × 100"),
        ("image_width: 10\ndistortion_model: []\n", "distortion_model"),
        ("{'lensmodel': [], 'imagersize': 1}", "lensmodel"),
        ("{[]: 'lensmodel imagersize'}", "Python's notation"),
        ("%YAML:1.0\n---\ncamera_matrix: !!int ''\n", "holds what is no YAML"),
        ("""%YAML:1.0\n---\ncamera_matrix: [944, 0, 0, 0, 944, 0, 635, 359, 1]
distortion_coefficients: []\n""", "row by row"),
        ("1 PINHOLE 100 100 -90 90 50 50\n", "principal distance of -90"),
        ("1 RADIAL 4000 3000 3500 2000 1500 -3 0\n", "folds back"),
        ("1 PINHOLE 100 0 90 90 50 50\n", "100 × 0"),
        ("1 PINHOLE 1280 720 944 94.4 640 360\n", "fx is 10 times fy"),
        ("1 PINHOLE 1280 720 944 -944 640 360\n", "fx is -1 times fy"),
        ("""cam0: {camera_model: pinhole, intrinsics: [944,2, 635.5, 359.5],
         resolution: [1280, 720]}""", "fx is 472 times fy"),
        ("1 PINHOLE 1280 720 944 0 640 360\n", "principal distance of 0 px"),
        ("1 PINHOLE 1280 720 944 944 360 640\n", "cx and cy, or width and height, exchanged"),
        ("1 PINHOLE 1280 720 944 944 6400 360\n", r"\(6400, 360\) px lies outside"),
        ("""<calibration><width>1280</width><height>720</height><f>944</f><cx>635</cx>
         </calibration>""", r"\(1274, 360\) px lies outside"),
        ("""%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720
camera_matrix: [944., 0., 635.5, 0., 944., 359.5, 0., 0., 1.]
distortion_coefficients: {rows: 1, cols: 4, data: [-0,5, 0.1, 0.001, 0.0005]}
""", "has 5 numbers, not 1 × 4: is a comma wrong"),
    ],
)  # fmt: skip
def test_wrong_files_are_one_error_that_names_the_file(tmp_path, text, reason):
    path = tmp_path / "camera.file"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=rf"camera\.file.*{reason}"):
        camera_files.read(path, pixel_pitch=0.001)


def test_absent_binary_and_unknown(tmp_path):
    (tmp_path / "x.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    for name, reason in (("nowhere.xml", r"nowhere\.xml"), ("x.jpg", "not a text file")):
        with pytest.raises(ConfigurationError, match=reason):
            camera_files.read(tmp_path / name)
    for name, to, more, reason in (
        ("x", "vision9000", (), "give one of opencv"),
        ("x.jpg/folder.yaml", "opencv", (), "cannot be written"),
        ("x", "json", (np.eye(3),), "shape"),
    ):
        with pytest.raises(UsageError, match=reason):
            camera_files.write(_camera(), tmp_path / name, to, *more)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.jpg"]


@pytest.mark.parametrize("name", camera_files.FORMATS)
def test_damaged_files_are_an_error_or_a_camera_never_a_traceback(tmp_path, name):
    """Seeded damages per format: characters lost, doubled, replaced, the end cut off."""
    path = tmp_path / "camera"
    camera_files.write(CameraModel(SENSOR, replace(PLAIN, A3=0.0)), path, name)
    text = path.read_text(encoding="utf-8")
    rng = np.random.default_rng(11)
    errors = 0
    for _ in range(40):
        damaged = list(text)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(len(damaged)))
            damaged[at] = rng.choice(["", "x", "-", "9", "\n", ":", "{", "nan", damaged[at] * 2])
        if rng.random() < 0.2:
            damaged = damaged[: int(rng.integers(len(damaged)))]
        path.write_text("".join(damaged), encoding="utf-8")
        try:
            camera = camera_files.read(path, pixel_pitch=0.00112)
        except ConfigurationError as error:
            assert str(path) in str(error)  # noqa: PT017
            errors += 1
        else:
            assert np.all(np.isfinite(camera.model.interior.as_array()))
    assert errors > 0
