"""Markers of OpenCV's dictionaries: sub-pixel corners with true standard deviations."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from tests.commands import invoke
from tests.photogrammetry.exact_rendering import Scene, look_at, noisy, rms
from tests.photogrammetry.fields import PI_CAMERA, SMALL_CAMERA, draw_marker
from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.frame.measurement import measure
from thermocald.photogrammetry.targets.corner import measure_corners
from thermocald.photogrammetry.targets.markers import locate_markers


def measure_markers(image, field):
    """Measure without the rest of a frame's measurement; return also the reasons of the missed."""
    missed: dict[int, str] = {}
    return measure_corners(image, locate_markers(image, field, missed), missed), missed


APRILTAG, ARUCO = "DICT_APRILTAG_36h11", "DICT_5X5_50"


def _board(size=60.0):
    """Return field and scene of 4 × 3 markers in Z = 0, from alternating dictionaries."""
    scene, names, points = Scene(), [(APRILTAG, ARUCO)[k % 2] for k in range(12)], []
    for k, name in enumerate(names):
        # For a viewer along -Z, x is right and y up; OpenCV's order is clockwise from top left
        x, y = 130.0 * (k % 4), 130.0 * (k // 4)
        square = [[x, y + size], [x + size, y + size], [x + size, y], [x, y]]
        points.append(np.column_stack([square, np.zeros(4)]))
        draw_marker(scene, name, k, points[-1])
    codes = [f"{name}:{number}:{k}" for number, name in enumerate(names) for k in range(4)]
    points = np.concatenate(points)
    return TestField.build(codes, points, 0.01, np.nan, "marker_corner", codes), scene


FIELD, SCENE = _board()
VIEWS = {
    "frontal": look_at([225, 160, 620], [225, 160, 0]),
    "oblique": look_at([-250, 20, 520], [225, 160, 0], 0.4),
    "far and turned": look_at([400, 300, 1300], [225, 160, 0], 2.5),
}


def _truth(view: str, camera=SMALL_CAMERA) -> np.ndarray:
    return camera.project(VIEWS[view], FIELD.points)


@cache
def _rendered(view: str, camera=SMALL_CAMERA) -> np.ndarray:
    return SCENE.render(camera, VIEWS[view])


def _frontal(seed: int) -> np.ndarray:
    return noisy(_rendered("frontal"), np.random.default_rng(seed))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("view", "camera"),
    [
        *((view, SMALL_CAMERA) for view in VIEWS),
        pytest.param("frontal", PI_CAMERA, id="found at half size, measured at full size"),
    ],
)
def test_corners_scatter_as_stated(view, camera):
    image, truth = _rendered(view, camera), _truth(view, camera)
    rng = np.random.default_rng(1)
    error, z = [], []
    for _ in range(12):
        observed, missed = measure_markers(noisy(image, rng), FIELD)
        assert missed == {}
        assert len(observed) == 48
        e = observed.points - truth[observed.targets]
        error.append(e)
        z.append(e / observed.sigmas)
    assert 0.9 <= np.sqrt(np.mean(np.square(z))) <= 1.1
    # Corner operators reach a twentieth of a pixel
    assert np.sqrt(np.mean(np.square(error))) < 0.03


def test_markers_of_two_dictionaries_are_in_the_fields_order():
    observed, _ = measure_markers(_frontal(2), FIELD)
    assert list(observed.targets) == list(range(48))
    assert set(observed.quality) == {"blur", "contrast", "grey", "noise", "saturation"}
    assert np.median(observed.quality["blur"]) == pytest.approx(0.8, abs=0.05)
    # markers outside the field are ignored
    part = FIELD.subset(np.arange(8))
    assert list(measure_markers(_frontal(3), part)[0].targets) == list(range(8))


def test_a_marker_seen_twice_and_corners_at_the_edge_are_missed_with_a_reason():
    image, corners = _frontal(4), _truth("frontal")
    u, v = np.rint(corners[:4].mean(axis=0)).astype(int)
    image[20:160, 1480:1620] = image[v - 70 : v + 70, u - 70 : u + 70].copy()
    observed, missed = measure_markers(image, FIELD)
    assert not set(observed.targets) & {0, 1, 2, 3}
    assert missed[0]
    missed.clear()
    x = int(np.floor(corners[5, 0])) + 1
    found = locate_markers(image, FIELD, {})
    measure_corners(np.ascontiguousarray(image[:, :x]), found, missed)
    assert "edge" in missed[5]


RINGS = ("RING12:1", "RING13:65", "RING12:", "RING12:x", "RING14:65.0", "RING12:" + 5000 * "1")
MARKERS = (
    "DICT_NONE:1:0", "DICT_4X4_50:50:0", "DICT_4X4_50:1:4", "DICT_4X4_50", "DICT_4X4_50:a:0",
    "DICT_4X4_50:1:0:0", "DICT_4X4_50:-1:0", "DICT_4X4_50:1:" + 5000 * "1",
)  # fmt: skip


@pytest.mark.parametrize(
    ("code", "reason"),
    [*((c, "ring code") for c in RINGS), *((c, "DICT_") for c in MARKERS)],
    ids=lambda text: text[:20],
)
def test_other_texts_than_codes_are_refused(code, reason):
    kind = "circle" if "ring" in reason else "marker_corner"
    field = TestField.build(list("abcd"), np.eye(4, 3), 0.1, 10.0, kind, [code, "", "", ""])
    with pytest.raises(TestFieldError, match=reason):
        measure(_frontal(7), field)


def test_a_duplicated_code_is_refused(tmp_path):
    """`testfield check` accepted it."""
    codes = ["RING12:65", "", "RING12:65", "", ""]
    with pytest.raises(TestFieldError, match="is duplicated in the test field, at targets 'a' and"):
        TestField.build(list("abcde"), np.eye(5, 3), 0.1, 10.0, "circle", codes)
    path = tmp_path / "field.csv"
    rows = [f"{'abcde'[k]},{k},{k * k},0,9,1,1,1,{code}" for k, code in enumerate(codes)]
    path.write_text("\n".join(["target,X,Y,Z,diameter,sX,sY,sZ,code", *rows]))
    with pytest.raises(TestFieldError, match=r"line 4.*code.*'a' has it"):
        invoke("testfield", "check", path)


def test_photographs_of_apriltags(shared):
    """Four to twelve corners per photograph; the numbers are those on the walls."""
    field = TestField.build(
        [f"{n}.{k}" for n in range(1, 17) for k in range(4)],
        np.zeros((64, 3)),
        kinds="marker_corner",
        codes=[f"{APRILTAG}:{n}:{k}" for n in range(1, 17) for k in range(4)],
    )
    expected = {
        "Amp_42in": {5}, "BackAmpZone_117in": {2, 3, 4}, "GeneralField1": {9, 10},
        "GeneralField3": {7, 8}, "SpeakerCenter_143in": {3, 4}, "SpeakerCenter_19in": {3, 4},
        "StageLeft_51in": {15},
    }  # fmt: skip
    if int(cv2.__version__.split(".")[0]) < 5:
        expected["GeneralField3"] = {7}  # OpenCV 4 does not find the small number 8
    for name, numbers in expected.items():
        path = shared / "data" / "frc" / f"{name}.jpg"
        observed, _ = measure_markers(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), field)
        assert {int(field.names[t].split(".")[0]) for t in observed.targets} == numbers
        assert len(observed) == 4 * len(numbers)
        assert observed.sigmas.max() < 0.2


def jpeg(frame, quality: int):
    """Return a frame as a JPEG of this quality shows it."""
    coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("quality", [95, 85, 75, 50])
def test_corners_of_a_jpeg_have_true_sds(quality):
    """The errors of neighbouring pixels are correlated: error/sd was 1.3 to 1.9."""
    z = []
    for seed in range(3):
        frame = noisy(_rendered("frontal"), np.random.default_rng(seed), 1.0)
        observed, _ = measure_markers(jpeg(frame, quality), FIELD)
        z.append((observed.points - _truth("frontal")[observed.targets]) / observed.sigmas)
    assert 0.85 < np.sqrt(np.mean(np.square(np.concatenate(z)))) < (1.2 if quality > 50 else 1.5)


@pytest.mark.parametrize("gamma", [0.45, 0.8])
def test_the_tone_curve_of_a_photograph_does_not_move_corners(gamma):
    """Its blurred edges are nearer to the dark side: error/sd was 8.4 and 3.9."""
    frame = noisy(255 * (_rendered("frontal") / 255) ** gamma, np.random.default_rng(8))
    observed, _ = measure_markers(frame, FIELD)
    z = (observed.points - _truth("frontal")[observed.targets]) / observed.sigmas
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.3


def demosaiced(frame):
    """Return a frame as a colour sensor sees it, in grey."""
    colour = cv2.demosaicing(frame, cv2.COLOR_BayerRG2BGR_EA)
    return cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)


def denoised(frame):
    return cv2.bilateralFilter(frame, 5, 20, 1.5)


@pytest.mark.parametrize("change", [demosaiced, denoised])
def test_edges_of_another_profile_are_not_taken_for_a_tone_curve(change):
    """Corners were moved by 0.13 and 0.23 px: error/sd was 5.5 and 6.4."""
    frame = change(noisy(_rendered("frontal"), np.random.default_rng(3)))
    observed, _ = measure_markers(frame, FIELD)
    errors = observed.points - _truth("frontal")[observed.targets]
    assert rms(errors) < 0.07
    assert rms(errors / observed.sigmas) < 1.6


@pytest.mark.parametrize("blur", [1.6, 2.0])
def test_the_bits_of_small_blurred_markers_are_in_the_sds(blur):
    """They reach the edges and move corners by up to 0.3 px: error/sd was 1.7 and 2.3."""
    far = look_at([300, 200, 2300], [225, 160, 0], 0.3)
    frame = noisy(SCENE.render(SMALL_CAMERA, far, blur=blur), np.random.default_rng(1))
    observed, _ = measure_markers(frame, FIELD)
    errors = observed.points - SMALL_CAMERA.project(far, FIELD.points)[observed.targets]
    assert len(observed) >= 20
    assert 0.8 < np.sqrt(np.mean(np.square(errors / observed.sigmas))) < 1.4


def test_a_sharpened_image_does_not_widen_sds():
    """Its halos along all edges are no noise: with them error/sd would be 0.5."""
    clean = _rendered("frontal")
    frame = noisy(
        1.5 * clean - 0.5 * cv2.GaussianBlur(clean, (0, 0), 1.5), np.random.default_rng(1)
    )
    plain = measure_markers(noisy(clean, np.random.default_rng(1)), FIELD)[0].sigmas
    assert np.median(measure_markers(frame, FIELD)[0].sigmas) < 1.5 * np.median(plain)


@pytest.mark.parametrize(
    ("gain", "full", "good"), [(1.32, 255, 48), (1.36, 255, 0), (2.0, 255, 0), (1.25, 235, 0)]
)
def test_overexposed_corners_are_not_measured(gain, full, good):
    """Regression: cut at full scale or lower, edges were 0.03 to 1 px off: error/sd 4 to 95."""
    light = gain * _rendered("frontal") + np.random.default_rng(8).normal(0, 2, (1232, 1640))
    found = measure(np.clip(np.rint(light), 0, full).astype(np.uint8), FIELD)
    assert len(found.observations) == good
    assert found.status.ok or "saturated (48); expose less" in found.status.reason
