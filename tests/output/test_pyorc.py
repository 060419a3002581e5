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


@pytest.fixture(scope="module")
def pyorc():
    """The real package, whose import leaves a thread behind."""
    return pytest.importorskip("pyorc", reason="pip install pyopenrivercam")


def configuration(path: Path, n: int = 8, points=None) -> tuple[Path, np.ndarray]:
    """A site in a national grid, clicked when the camera was cold; also its true points in mm."""
    rng = np.random.default_rng(1)
    if points is None:
        y = rng.uniform(8_000, 28_000, n)
        points = np.column_stack(
            [np.where(np.arange(n) % 2, 0.3, -0.3) * y, y, rng.uniform(-200, 2_500, n)]
        )
    warm = {"c": 0.4e-3, "x0": 0.35e-3, "y0": -0.2e-3}
    interior = {k: CAMERA[k] + warm[k] * (WARM - 20.0) for k in warm}
    src = project(points, POSE, **interior)
    document = {
        "width": SIZE[0], "height": SIZE[1], **SITE, "lens_position": None,
        "gcps": {"src": src.tolist(), "dst": (points / 1000 + ORIGIN_M).tolist(), "h_ref": 1.2,
                 "z_0": 138.0},
        "camera_matrix": [[2700.0, 0, 1640.0], [0, 2700.0, 1232.0], [0, 0, 1.0]],
        "dist_coeffs": [[0.0], [0.0], [0.0], [0.0]],
    }  # fmt: skip
    path.write_text(json.dumps(document))
    return path, points


def test_the_camera_is_the_warm_one_and_all_else_stays(tmp_path):
    write_model(tmp_path / "model.yaml")
    old, points = configuration(tmp_path / "site.json")
    done = finish(
        "camera", "at", tmp_path / "model.yaml", "--temperature", WARM, "--to", "pyorc", "--renew",
        old, "-o", tmp_path / "warm.json",
    )  # fmt: skip
    assert "pose from 8 control points" in done.stdout
    assert "20 mm" in done.stderr
    src = np.array(json.loads(old.read_text())["gcps"]["src"])
    document = json.loads((tmp_path / "warm.json").read_text())
    assert {k: document[k] for k in SITE} == SITE
    K = np.array(document["camera_matrix"])
    assert K[0, 0] == pytest.approx((CAMERA["c"] + 0.4e-3 * 16) / PITCH)
    true = POSE[3:] / 1000 + ORIGIN_M
    assert document["lens_position"] == pytest.approx(true.tolist(), abs=2e-3)
    at = points / 1000 + ORIGIN_M
    seen, _ = cv2.projectPoints(
        at, np.array(document["rvec"]), np.array(document["tvec"]), K,
        np.array(document["dist_coeffs"]),
    )  # fmt: skip
    # the iteration ends with a step that is small against 20 mm
    assert seen[:, 0] == pytest.approx(src, abs=0.05)


def test_names_that_a_symmetry_leaves_untested_are_doubted(tmp_path):
    write_model(tmp_path / "model.yaml")
    corners = [[-3e3, 1e4, 0.0], [3e3, 1e4, 9e2], [3e3, 2e4, 0.0], [-3e3, 2e4, 9e2]]
    old, _ = configuration(tmp_path / "site.json", points=np.array(corners))
    done = finish(
        "camera", "at", tmp_path / "model.yaml", "--temperature", WARM, "--to", "pyorc", "--renew",
        old, "-o", tmp_path / "warm.json",
    )  # fmt: skip
    assert "doubtful: the control points fit as well with gcp2, gcp3" in done.stdout


def assert_projects(read, path: Path, points: np.ndarray, ours: np.ndarray) -> None:
    """The file's pose to 1e-6 px; as pyorc solves for it again, to its matrix's 32 bits."""
    assert read.project_points(points.tolist()) == pytest.approx(ours, abs=3e-4)
    document = json.loads(path.read_text())
    read.rvec, read.tvec = document["rvec"], document["tvec"]
    assert read.project_points(points.tolist()) == pytest.approx(ours, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--to", "pyorc", "-o", "x.json"], "needs --renew"),
     (["--to", "ros", "--renew", "site.json", "-o", "x.yaml"], "needs --renew"),
     (["--to", "pyorc", "--renew", "model.yaml", "-o", "x.json"], "cannot be read as JSON"),
     (["--to", "pyorc", "--renew", "site.json", "--frame", "a.png", "-o", "x.json"], "give both")],
)  # fmt: skip
def test_what_is_missing_is_said(tmp_path, monkeypatch, options, words):
    write_model(tmp_path / "model.yaml")
    configuration(tmp_path / "site.json")
    monkeypatch.chdir(tmp_path)
    done = call("camera", "at", "model.yaml", "--temperature", "20", *options)
    assert done.returncode in (1, 2)
    assert words in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("gcps", "words"),
    [({"src": [[1, 2]] * 5}, "gcps.src has 5 points and gcps.dst 8"),
     ({"dst": [[5.9 + 1e-4 * k, 50.8, 138] for k in range(8)]}, "do X and Y hold degrees"),
     (None, "'dst' is missing")],
)  # fmt: skip
def test_control_points_that_pyorc_would_not_take_are_said(tmp_path, gcps, words):
    path, _ = configuration(tmp_path / "site.json")
    document = json.loads(path.read_text())
    document["gcps"] = {} if gcps is None else document["gcps"] | gcps
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=words) as refused:
        ControlPoints.read(path, "m")
    assert str(refused.value).count(str(path)) == 1


def test_properties_that_are_no_object_are_an_error(tmp_path):
    point = {"type": "Point", "coordinates": [313000.0, 192000.0, 138.0]}
    document = {"type": "FeatureCollection", "features": [{"geometry": point, "properties": [1]}]}
    path = tmp_path / "gcp.geojson"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match="is not valid JSON of control points"):
        ControlPoints.read(path, "m")


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


def pyorc_residuals() -> np.ndarray:
    """Clicks minus projection of the pose that pyorc solves, (6, 2) px: OpenCV's solvePnP."""
    document = json.loads((RIVER / "geul-pyorc.json").read_text())
    dst, src = (np.array(document["gcps"][key], dtype=float) for key in ("dst", "src"))
    K, k = (np.array(document[key]) for key in ("camera_matrix", "dist_coeffs"))
    dst -= dst.mean(axis=0)
    _, rvec, tvec = cv2.solvePnP(dst, src, K, k)
    seen, _ = cv2.projectPoints(dst, rvec, tvec, K, k)
    return src - seen[:, 0]


@pytest.mark.skipif(not RIVER.is_dir(), reason="the river's frames are not here: ../shared/data")
def test_the_crosses_of_the_geul():
    """A pose with sds from six points, which are found in other frames to a tenth of a pixel.

    pyorc's own camera was fitted to the clicks; with a prior of 2 % on its focal length ours fits
    as well, and in the other frames the same points give the same pose.
    """
    camera = river_camera()
    path = RIVER / "geul-pyorc.json"
    first = renew_configuration(path, camera)
    assert first.pose.status == "ok"
    assert first.pose.sigma0 < 3  # 20 mm and 1 px are assumed
    theirs = pyorc_residuals()
    # pyorc's residuals are minimal in the image, ours are weighted with the survey's
    assert np.square(first.pose.residuals).sum() < 1.1 * np.square(theirs).sum()
    found = [
        renew_configuration(path, camera, RIVER / "geul-0.jpg", RIVER / f"geul-{k}.jpg")
        for k in (0, 4, 9)
    ]
    still = found[0].control.seen
    better = still.sigmas.max(axis=1) < 0.3
    assert better.sum() >= 3
    for other in found[1:]:
        assert len(other.control.seen) == 6
        assert np.abs(other.control.seen.points - still.points).max() < 0.2
        moved = other.pose.values[10:] - found[0].pose.values[10:]
        assert (np.abs(moved) < 0.3 * found[0].pose.sd[10:]).all()
    clicks = ControlPoints.read(path, "m").seen
    assert np.abs(still.points - clicks.points).max() < 3


@pytest.mark.skipif(not RIVER.is_dir(), reason="the river's frames are not here: ../shared/data")
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


@pytest.mark.skipif(not RIVER.is_dir(), reason="the river's frames are not here: ../shared/data")
def test_the_real_pyorc_reads_the_geul_renewed(tmp_path, pyorc):
    camera = river_camera()
    done = renew_configuration(
        RIVER / "geul-pyorc.json", camera, RIVER / "geul-0.jpg", RIVER / "geul-9.jpg"
    )
    done.write(tmp_path / "new.json")
    read = pyorc.load_camera_config(str(tmp_path / "new.json"))
    at = done.control.field.points
    ours = done.camera.project(at, done.pose.exterior.as_array())
    assert_projects(read, tmp_path / "new.json", (at + done.control.origin) / 1000, ours)
