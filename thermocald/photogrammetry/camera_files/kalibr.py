"""Kalibr's camchain YAML: pinhole with radtan, which has no sixth-order radial term."""

from __future__ import annotations

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import BrownOpenCV, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import numbers, yaml_document, yaml_text


def _encode(record: Record) -> tuple[str, str]:
    result = to_family(record.model, BrownOpenCV(4))
    values = [float(v) for v in result.values]
    sensor = record.model.sensor
    document = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": values[:4],
            "distortion_model": "radtan",
            "distortion_coeffs": values[4:],
            "resolution": [sensor.width, sensor.height],
            "rostopic": f"/{record.name}/image_raw",
        }
    }
    return header(record, result.statement) + yaml_text(document), result.statement


def _decode(text: str) -> ForeignCamera:
    document = yaml_document(text)
    camera = document.get("cam0") if isinstance(document, dict) else None
    if not isinstance(camera, dict):
        raise ConfigurationError("no camchain: there is no cam0")
    if "cam1" in document:
        raise ConfigurationError("the chain holds several cameras: leave the one that is wanted")
    kinds = camera.get("camera_model"), camera.get("distortion_model")
    if kinds[0] != "pinhole" or kinds[1] not in ("radtan", "none", None):
        raise ConfigurationError(
            f"camera_model {kinds[0]!r} with distortion_model {kinds[1]!r}: pinhole with radtan "
            "can be read"
        )
    f = numbers(camera.get("intrinsics"), "intrinsics", (4,))
    d = numbers(camera.get("distortion_coeffs") or [], "distortion_coeffs", (0, 4))
    size = numbers(camera.get("resolution"), "resolution", (2,))
    return ForeignCamera((int(size[0]), int(size[1])), BrownOpenCV(len(d)), np.concatenate([f, d]))


FORMAT = Format(
    "kalibr", ".yaml", "Kalibr camchain", _encode, _decode,
    lambda text: "cam0:" in text and "camera_model" in text,
)  # fmt: skip
