"""Frames of a hot camera, corrected to the steady one: pixels, EXIF, camera and pose."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.analysis.test_gauge import START, thermal_camera
from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.analysis.thermal.correction import FrameCorrector
from thermocald.epoch import Epoch
from thermocald.errors import ImageError
from thermocald.photogrammetry.camera.camera_model import CameraSpec, ExteriorOrientation, project
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.physics.scene import Look, Scene
from thermocald.physics.testfields import demonstration_field, demonstration_model

HOT = 40.0
FIELD = demonstration_field("markers")
POSE = demonstration_model(FIELD).exterior.as_array()
ORIGIN = (192e6, 313e6, 0.0)


@pytest.fixture(scope="module")
def thermal():
    """Return the gauge's camera for small frames, with a drift of 0.2 px/K."""
    small = thermal_camera().for_images(820, 616)
    rates = {name: 10 * rate for name, rate in small.model.rates.items()}
    return replace(small, model=replace(small.model, rates=rates))


def seen_at(thermal, T: float) -> np.ndarray:
    """Render a frame of the corner without noise."""
    scene = Scene(thermal.model.sensor, FIELD, Look(noise_dn=0.0))
    return scene.render(thermal.at(T).values, POSE)


def calibrated(thermal, T: float = HOT) -> CalibratedEpoch:
    """Return an epoch as calibrated by the gauge."""
    covariance = np.zeros((16, 16))
    covariance[:10, :10] = thermal.at(T).covariance
    covariance[range(10, 16), range(10, 16)] = 1e-6
    result = replace(
        failed("resected", "", None), interior=thermal.at(T).interior, covariance=covariance,
        exterior=ExteriorOrientation.from_array(POSE),
    )  # fmt: skip
    return CalibratedEpoch(Epoch(7, START + 0.25, START, {"housing": T}), result, {})


def corrected(thermal, encoded: bytes, done: CalibratedEpoch | None = None) -> bytes:
    corrector = FrameCorrector(thermal, "gauge", ORIGIN)
    return corrector.correct(encoded, done or calibrated(thermal))


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def test_targets_of_a_corrected_frame_agree_with_its_camera_and_pose(thermal):
    hot = seen_at(thermal, HOT)
    jpeg = corrected(thermal, png(hot))
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    steady = thermal.at(thermal.model.T0)
    known = CameraSpec("", steady.sensor, interior=steady.interior)
    found, as_it_was = (Tracker(FIELD, known).measure(frame).observations for frame in (image, hot))
    comment = json.loads(Image.open(io.BytesIO(jpeg)).info["comment"])
    pose = np.array([comment["pose"][n] for n in ("omega", "phi", "kappa", "X0", "Y0", "Z0")])
    at = project(steady.sensor, steady.values, pose, FIELD.points)
    left = found.points - at[found.targets]
    before = as_it_was.points - at[as_it_was.targets]
    assert len(found) > 100
    assert np.sqrt(np.mean(before**2)) > 2.0
    assert np.sqrt(np.mean(left**2)) < 0.05  # of markers of 20 px, through a JPEG
    K = steady.opencv()[0]
    for name, value in (("fx", K[0, 0]), ("fy", K[1, 1]), ("cx", K[0, 2]), ("cy", K[1, 2])):
        assert comment["opencv"][name] == pytest.approx(value)
    sd_fy = thermal.at(HOT).sd["c"] / steady.sensor.pixel_pitch
    assert comment["opencv"]["sd_fy"] == pytest.approx(sd_fy)
    assert (comment["corrected_to"], comment["temperature"], comment["epoch"]) == (20.0, HOT, 7)
    assert comment["pose"]["origin_mm"] == list(ORIGIN)
    assert comment["pose"]["sd_X0"] == pytest.approx(1e-3)


def test_exif_colours_and_comment_of_the_camera_stay(thermal):
    """The EXIF orientation of a phone's frame does not turn the pixels."""
    grey = seen_at(thermal, HOT)
    colour = np.stack([grey, grey, np.full_like(grey, 90)], axis=-1)
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Nexus", 6
    buffer = io.BytesIO()
    Image.fromarray(colour[..., ::-1]).save(buffer, "JPEG", exif=exif, comment=b"mine", quality=95)
    jpeg = corrected(thermal, buffer.getvalue())
    image = Image.open(io.BytesIO(jpeg))
    assert (image.size, image.mode) == ((820, 616), "RGB")
    assert (image.getexif()[0x010F], image.getexif()[0x0112]) == ("Nexus", 6)
    assert b"mine" in jpeg[:2000]
    assert json.loads(image.info["comment"])["format"] == "thermocald-frame/1"
    assert abs(float(np.median(np.asarray(image)[..., 0])) - 90) < 3


def test_other_images_are_refused(thermal):
    """12 and 16 bits become a JPEG."""
    grey, small = np.full((616, 820), 250, np.uint8), np.zeros((60, 80), np.uint8)
    for most in (4095, 65535):
        deep = np.rint(grey * (most / 255)).astype(np.uint16)
        assert corrected(thermal, png(deep)) == corrected(thermal, png(grey))
    far = CalibratedEpoch(calibrated(thermal).epoch, failed("outside_range", "90 °C"), {})
    for encoded, done, words in (
        (png(small), None, "80×60 px, the model's camera 820×616"),
        (b"\xff\xd8 no image", None, "the JPEG is cut off"),
        (png(deep), far, "outside_range: 90 °C"),
    ):
        with pytest.raises(ImageError, match=words):
            corrected(thermal, encoded, done)
