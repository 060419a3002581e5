"""Grey values from image files and JPEG bytes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import ImageError
from thermocald.photogrammetry.targets.image_header import image_size

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["decode_grey"]

_MOST_PIXELS = 250_000_000
_MOST_BYTES = 1_000_000_000


def decode_grey(source: Path | bytes) -> NDArray[Any]:
    """Grey values (H, W), 8 or 16 bit, of an image file or of encoded bytes.

    The orientation flag of EXIF is not obeyed: the sensor does not turn with it.
    Raises ImageError saying what is wrong with the file.
    """
    name = str(source) if isinstance(source, Path) else "the frame"
    if isinstance(source, Path):
        try:
            if source.exists() and not source.is_file():
                raise ImageError(f"{name}: is not a file")
            if source.exists() and source.stat().st_size > _MOST_BYTES:
                raise ImageError(f"{name}: is larger than {_MOST_BYTES // 10**6} MB")
            data = source.read_bytes()
        except OSError as error:
            raise ImageError(f"{name}: cannot be read: {error.strerror or error}") from error
    else:
        data = source
    if not data:
        raise ImageError(f"{name}: is empty (0 bytes)")
    size = image_size(data)
    if size is not None and size[0] * size[1] > _MOST_PIXELS:
        raise ImageError(
            f"{name}: says that it has {size[0]} × {size[1]} px; at most {_MOST_PIXELS // 10**6} "
            "million are decoded"
        )
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-64:]:
        raise ImageError(f"{name}: the JPEG is cut off: its end is missing")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{name}: is not an image that can be decoded ({error.err})") from error
    if image is None:
        raise ImageError(f"{name}: is not an image (JPEG, PNG and TIFF are read)")
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{name}: {image.dtype} grey values; 8 or 16 bit are read")
    return image
