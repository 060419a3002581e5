"""ROS camera_info YAML as camera_calibration_parsers reads it: model plumb_bob, or rational."""

from __future__ import annotations

from typing import Any

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import BrownOpenCV, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import (
    number,
    numbers,
    yaml_document,
    yaml_text,
)

_COUNT = {"plumb_bob": 5, "rational_polynomial": 8}


def _matrix(values: Any, rows: int) -> dict[str, Any]:
    flat = [float(v) for v in np.ravel(values)]
    return {"rows": rows, "cols": len(flat) // rows, "data": flat}


def _encode(record: Record) -> tuple[str, str]:
    result = to_family(record.model, BrownOpenCV(5))
    fx, fy, cx, cy = result.values[:4]
    K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    document = {
        "image_width": record.model.sensor.width,
        "image_height": record.model.sensor.height,
        "camera_name": record.name,
        "camera_matrix": _matrix(K, 3),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _matrix(result.values[4:], 1),
        "rectification_matrix": _matrix(np.eye(3), 3),
        "projection_matrix": _matrix([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], 3),
    }
    return header(record, result.statement) + yaml_text(document), result.statement


def _decode(text: str) -> ForeignCamera:
    document = yaml_document(text)
    if not isinstance(document, dict):
        raise ConfigurationError("no camera_info: the file holds no keys")
    model = document.get("distortion_model")
    if model not in _COUNT:
        raise ConfigurationError(
            f"distortion_model {model!r}: plumb_bob and rational_polynomial can be read"
        )
    data = {}
    for key in ("camera_matrix", "distortion_coefficients"):
        node = document.get(key)
        data[key] = node.get("data") if isinstance(node, dict) else None
    K = numbers(data["camera_matrix"], "camera_matrix.data", (9,))
    d = numbers(data["distortion_coefficients"], "distortion_coefficients.data", (_COUNT[model],))
    size = [int(number(document.get(key), key)) for key in ("image_width", "image_height")]
    values = np.concatenate([K[[0, 4, 2, 5]], d])
    name = str(document.get("camera_name", "camera"))
    return ForeignCamera((size[0], size[1]), BrownOpenCV(len(d)), values, name)


FORMAT = Format(
    "ros", ".yaml", "ROS camera_info", _encode, _decode,
    lambda text: "distortion_model:" in text and "image_width:" in text,
)  # fmt: skip
