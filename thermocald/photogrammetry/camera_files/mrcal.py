"""mrcal's .cameramodel: a Python dictionary literal; LENSMODEL_OPENCV4 or 5, pixel centres at 0."""

from __future__ import annotations

import ast

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import BrownOpenCV, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import numbers

_COUNTS = {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)} | {"LENSMODEL_PINHOLE": 0}


def _encode(record: Record) -> tuple[str, str]:
    count = 4 if record.model.interior.A3 == 0 else 5
    result = to_family(record.model, BrownOpenCV(count))
    sensor = record.model.sensor
    values = ", ".join(repr(float(v)) for v in result.values)
    body = (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_OPENCV{count}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': [ {values},],\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],\n\n"
        f"    'imagersize': [ {sensor.width}, {sensor.height},],\n"
        "}\n"
    )
    return header(record, result.statement) + body, result.statement


def _decode(text: str) -> ForeignCamera:
    try:
        document = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        raise ConfigurationError("no .cameramodel: not a dictionary in Python's notation") from None
    if not isinstance(document, dict):
        raise ConfigurationError("no .cameramodel: not a dictionary")
    lens = document.get("lensmodel")
    if lens not in _COUNTS:
        raise ConfigurationError(f"lensmodel {lens!r}: {', '.join(sorted(_COUNTS))} can be read")
    count = _COUNTS[lens]
    values = numbers(document.get("intrinsics"), "intrinsics", (4 + count,))
    size = numbers(document.get("imagersize"), "imagersize", (2,))
    return ForeignCamera((int(size[0]), int(size[1])), BrownOpenCV(count), values)


FORMAT = Format(
    "mrcal", ".cameramodel", "mrcal cameramodel", _encode, _decode,
    lambda text: "lensmodel" in text and "imagersize" in text,
)  # fmt: skip
