"""Rendered frames, equal on every machine, and the mock camera that renders them."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from scipy.special import ndtr

from thermocald.hal import VirtualClock, load_driver
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets.corner import measure_corners
from thermocald.photogrammetry.targets.markers import locate_markers
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import write_model
from thermocald.physics.scene import Look, Scene, surface_normals
from thermocald.physics.testfields import (
    corner_field,
    corner_view,
    demonstration_field,
    demonstration_model,
)

SENSOR = Sensor(3280, 2464, 0.00112)
CLEAN = Look(noise_dn=0.0, vignetting=0.0)


def outline_centroid(field, normals, row, sensor, iop, eop):
    """Return centroid and area of the projected circle (Green's theorem), by the camera model."""
    normal = normals[row]
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    a = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    circle = field.points[row] + field.diameters[row] / 2 * (np.cos(a) * u + np.sin(a) * v)
    x, y = project(sensor, iop, eop, circle).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    centroid = [((p + np.roll(p, -1)) * cross).sum() / 6 / area for p in (x, y)]
    return np.array(centroid), abs(area)


def test_centres_agree_with_the_projected_truth():
    """Without noise, intensity-weighted centroids agree with the projected outline."""
    field = demonstration_field("plain")
    model = demonstration_model(field)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    image = Scene(SENSOR, field, CLEAN).render(iop, eop)
    error, areas, normals = [], [], surface_normals(field)
    grid = np.arange(-38, 39)
    for row, place in enumerate(project(SENSOR, iop, eop, field.points)):
        if not SENSOR.contains(place, 45):
            continue
        i, j = np.rint(place).astype(int)
        ink = 200.0 - image[j - 38 : j + 39, i - 38 : i + 39].astype(float)
        measured = [i, j] + np.array([ink.sum(0) @ grid, ink.sum(1) @ grid]) / ink.sum()
        centroid, area = outline_centroid(field, normals, row, SENSOR, iop, eop)
        error.append(measured - centroid)
        areas.append(ink.sum() / 170.0 / area - 1.0)
    assert len(error) >= 140
    assert np.sqrt(np.mean(np.square(error))) < 0.002
    assert np.abs(areas).max() < 2e-3


@pytest.mark.slow
def test_corners_have_true_sds_at_any_position_in_a_pixel():
    """With blur on the pixel grid, errors would be 1.16 sds and depend on the position.

    6 frames of 190 corners give the ratio to 2 %.
    """
    field = demonstration_field("markers")
    eop = corner_view(field, 1330.0).as_array()
    scene, normed = Scene(SENSOR, field), []
    for k in range(6):
        x0, y0 = np.array([k / 6, k / 5]) * SENSOR.pixel_pitch
        iop = InteriorOrientation(c=3.04, x0=x0, y0=y0).as_array()
        image = scene.render(iop, eop, seed=k)
        seen = measure_corners(image, locate_markers(image, field, {}), {})
        error = seen.points - project(SENSOR, iop, eop, field.points)[seen.targets]
        normed.append(error / seen.sigmas)
    ratio = np.sqrt(np.mean(np.concatenate(normed) ** 2, axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.06)


def test_blur_noise_vignetting():
    field = TestField.build(["a"], [[0.0, 0.0, 0.0]], diameters=60.0)
    sensor = Sensor(641, 481, 0.005)
    iop = InteriorOrientation(c=8.0).as_array()
    eop = ExteriorOrientation(0, 0, 0, 120.0, 90.0, 1000.0).as_array()

    def rendered(noise, vignetting, **seed):
        look = Look(noise_dn=noise, vignetting=vignetting, blur_px=1.2)
        return Scene(sensor, field, look).render(iop, eop, **seed).astype(float)

    clean, plain = rendered(0, 0.3), rendered(0, 0)
    noise = (rendered(2.5, 0.3, seed=5) - clean)[100:]
    assert abs(noise.std() - np.hypot(2.5, 0.35)) < 0.1  # with two roundings
    assert abs(noise.mean()) < 0.04  # 1/64 DN keeps the clean frame off half-way values
    x, y = np.arange(641), np.arange(481)
    r2 = ((x - 320.0) ** 2)[None] + ((y - 240.0) ** 2)[:, None]
    expected = 200 * (1 - 0.3 * r2 / (320.0**2 + 240.0**2))
    assert np.abs(clean[:250] - expected[:250]).max() < 1.0
    # the edge of the disc is a normal distribution function
    cx, cy = project(sensor, iop, eop, field.points)[0]
    profile = ndtr((30.0 * 8 / 1000 / 0.005 - np.abs(x - cx)) / np.hypot(1.2, 12**-0.5))
    assert np.abs((200 - plain[round(cy)]) / 170 - profile).max() < 0.02


def test_out_of_sight():
    """Targets behind the camera, outside the image, or seen from the back are not drawn."""
    scene = Scene(SENSOR, corner_field("markers", 2, 200.0), CLEAN)
    iop = InteriorOrientation(c=3.04).as_array()
    for eop in ((0, 0, 0, 5e4, 0, 1000), (np.pi, 0, 0, 100, 100, 1000),
                (0, np.pi, 0, -500, -500, -900)):  # fmt: skip
        assert np.all(scene.render(iop, np.array(eop, float)) == 200)
    inside = scene.render(iop, np.array([0, 0, 0, 100.0, 100.0, 30.0]))
    assert inside.shape == (2464, 3280)


def test_same_frame_from_the_same_seed():
    """The hash is from x86-64 (AVX2) and must be the same on any machine."""
    field = corner_field("circles", 4, 150.0)
    model = demonstration_model(field)
    scene = Scene(Sensor(820, 616, 0.00448), field)
    orientation = model.interior.as_array(), model.exterior.as_array()
    frames = [scene.render(*orientation, seed=s) for s in (1, 1, 2)]
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    assert hashlib.sha256(frames[0].tobytes()).hexdigest()[:16] == "5a054c4995a37c3f"


MockCamera = load_driver("camera", "mock")


def test_frames_of_the_mock_camera_show_the_known_drift():
    with MockCamera(clock=VirtualClock()) as camera:
        first = camera.capture()
        camera.clock.sleep_until(camera.clock.monotonic() + 650.0)
        hot = camera.capture()
        a, b = (camera.truth(frame.monotonic) for frame in (first, hot))
    assert hot.image.shape == (2464, 3280)
    assert hot.utc - first.utc == pytest.approx(hot.monotonic - first.monotonic)
    moved = (b.iop[0] - a.iop[0]) / camera.model.sensor.pixel_pitch
    assert -12.0 < moved[1] < -9.0
    seen = measure_corners(hot.image, locate_markers(hot.image, camera.field, {}), {})
    assert len(seen) >= 100
    expected = project(camera.model.sensor, b.iop[0], b.eop[0], camera.field.points)
    assert np.sqrt(np.mean((seen.points - expected[seen.targets]) ** 2)) < 0.04


def test_the_mock_cameras_own_model_and_field(tmp_path):
    slip = ModelEffect("slip", {"time": 100.0, "x0": 0.00112})
    model = demonstration_model(demonstration_field("plain")).with_effect(slip)
    write_model(tmp_path / "m.yaml", model)
    clock = VirtualClock()
    with MockCamera(clock=clock, model=str(tmp_path / "m.yaml"),
                    programme=[[0, 25.0]], testfield="plain") as device:  # fmt: skip
        before, after = (device.truth(clock.monotonic() + s) for s in (99, 101))
    assert after.iop[0, 1] - before.iop[0, 1] == pytest.approx(0.00112)
