"""Grey values from image files and JPEG bytes, whole or only where they are looked at.

JPEGs are decoded by libjpeg-turbo through simplejpeg, to the luminance alone: two thirds of the
time of OpenCV, which decodes all others and those that simplejpeg refuses. The pixels are the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg

from thermocald.errors import ImageError
from thermocald.photogrammetry.targets.image_header import image_size
from thermocald.photogrammetry.targets.jpeg_parts import decode_parts

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["EncodedImage", "decode_grey"]

_MOST_PIXELS = 250_000_000
_MOST_BYTES = 1_000_000_000


class EncodedImage:
    """An image file or encoded bytes (H, W), decoded as far as they are looked at.

    Raises ImageError saying what is wrong with the file, at the latest when it is decoded.
    """

    def __init__(self, source: Path | bytes) -> None:
        self.name = str(source) if isinstance(source, Path) else "the frame"
        self._data = data = _read(source, self.name) if isinstance(source, Path) else source
        if not data:
            raise ImageError(f"{self.name}: is empty (0 bytes)")
        self._size = image_size(data)
        if self._size is not None and self._size[0] * self._size[1] > _MOST_PIXELS:
            raise ImageError(
                f"{self.name}: says that it has {self._size[0]} × {self._size[1]} px; at most "
                f"{_MOST_PIXELS // 10**6} million are decoded"
            )
        self._is_jpeg = data[:2] == b"\xff\xd8"
        if self._is_jpeg and b"\xff\xd9" not in data[-64:]:
            raise ImageError(f"{self.name}: the JPEG is cut off: its end is missing")

    def whole(self) -> NDArray[Any]:
        """Grey values (H, W), 8 or 16 bit.

        The orientation flag of EXIF is not obeyed: the sensor does not turn with it.
        """
        if self._is_jpeg:
            try:
                grey: NDArray[Any] = simplejpeg.decode_jpeg(self._data, colorspace="GRAY")[..., 0]
                return grey
            except ValueError:
                pass  # another colour space, or damage that OpenCV bears with or names
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(self._data, np.uint8), flags)
        except cv2.error as error:
            raise ImageError(
                f"{self.name}: is not an image that can be decoded ({error.err})"
            ) from error
        if image is None:
            raise ImageError(f"{self.name}: is not an image (JPEG, PNG and TIFF are read)")
        if image.dtype not in (np.uint8, np.uint16):
            raise ImageError(f"{self.name}: {image.dtype} grey values; 8 or 16 bit are read")
        return image

    def around(self, boxes: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
        """Grey values (H, W) that hold within boxes (n, 4) px (left, top, right, bottom).

        None where the file cannot be decoded in parts or has not the shape (H, W). The memory is
        used again by the next call in this thread.
        """
        if not self._is_jpeg or self._size is None or self._size[::-1] != tuple(shape):
            return None
        return decode_parts(self._data, boxes)


def decode_grey(source: Path | bytes) -> NDArray[Any]:
    """Grey values (H, W), 8 or 16 bit, of an image file or of encoded bytes.

    The orientation flag of EXIF is not obeyed: the sensor does not turn with it.
    Raises ImageError saying what is wrong with the file.
    """
    return EncodedImage(source).whole()


def _read(path: Path, name: str) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise ImageError(f"{name}: is not a file")
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            raise ImageError(f"{name}: is larger than {_MOST_BYTES // 10**6} MB")
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"{name}: cannot be read: {error.strerror or error}") from error
