"""Our own JSON: everything, with the covariance."""

from __future__ import annotations

import json

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.camera_files.camera_record import Format, ImportedCamera, Record
from thermocald.photogrammetry.camera_files.file_text import number, numbers

_VERSION = "thermocald-camera/1"


def _encode(record: Record) -> tuple[str, str]:
    sensor, interior = record.model.sensor, record.model.interior
    values: dict[str, float] = {}
    for k, name in enumerate(IOP_NAMES):
        values[name] = float(getattr(interior, name))
        if record.covariance is not None:
            values[f"sd_{name}"] = float(np.sqrt(record.covariance[k, k]))
    document = {
        "format": _VERSION,
        "name": record.name,
        "comment": record.comment,
        "sensor": {
            "width": sensor.width, "height": sensor.height, "pixel_pitch": sensor.pixel_pitch,
        },
        "interior": values,
        "covariance": None
        if record.covariance is None
        else {"parameters": list(IOP_NAMES), "matrix": record.covariance.tolist()},
    }  # fmt: skip
    return json.dumps(document, indent=1, allow_nan=False) + "\n", "exact: it is our own model"


def _decode(text: str) -> ImportedCamera:
    try:
        document = json.loads(text)
    except json.JSONDecodeError as cause:
        raise ConfigurationError(f"no valid JSON: {cause}") from None
    if not isinstance(document, dict) or document.get("format") != _VERSION:
        raise ConfigurationError(f"no camera file: format is not {_VERSION!r}")
    head, values = document.get("sensor"), document.get("interior")
    if not isinstance(head, dict) or not isinstance(values, dict):
        raise ConfigurationError("sensor or interior is missing")
    width, height = (int(number(head.get(side), f"sensor.{side}")) for side in ("width", "height"))
    own = number(head.get("pixel_pitch"), "sensor.pixel_pitch")
    if "c" not in values:
        raise ConfigurationError("interior.c is missing")
    interior = InteriorOrientation.from_mapping(
        {name: number(values[name], f"interior.{name}") for name in IOP_NAMES if name in values}
    )
    covariance = None
    if document.get("covariance") is not None:
        matrix = document["covariance"].get("matrix")
        covariance = numbers(matrix, "covariance.matrix", (100,)).reshape(10, 10)
    return ImportedCamera(
        CameraModel(Sensor(width, height, own), interior), "json",
        str(document.get("name", "camera")), True, 0.0, 0.0, covariance,
    )  # fmt: skip


FORMAT = Format(
    "json", ".json", "thermocald's own, with covariance", _encode, _decode,
    lambda text: f'"{_VERSION}"' in text[:200],
)  # fmt: skip
