"""Camera buffers to grey images: GREY, Y10 to Y16, YUYV, UYVY, NV12, YU12, MJPEG, Bayer.

Grey means luminance: of a colour format its Y plane, of a Bayer mosaic OpenCV's demosaiced grey in
full size and full depth. A buffer that is too short, or a JPEG without an end, is a BadReading.
Source: Linux userspace API, "Image formats" (V4L2 fourcc codes).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np

from thermocald.errors import BadReading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Grey = NDArray[np.uint8] | NDArray[np.uint16]

BAYER_ORDERS = {
    # V4L2's names give the first row: RG10 starts with R G
    "RGGB": "RGGB", "RG10": "RGGB", "RG12": "RGGB", "RG16": "RGGB", "pRAA": "RGGB",
    "BA81": "BGGR", "BG10": "BGGR", "BG12": "BGGR", "BYR2": "BGGR", "pBAA": "BGGR",
    "GBRG": "GBRG", "GB10": "GBRG", "GB12": "GBRG", "GB16": "GBRG", "pGAA": "GBRG",
    "GRBG": "GRBG", "BA10": "GRBG", "BA12": "GRBG", "GR16": "GRBG", "pgAA": "GRBG",
}  # fmt: skip
_ONE_BYTE = {"GREY", "NV12", "YU12", "RGGB", "BA81", "GBRG", "GRBG"}  # a pixel, in the first plane
_TWO_PIXELS = {"YUYV": 0, "UYVY": 1}  # in four bytes: where Y is
_PACKED = {"pRAA", "pBAA", "pGAA", "pgAA"}
FORMATS = ("GREY", "Y10 ", "Y12 ", "Y16 ", "YUYV", "UYVY", "NV12", "YU12", *BAYER_ORDERS)


def _plane(data: memoryview, height: int, row_bytes: int, stride: int) -> NDArray[np.uint8]:
    """(height, row_bytes) bytes out of rows of `stride` bytes; the last may lack its padding."""
    stride = max(stride, row_bytes)
    needed = stride * (height - 1) + row_bytes
    if len(data) < needed:
        raise BadReading(f"partial frame: {len(data)} of {needed} bytes")
    flat = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(flat, (height, row_bytes), (stride, 1))
    return rows.copy()  # the camera writes into its buffer again as soon as it is given back


def unpack_10(packed: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """MIPI RAW10: four high bytes, then one byte with the four pairs of low bits."""
    high = packed.reshape(packed.shape[0], -1, 5)
    low = high[..., 4:5] >> np.array([0, 2, 4, 6], np.uint8) & 3
    pixels = (high[..., :4].astype(np.uint16) << np.uint16(2)) | low
    return pixels.reshape(packed.shape[0], -1).astype(np.uint16)


def _grey(data: memoryview, fourcc: str, width: int, height: int, stride: int) -> Grey:
    """Return the grey image in the bytes of one buffer."""
    image: Grey
    if fourcc in _TWO_PIXELS:
        first = _TWO_PIXELS[fourcc]
        return np.ascontiguousarray(_plane(data, height, 2 * width, stride)[:, first::2])
    if fourcc in _ONE_BYTE:
        image = _plane(data, height, width, stride)
    elif fourcc in _PACKED:
        image = unpack_10(_plane(data, height, width * 5 // 4, stride))
    else:
        image = _plane(data, height, 2 * width, stride).view("<u2")
    if fourcc not in BAYER_ORDERS:
        return image
    import cv2

    conversion = getattr(cv2, f"COLOR_Bayer{BAYER_ORDERS[fourcc]}2GRAY")
    return cast("Grey", cv2.cvtColor(image, conversion))


def jpeg_end(data: bytes) -> bool:
    """Return whether the bytes start and end as a JPEG; cameras pad the end with zeros."""
    return data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9"


def decode(
    data: memoryview, fourcc: str, width: int, height: int, stride: int = 0
) -> tuple[Grey, bytes | None]:
    """Return (grey image, the JPEG as it came or None) of one buffer, which is free after it."""
    if fourcc not in ("MJPG", "JPEG"):
        return _grey(data, fourcc, width, height, stride), None
    import simplejpeg

    encoded = bytes(data)
    if not jpeg_end(encoded):
        raise BadReading(f"partial frame: {len(encoded)} bytes without the end of a JPEG")
    try:
        grey = simplejpeg.decode_jpeg(encoded, colorspace="GRAY")[:, :, 0]
    except ValueError as error:
        raise BadReading(f"broken JPEG: {error}") from error
    if grey.shape != (height, width):
        raise BadReading(f"the JPEG has {grey.shape[1]}×{grey.shape[0]} px, not {width}×{height}")
    return np.ascontiguousarray(grey), encoded
