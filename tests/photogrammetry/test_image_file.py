"""JPEGs decoded whole and in parts give the same grey values and the same centres."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import simplejpeg

from tests.photogrammetry.exact_rendering import noisy
from tests.photogrammetry.fields import SMALL_SENSOR, small_field, small_frame
from thermocald.errors import ImageError
from thermocald.photogrammetry.camera.camera_model import CameraSpec
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.targets import image_file
from thermocald.photogrammetry.targets.image_file import (
    EncodedImage,
    decode_grey,
    with_comment,
)

WIDTH, HEIGHT = 331, 247  # not whole numbers of units
BOXES = np.array([[40, 30, 60, 50], [200, 100, 231, 117], [320, 200, 400, 230], [-9, -9, 3, 3]])


def _colours(seed: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (HEIGHT // 9 + 1, WIDTH // 9 + 1, 3), dtype=np.uint8)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def _cv2_jpeg(image: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90, *options])[1].tobytes()


def _opencv(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def _inside(boxes: np.ndarray) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for left, top, right, bottom in np.maximum(boxes, 0):
        mask[top:bottom, left:right] = True
    return mask


@pytest.mark.parametrize("subsampling", ["444", "422", "420", "440", "Gray"])
def test_grey_values_are_opencv_s(subsampling):
    data = simplejpeg.encode_jpeg(_colours(), 90, "BGR", subsampling)
    assert np.array_equal(decode_grey(data), _opencv(data))


def test_files_that_simplejpeg_refuses_are_read_by_opencv():
    damaged = bytearray(_cv2_jpeg(_colours()))
    damaged[len(damaged) // 2 : len(damaged) // 2 + 2] = b"\xff\xc0"
    with pytest.raises(ValueError):
        simplejpeg.decode_jpeg(bytes(damaged), "GRAY")
    assert np.array_equal(decode_grey(bytes(damaged)), _opencv(bytes(damaged)))


@pytest.mark.parametrize("units", [1, 7, 21, 42, 84])
@pytest.mark.parametrize("grey", [True, False])
def test_segments_give_the_same_grey_values(units, grey, monkeypatch):
    """A row of 8 or 16 px has several segments, or one; or a segment has several rows."""
    image = _colours()
    data = _cv2_jpeg(image[..., 0] if grey else image, cv2.IMWRITE_JPEG_RST_INTERVAL, units)
    decoded = []
    original = simplejpeg.decode_jpeg

    def decode(part, **options):
        decoded.append(len(part))
        return original(part, **options)

    monkeypatch.setattr(image_file.simplejpeg, "decode_jpeg", decode)
    found = EncodedImage(data).around(BOXES, image.shape[:2])
    whole = _opencv(data)
    assert found is not None
    assert found.shape == whole.shape
    inside = _inside(BOXES)
    assert np.array_equal(found[inside], whole[inside])
    if units < 84:
        assert decoded[0] < 0.7 * len(data), "the file was decoded as a whole"


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), None])
def test_other_files_are_decoded_whole(options):
    """A file without restart markers, a progressive one, and one that lacks a restart marker."""
    if options is not None:
        data = _cv2_jpeg(_colours(), *options)
    else:
        data = _cv2_jpeg(_colours(), cv2.IMWRITE_JPEG_RST_INTERVAL, 21)
        at = data.index(b"\xff\xd3")
        data = data[:at] + data[at + 2 :]
    assert EncodedImage(data).around(np.array([[0, 200, 9, HEIGHT]]), (HEIGHT, WIDTH)) is None


def test_a_truncated_jpeg_is_refused():
    whole = _cv2_jpeg(_colours())
    preview = with_comment(whole, "\xff").replace("\xff".encode(), b"\xff\xd9")
    for data in (whole[:-200], preview[:-200]):
        with pytest.raises(ImageError, match="its end is missing"):
            EncodedImage(data)


def test_a_video_after_the_end_of_a_jpeg_changes_nothing():
    """Phones append the seconds around a photograph."""
    data = _cv2_jpeg(_colours())
    assert np.array_equal(decode_grey(data + bytes(range(200)) * 500), decode_grey(data))


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [noisy(small_frame(), rng) for _ in range(3)]


def test_tracked_centres_are_the_same_to_the_last_bit(frames, monkeypatch):
    """Frames decoded in parts and as a whole give the same; only the first is decoded whole."""
    encoded = [_cv2_jpeg(frame, cv2.IMWRITE_JPEG_RST_INTERVAL, 41) for frame in frames]
    field, _ = small_field()
    parts, wholes = (Tracker(field, CameraSpec("", SMALL_SENSOR)) for _ in range(2))
    parts.measure(EncodedImage(encoded[0]))
    wholes.measure(_opencv(encoded[0]))
    monkeypatch.setattr(EncodedImage, "whole", None)  # not to be called
    for data in encoded[1:]:
        found, expected = parts.measure(EncodedImage(data)), wholes.measure(_opencv(data))
        assert not found.searched
        assert np.array_equal(found.observations.points, expected.observations.points)
        assert np.array_equal(found.observations.sigmas, expected.observations.sigmas)
