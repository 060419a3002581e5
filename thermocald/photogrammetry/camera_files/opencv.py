"""OpenCV's YAML as cv2.FileStorage reads it and `calibration` in OpenCV's samples writes it.

camera_matrix (3, 3), distortion_coefficients (1, 4 … 12) in OpenCV's order, image_width,
image_height. A covariance goes into nodes of our own, which OpenCV's readers pass over:
intrinsics_covariance in the order fx fy cx cy k1 k2 p1 p2 k3, and std_deviation_intrinsics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import BrownOpenCV, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import number, numbers, yaml_document

if TYPE_CHECKING:
    from thermocald.arrays import Array


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


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise ConfigurationError("an opencv-matrix has no rows, cols, and data")
    return loader.construct_mapping(node, deep=True)


# OpenCV 5 writes vectors as the second kind
for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _matrix)


def _numbers(document: dict[Any, Any], key: str, counts: tuple[int, ...]) -> Array:
    node = document.get(key)
    return numbers(node.get("data") if isinstance(node, dict) else node, key, counts)


def _decode(text: str) -> ForeignCamera:
    # not with cv2.FileStorage: a damaged file makes it crash the process (OpenCV 5.0.0)
    document = yaml_document(text.partition("\n")[2], _Loader)
    if not isinstance(document, dict):
        raise ConfigurationError("the file holds no keys")
    K = _numbers(document, "camera_matrix", (9,)).reshape(3, 3)
    d = np.zeros(0)
    if "distortion_coefficients" in document:
        d = _numbers(document, "distortion_coefficients", (*_COUNTS, 14))
    size = [int(number(document.get(key), key)) for key in ("image_width", "image_height")]
    if len(d) == 14:
        if np.any(d[12:]):
            raise ConfigurationError("a tilted sensor (tau) has no counterpart in this model")
        d = d[:12]
    if K[0, 1] != 0:
        raise ConfigurationError("a skewed camera_matrix is nothing that OpenCV itself uses")
    values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], d])
    covariance = None
    if "intrinsics_covariance" in document:
        n = len(values)
        covariance = _numbers(document, "intrinsics_covariance", (n * n,)).reshape(n, n)
    name = str(document.get("camera_name", "camera"))
    return ForeignCamera((size[0], size[1]), BrownOpenCV(len(d)), values, name, covariance)


FORMAT = Format(
    "opencv", ".yaml", "OpenCV FileStorage YAML", _encode, _decode,
    lambda text: text.startswith("%YAML") and "camera_matrix" in text,
)  # fmt: skip
