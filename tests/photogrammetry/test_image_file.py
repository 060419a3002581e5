"""JPEGs are decoded to the grey values of OpenCV, or refused."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
import simplejpeg

from thermocald.arrays import full_scale
from thermocald.errors import ImageError
from thermocald.photogrammetry.targets.image_file import (
    EncodedImage,
    decode_grey,
    with_comment,
)

WIDTH, HEIGHT = 331, 247  # not whole numbers of units
COARSE = np.random.default_rng(4).integers(0, 256, (28, 37, 3), dtype=np.uint8)
COLOURS = cv2.resize(COARSE, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
JPEG = cv2.imencode(".jpg", COLOURS, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def check_grey_values(data: bytes) -> None:
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(decode_grey(data), expected)


@pytest.mark.parametrize("subsampling", ["444", "422", "420", "440", "Gray"])
def test_grey_values_are_opencv_s(subsampling):
    """Phones append the seconds around a photograph, which change nothing."""
    data = simplejpeg.encode_jpeg(COLOURS, 90, "BGR", subsampling)
    check_grey_values(data)
    assert np.array_equal(decode_grey(data + bytes(range(200)) * 500), decode_grey(data))


def test_files_that_simplejpeg_refuses_are_read_by_opencv():
    damaged = bytearray(JPEG)
    damaged[len(damaged) // 2 : len(damaged) // 2 + 2] = b"\xff\xc0"
    with pytest.raises(ValueError):
        simplejpeg.decode_jpeg(bytes(damaged), "GRAY")
    check_grey_values(bytes(damaged))


def test_a_tiff_is_not_turned():
    """OpenCV turns it by its tag; the interior orientation is that of the sensor."""
    grey = COLOURS[..., 1]
    data = cv2.imencode(".tif", grey)[1].tobytes()
    # the tag takes the place of the number of samples, which is 1 by default
    samples, turn = (struct.pack("<HHIHH", *tag, 0) for tag in ((277, 3, 1, 1), (274, 3, 1, 6)))
    assert samples in data
    assert np.array_equal(decode_grey(data.replace(samples, turn)), grey)


def test_a_truncated_jpeg_is_refused():
    preview = with_comment(JPEG, "\xff").replace("\xff".encode(), b"\xff\xd9")
    for data in (JPEG, preview):
        with pytest.raises(ImageError, match="its end is missing"):
            EncodedImage(data[:-200])


@pytest.mark.parametrize(
    ("brightest", "full"), [(600, 1023), (2500, 4095), (9000, 16383), (40_000, 65_535)]
)
def test_a_sensor_of_10_to_16_bit_saturates_at_its_own_full_scale(brightest, full):
    assert full_scale(np.array([[0, brightest]], dtype=np.uint16)) == full
