"""Updated camera configurations of pyorc, read by the real package; a real river."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.test_measure import ORIGIN_M, POSE, write_model
from tests.commands import call, finish
from tests.main_paths.crooked import CAMERA, PITCH, SIZE, project
from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.errors import DataError
from thermocald.output.series_export import renew_configuration
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.photogrammetry.epoch.measuring import Line, place_on
from thermocald.photogrammetry.field.testfield import TestField

RIVER = Path(__file__).resolve().parents[3] / "shared" / "data" / "river"
WARM = 36.0
SITE = {"crs": "EPSG:28992", "resolution": 0.03, "window_size": 15, "is_nadir": False}


@pytest.fixture
def renew(tmp_path):
    """Points of a site in mm → what `camera at --renew` prints, the old document and the new one.

    The site is in a national grid, and was clicked when the camera was as warm as now.
    """
    write_model(tmp_path / "model.yaml")

    def renewed(points):
        warm = {"c": 0.4e-3, "x0": 0.35e-3, "y0": -0.2e-3}
        interior = {k: CAMERA[k] + warm[k] * (WARM - 20.0) for k in warm}
        old = {
            "width": SIZE[0], "height": SIZE[1], **SITE, "lens_position": None,
            "gcps": {"src": project(points, POSE, **interior).tolist(),
                     "dst": (points / 1000 + ORIGIN_M).tolist(), "h_ref": 1.2, "z_0": 138.0},
            "camera_matrix": [[2700.0, 0, 1640.0], [0, 2700.0, 1232.0], [0, 0, 1.0]],
            "dist_coeffs": [[0.0], [0.0], [0.0], [0.0]],
        }  # fmt: skip
        (tmp_path / "site.json").write_text(json.dumps(old))
        done = finish(
            "camera", "at", "model.yaml", "--temperature", WARM, "--to", "pyorc", "--renew",
            "site.json", "-o", "warm.json", folder=tmp_path,
        )  # fmt: skip
        return done, old, json.loads((tmp_path / "warm.json").read_text())

    return renewed


def eight_points():
    rng = np.random.default_rng(1)
    y = rng.uniform(8_000, 28_000, 8)
    x = np.where(np.arange(8) % 2, 0.3, -0.3) * y
    return np.column_stack([x, y, rng.uniform(-200, 2_500, 8)])


def test_the_camera_is_the_warm_one_and_all_else_stays(renew):
    points = eight_points()
    done, old, new = renew(points)
    assert "pose from 8 control points" in done.stdout
    assert "20 mm" in done.stderr
    assert {k: new[k] for k in SITE} == SITE
    K = np.array(new["camera_matrix"])
    assert K[0, 0] == pytest.approx((CAMERA["c"] + 0.4e-3 * 16) / PITCH)
    true = POSE[3:] / 1000 + ORIGIN_M
    assert new["lens_position"] == pytest.approx(true.tolist(), abs=2e-3)
    pose = (np.array(new[key]) for key in ("rvec", "tvec"))
    seen, _ = cv2.projectPoints(points / 1000 + ORIGIN_M, *pose, K, np.array(new["dist_coeffs"]))
    # the iteration ends with a step that is small against 20 mm
    assert seen[:, 0] == pytest.approx(np.array(old["gcps"]["src"]), abs=0.05)


def test_names_that_a_symmetry_leaves_untested_are_doubted(renew):
    corners = [[-3e3, 1e4, 0.0], [3e3, 1e4, 9e2], [3e3, 2e4, 0.0], [-3e3, 2e4, 9e2]]
    done, *_ = renew(np.array(corners))
    assert "doubtful: the control points fit as well with gcp2, gcp3" in done.stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--to", "pyorc", "-o", "x.json"], "needs --renew"),
     (["--to", "ros", "--renew", "site.json", "-o", "x.yaml"], "needs --renew"),
     (["--to", "pyorc", "--renew", "model.yaml", "-o", "x.json"], "cannot be read as JSON"),
     (["--to", "pyorc", "--renew", "site.json", "--frame", "a.png", "-o", "x.json"], "give both")],
)  # fmt: skip
def test_what_is_missing_is_said(tmp_path, renew, options, words):
    renew(eight_points())
    done = call("camera", "at", "model.yaml", "--temperature", "20", *options, folder=tmp_path)
    assert done.returncode in (1, 2)
    assert words in " ".join(done.stderr.split())


POINTS = [[5.9 + 1e-4 * k, 50.8, 138] for k in range(8)]
FEATURE = {"geometry": {"type": "Point", "coordinates": [313e3, 192e3, 138.0]}, "properties": [1]}


@pytest.mark.parametrize(
    ("document", "words"),
    [({}, "as JSON"),
     ({"gcps": {"src": [[1, 2]] * 5, "dst": POINTS}}, "gcps.src has 5 points and gcps.dst 8"),
     ({"gcps": {"src": [[1, 2]] * 8, "dst": POINTS}}, "do X and Y hold degrees"),
     ({"gcps": {"src": [[1, 2]]}}, "'dst' is missing"),
     ({"type": "FeatureCollection", "features": [FEATURE]}, "is not valid JSON of control points")],
)  # fmt: skip
def test_control_points_that_pyorc_would_not_take_are_said(tmp_path, document, words):
    path = tmp_path / "site.json"
    path.write_text("\ufeff" + json.dumps(document) if words != "as JSON" else "[" * 100_000)
    with pytest.raises(DataError, match=words) as refused:
        ControlPoints.read(path, "m")
    assert str(refused.value).count(str(path)) == 1


def test_a_receivers_names_and_the_sds_of_its_image_points_are_read(tmp_path):
    """Of GeoJSON, sx in px was once taken for the sd of X in metres."""
    given = {"Name": "a", "Lateral RMS": 0.01, "elevation_rms": 0.02, "x": 5, "y": 6, "sx": 0.2}
    feature = {"geometry": {"type": "Point", "coordinates": [192e3, 313e3, 138]}}
    document = {"type": "FeatureCollection", "features": [{**feature, "properties": given}]}
    (tmp_path / "a.geojson").write_text(json.dumps(document))
    head = "Name,Easting,Northing,Elevation,Easting RMS,Northing RMS,Elevation RMS,x,y,sx,sy"
    (tmp_path / "a.csv").write_text(f"{head}\na,192000,313000,138,0.01,0.01,0.02,5,6,0.2,1\n")
    for name in ("a.geojson", "a.csv"):
        points = ControlPoints.read(tmp_path / name, "m")
        assert points.field.sigmas.tolist() == [[10.0, 10.0, 20.0]]
        assert points.seen.sigmas.tolist() == [[0.2, 1.0]]


def river_camera() -> Camera:
    """The Geul's camera as solved by pyorc, with an sd of a hundredth of its focal length."""
    document = json.loads((RIVER / "geul-pyorc.json").read_text())
    f, (k1, k2) = document["camera_matrix"][0][0], np.ravel(document["dist_coeffs"])[:2]
    pitch = 0.003
    c = f * pitch
    interior = InteriorOrientation(c, 0.5 * pitch, -0.5 * pitch, k1 / c**2, k2 / c**4)
    Q = np.zeros((10, 10))
    Q[[0, 1, 2, 3], [0, 1, 2, 3]] = np.square([0.02 * c, 10 * pitch, 10 * pitch, 0.02 / c**2])
    return Camera(Sensor(1920, 1080, pitch), np.nan, interior.as_array(), Q)


needs_river = pytest.mark.skipif(not RIVER.is_dir(), reason="no frames in ../shared/data/river")


@needs_river
def test_the_crosses_of_the_geul():
    """A pose with sds from six points, which are found in other frames to a tenth of a pixel.

    pyorc's own camera was fitted to the clicks; with a prior of 2 % on its focal length ours fits
    as well, and in the other frames the same points give the same pose.
    """
    camera, path = river_camera(), RIVER / "geul-pyorc.json"
    first = renew_configuration(path, camera)
    assert first.pose.status == "ok"
    assert first.pose.sigma0 < 3  # 20 mm and 1 px are assumed
    # the pose that pyorc solves, by OpenCV, whose residuals are minimal in the image; ours are
    # weighted with the survey's
    document = json.loads(path.read_text())
    dst, src = (np.array(document["gcps"][key], dtype=float) for key in ("dst", "src"))
    K, k = (np.array(document[key]) for key in ("camera_matrix", "dist_coeffs"))
    dst -= dst.mean(axis=0)
    theirs, _ = cv2.projectPoints(dst, *cv2.solvePnP(dst, src, K, k)[1:], K, k)
    assert np.square(first.pose.residuals).sum() < 1.1 * np.square(src - theirs[:, 0]).sum()
    found = [
        renew_configuration(path, camera, RIVER / "geul-0.jpg", RIVER / f"geul-{k}.jpg")
        for k in (0, 4, 9)
    ]
    still = found[0].control.seen
    assert (still.sigmas.max(axis=1) < 0.3).sum() >= 3
    for other in found[1:]:
        assert len(other.control.seen) == 6
        assert np.abs(other.control.seen.points - still.points).max() < 0.2
        moved = other.pose.values[10:] - found[0].pose.values[10:]
        assert (np.abs(moved) < 0.3 * found[0].pose.sd[10:]).all()
    assert np.abs(still.points - ControlPoints.read(path, "m").seen.points).max() < 3


@needs_river
@pytest.mark.parametrize("frame", [None, RIVER / "geul-0.jpg"], ids=["clicked", "measured"])
def test_levels_at_the_geul_have_true_sds(frame):
    """A staff at each cross, read with the pose of the other five, against its surveyed height.

    The six fit with a sigma0 of 2; so much larger than 20 mm and 1 px are the sigmas then.
    """
    camera = river_camera()
    done = renew_configuration(RIVER / "geul-pyorc.json", camera, frame, frame)
    known, seen = done.control.field, done.control.seen
    factor = done.pose.sigma0
    known = TestField.build(list(known.names), known.points, 20.0 * factor)
    seen = replace(seen, sigmas=factor * seen.sigmas)
    errors, sds = [], []
    for row in range(6):
        pose = camera.resect(known, seen.select(seen.targets != row), 0.0)
        one, up = seen.select(seen.targets == row), np.array([0.0, 0.0, 1.0])
        staff = Line(known.points[row], up, 20.0 * factor)
        X, C = place_on(camera.sensor, pose.values, pose.covariance, one.points, one.sigmas, staff)
        errors.append(X[0, 2] - known.points[row, 2])
        sds.append(np.hypot(np.sqrt(C[2, 2]), 20.0 * factor))
    ratio = np.array(errors) / sds
    assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.5  # of six
    assert np.abs(ratio).max() < 2.5


@pytest.fixture(scope="module")
def pyorc():
    """The real package, whose import leaves a thread behind."""
    return pytest.importorskip("pyorc", reason="pip install pyopenrivercam")


@needs_river
def test_the_real_pyorc_reads_the_geul_renewed(tmp_path, pyorc):
    """The file's pose to 1e-6 px; as pyorc solves for it again, to its matrix's 32 bits."""
    done = renew_configuration(
        RIVER / "geul-pyorc.json", river_camera(), RIVER / "geul-0.jpg", RIVER / "geul-9.jpg"
    )
    done.write(tmp_path / "new.json")
    read = pyorc.load_camera_config(str(tmp_path / "new.json"))
    at = done.control.field.points
    points = ((at + done.control.origin) / 1000).tolist()
    ours = done.camera.project(at, done.pose.exterior.as_array())
    assert read.project_points(points) == pytest.approx(ours, abs=3e-4)
    document = json.loads((tmp_path / "new.json").read_text())
    read.rvec, read.tvec = document["rvec"], document["tvec"]
    assert read.project_points(points) == pytest.approx(ours, abs=1e-6)
