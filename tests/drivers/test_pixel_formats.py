"""Camera buffers to grey: each format against a known image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from linuxpy.video import raw
from thermocald_drivers.support import BAYER_ORDERS, FORMATS, decode

from thermocald.errors import BadReading

HEIGHT, WIDTH = 24, 40
rng = np.random.default_rng(7)
RAMP = (np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)) * 3 % 251).astype(np.uint8)


def grey(data: bytes, fourcc: str, stride: int = 0):
    return decode(memoryview(data), fourcc, WIDTH, HEIGHT, stride)[0]


def test_luminance_planes():
    noise = rng.integers(0, 255, RAMP.shape, np.uint8)
    planar = np.concatenate([RAMP, noise[: HEIGHT // 2]])
    deep = RAMP.astype("<u2") * 4 + 3
    padded = np.hstack([RAMP, noise])
    for fourcc, data, stride, expected in (
        ("GREY", RAMP, 0, RAMP), ("YUYV", np.stack([RAMP, noise], -1), 0, RAMP),
        ("UYVY", np.stack([noise, RAMP], -1), 0, RAMP), ("NV12", planar, 0, RAMP),
        ("YU12", planar, 0, RAMP), ("Y10 ", deep, 0, deep),
        # rows may be padded, and the last one cut
        ("GREY", padded.ravel()[:-WIDTH], 2 * WIDTH, RAMP),
    ):  # fmt: skip
        assert np.array_equal(grey(data.tobytes(), fourcc, stride), expected), fourcc


@pytest.mark.parametrize("fourcc", sorted(BAYER_ORDERS))
def test_bayer_of_a_plain_colour_is_its_luminance(fourcc):
    """A wrong order would swap red and blue, 0.299 and 0.114, or their lowest bits."""
    eight = fourcc in ("RGGB", "BA81", "GBRG", "GRBG")
    colour = {"R": 200, "G": 100, "B": 40} if eight else {"R": 803, "G": 400, "B": 162}
    order = raw.PixelFormat(raw.v4l2_fourcc(*fourcc)).name[1:5]  # of the kernel: SGRBG10
    tile = np.array([colour[letter] for letter in order], "<u2").reshape(2, 2)
    mosaic = np.tile(tile, (HEIGHT // 2, WIDTH // 2))
    size = np.uint8 if eight else "<u2"
    data = pack_10(mosaic) if fourcc.startswith("p") else mosaic.astype(size)
    centre = grey(data.tobytes(), fourcc)[4:-4, 4:-4]
    luminance = 0.299 * colour["R"] + 0.587 * colour["G"] + 0.114 * colour["B"]
    # some versions of OpenCV truncate 8 bits
    assert centre == pytest.approx(luminance, abs=1.5 if eight else 1.0)


def pack_10(values):
    """Pack MIPI CSI-2 RAW10 by the standard's byte order, independently of the decoder."""
    four = values.reshape(HEIGHT, -1, 4)
    low = np.sum((four & 3) << np.arange(0, 8, 2), axis=-1, keepdims=True)
    return np.concatenate([four >> 2, low], axis=-1).astype(np.uint8)


def test_mjpeg_is_decoded_and_kept():
    smooth = cv2.GaussianBlur(RAMP, (0, 0), 3)
    encoded = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    image, kept = decode(memoryview(encoded + bytes(100)), "MJPG", WIDTH, HEIGHT)
    assert kept == encoded + bytes(100)
    assert np.max(np.abs(image.astype(int) - smooth)) <= 4
    with pytest.raises(BadReading, match="has 40×24 px, not 41×24"):
        decode(memoryview(encoded), "MJPG", WIDTH + 1, HEIGHT)


@pytest.mark.parametrize("fourcc", sorted(FORMATS))
def test_a_short_buffer_of_any_format_is_refused(fourcc):
    with pytest.raises(BadReading, match="partial frame: 300 of"):
        grey(bytes(300), fourcc)
