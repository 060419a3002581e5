"""JPEGs are decoded to the grey values of OpenCV, or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import simplejpeg

from thermocald.errors import ImageError
from thermocald.photogrammetry.targets.image_file import (
    EncodedImage,
    decode_grey,
    with_comment,
)

WIDTH, HEIGHT = 331, 247  # not whole numbers of units


def _colours(seed: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (HEIGHT // 9 + 1, WIDTH // 9 + 1, 3), dtype=np.uint8)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def _cv2_jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def _opencv(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


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
