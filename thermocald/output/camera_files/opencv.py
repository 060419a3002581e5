"""OpenCV's YAML as cv2.FileStorage reads it and `calibration` in OpenCV's samples writes it.

camera_matrix (3, 3), distortion_coefficients (1, 4 … 12) in OpenCV's order, image_width,
image_height. A covariance goes into nodes of our own, which OpenCV's readers pass over:
intrinsics_covariance in the order fx fy cx cy k1 k2 p1 p2 k3, and std_deviation_intrinsics.
"""

from __future__ import annotations

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.output.camera_files.camera_record import (
    Format,
    ImportedCamera,
    Record,
    header,
    import_family,
    numbers,
)
from thermocald.photogrammetry.conversions import to_family
from thermocald.photogrammetry.model_families import BrownOpenCV

__all__ = ["FORMAT"]

_COUNTS = (0, 4, 5, 8, 12)


def _encode(record: Record) -> tuple[str, str]:
    import cv2

    family = BrownOpenCV(5)
    result = to_family(record.model, family, record.covariance)
    fx, fy, cx, cy = result.values[:4]
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", record.name)
    storage.write("image_width", record.model.sensor.width)
    storage.write("image_height", record.model.sensor.height)
    storage.write("camera_matrix", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", result.values[None, 4:])
    if result.covariance is not None:
        storage.write("std_deviation_intrinsics", np.sqrt(np.diag(result.covariance))[None])
        storage.write("intrinsics_covariance", result.covariance)
    text = storage.releaseAndGetString()
    begin, mark, rest = text.partition("---\n")
    return begin + mark + header(record, result.statement) + rest, result.statement


def _decode(text: str, pitch: float | None) -> ImportedCamera:
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):  # what its bindings raise for a syntax error
        raise ConfigurationError("OpenCV cannot parse the file") from None
    try:
        K, d, Q = (
            storage.getNode(n).mat()
            for n in ("camera_matrix", "distortion_coefficients", "intrinsics_covariance")
        )
        size = tuple(int(storage.getNode(n).real()) for n in ("image_width", "image_height"))
        name = storage.getNode("camera_name").string() or "camera"
    finally:
        storage.release()
    K = numbers(K, "camera_matrix", (9,)).reshape(3, 3)
    d = numbers(d if d is not None else [], "distortion_coefficients", (*_COUNTS, 14))
    if len(d) == 14:
        if np.any(d[12:]):
            raise ConfigurationError("a tilted sensor (tau) has no counterpart in this model")
        d = d[:12]
    if K[0, 1] != 0:
        raise ConfigurationError("a skewed camera_matrix is nothing that OpenCV itself uses")
    values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], d])
    if Q is not None and Q.shape != (len(values), len(values)):
        Q = None
    return import_family(
        "opencv", text, (size[0], size[1]), BrownOpenCV(len(d)), values, pitch, name, Q
    )


FORMAT = Format(
    "opencv", ".yaml", "OpenCV FileStorage YAML", _encode, _decode,
    lambda text: text.startswith("%YAML") and "camera_matrix" in text,
)  # fmt: skip
