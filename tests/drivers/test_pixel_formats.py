"""Camera buffers to grey: each format against a known image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from thermocald_drivers.support import BAYER_ORDERS, FORMATS, decode

from thermocald.errors import BadReading

HEIGHT, WIDTH = 24, 40
rng = np.random.default_rng(7)
RAMP = (np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)) * 3 % 251).astype(np.uint8)


def grey(data: bytes, fourcc: str, stride: int = 0):
    return decode(memoryview(data), fourcc, WIDTH, HEIGHT, stride)[0]


def test_luminance_planes():
    noise = rng.integers(0, 255, RAMP.shape, np.uint8)
    assert np.array_equal(grey(RAMP.tobytes(), "GREY"), RAMP)
    assert np.array_equal(grey(np.stack([RAMP, noise], -1).tobytes(), "YUYV"), RAMP)
    assert np.array_equal(grey(np.stack([noise, RAMP], -1).tobytes(), "UYVY"), RAMP)
    planar = RAMP.tobytes() + bytes(HEIGHT * WIDTH // 2)
    assert np.array_equal(grey(planar, "NV12"), RAMP)
    assert np.array_equal(grey(planar, "YU12"), RAMP)


def test_ten_bits_stay_ten_bits():
    deep = RAMP.astype("<u2") * 4 + 3
    assert np.array_equal(grey(deep.tobytes(), "Y10 "), deep)


def test_rows_may_be_padded_and_the_last_one_cut():
    padded = np.zeros((HEIGHT, WIDTH + 24), np.uint8)
    padded[:, :WIDTH] = RAMP
    assert np.array_equal(grey(padded.tobytes()[:-24], "GREY", WIDTH + 24), RAMP)


@pytest.mark.parametrize("fourcc", sorted(BAYER_ORDERS))
def test_bayer_of_a_plain_colour_is_its_luminance(fourcc):
    """A wrong order would swap red and blue, 0.299 and 0.114."""
    red, green, blue = 200, 100, 40
    colour = {"R": red, "G": green, "B": blue}
    tile = np.array([colour[letter] for letter in BAYER_ORDERS[fourcc]], np.uint16).reshape(2, 2)
    mosaic = np.tile(tile, (HEIGHT // 2, WIDTH // 2))
    scale = 1
    if fourcc in ("RGGB", "BA81", "GBRG", "GRBG"):
        data = mosaic.astype(np.uint8).tobytes()
    elif fourcc.startswith("p"):
        scale = 4
        data = pack_10(mosaic * 4).tobytes()
    else:
        scale = 4
        data = (mosaic * 4).astype("<u2").tobytes()
    luminance = (0.299 * red + 0.587 * green + 0.114 * blue) * scale
    centre = grey(data, fourcc)[4:-4, 4:-4]
    assert centre == pytest.approx(luminance, abs=1.5 * scale)


def pack_10(values):
    """Pack MIPI CSI-2 RAW10 by the standard's byte order, independently of the decoder."""
    rows = []
    for row in values:
        packed = []
        for k in range(0, len(row), 4):
            four = [int(v) for v in row[k : k + 4]]
            packed += [v >> 2 for v in four] + [sum((v & 3) << 2 * n for n, v in enumerate(four))]
        rows.append(packed)
    return np.array(rows, np.uint8)


def test_packed_ten_bits_come_back():
    from thermocald_drivers.support import unpack_10

    values = rng.integers(0, 1024, (HEIGHT, WIDTH), np.uint16)
    assert np.array_equal(unpack_10(pack_10(values)), values)


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
