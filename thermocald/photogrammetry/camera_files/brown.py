"""Files of programs whose camera model is OpenCV's: OpenCV, ROS, Kalibr, mrcal, COLMAP.

OpenCV: YAML as cv2.FileStorage reads it and `calibration` in OpenCV's samples writes it, with
camera_matrix (3, 3), distortion_coefficients (1, 4 … 12) in OpenCV's order, image_width,
image_height. A covariance goes into nodes of our own, which OpenCV's readers pass over:
intrinsics_covariance in the order fx fy cx cy k1 k2 p1 p2 k3, and std_deviation_intrinsics.

ROS: camera_info YAML as camera_calibration_parsers reads it, model plumb_bob, or rational.

Kalibr: camchain YAML, pinhole with radtan, which has no sixth-order radial term.

mrcal: .cameramodel, a Python dictionary literal; LENSMODEL_OPENCV4 or 5, pixel centres at 0.

COLMAP: cameras.txt, `CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]`, pixel centres at 0.5. Written as
FULL_OPENCV, or as OPENCV where there is no k3; read from these and the simpler models.
"""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import Family, opencv
from thermocald.photogrammetry.camera_files.camera_record import (
    CameraRecord,
    Format,
    number,
    numbers,
    yaml_document,
    yaml_text,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import CameraModel

_OPENCV_COUNTS = (0, 4, 5, 8, 12)


def _encode_opencv(record: CameraRecord) -> str:
    import cv2

    fx, fy, cx, cy = record.values[:4]
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", record.name)
    storage.write("image_width", record.size[0])
    storage.write("image_height", record.size[1])
    storage.write("camera_matrix", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", record.values[None, 4:])
    if record.covariance is not None:
        storage.write("std_deviation_intrinsics", np.sqrt(np.diag(record.covariance))[None])
        storage.write("intrinsics_covariance", record.covariance)
    begin, mark, rest = storage.releaseAndGetString().partition("---\n")
    return begin + mark + record.head() + rest


class _OpenCVLoader(yaml.SafeLoader):
    """YAML with OpenCV's matrices."""


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise ConfigurationError("an opencv-matrix has no rows, cols, and data")
    return loader.construct_mapping(node, deep=True)


# OpenCV 5 writes vectors as the second kind
for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _OpenCVLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _opencv_matrix)


def _size(document: dict[Any, Any]) -> tuple[int, int]:
    width, height = (int(number(document.get(key), key)) for key in ("image_width", "image_height"))
    return width, height


def _opencv_numbers(document: dict[Any, Any], key: str, counts: tuple[int, ...]) -> Array:
    node = document.get(key)
    return numbers(node.get("data") if isinstance(node, dict) else node, key, counts)


def _decode_opencv(text: str) -> CameraRecord:
    # not with cv2.FileStorage: a damaged file makes it crash the process (OpenCV 5.0.0)
    document = yaml_document(text.partition("\n")[2], _OpenCVLoader)
    if not isinstance(document, dict):
        raise ConfigurationError("the file holds no keys")
    K = _opencv_numbers(document, "camera_matrix", (9,)).reshape(3, 3)
    d = np.zeros(0)
    if "distortion_coefficients" in document:
        d = _opencv_numbers(document, "distortion_coefficients", (*_OPENCV_COUNTS, 14))
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
        covariance = _opencv_numbers(document, "intrinsics_covariance", (n * n,)).reshape(n, n)
    name = str(document.get("camera_name", "camera"))
    return CameraRecord(_size(document), opencv(len(d)), values, name, covariance)


OPENCV = Format(
    "opencv", ".yaml", "OpenCV FileStorage YAML", lambda _: opencv(5),
    _encode_opencv, _decode_opencv,
    lambda text: text.startswith("%YAML") and "camera_matrix" in text,
)  # fmt: skip


_ROS_COUNTS = {"plumb_bob": 5, "rational_polynomial": 8}


def _ros_matrix(values: Any, rows: int) -> dict[str, Any]:
    flat = [float(v) for v in np.ravel(values)]
    return {"rows": rows, "cols": len(flat) // rows, "data": flat}


def _encode_ros(record: CameraRecord) -> str:
    fx, fy, cx, cy = record.values[:4]
    K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    document = {
        "image_width": record.size[0],
        "image_height": record.size[1],
        "camera_name": record.name,
        "camera_matrix": _ros_matrix(K, 3),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _ros_matrix(record.values[4:], 1),
        "rectification_matrix": _ros_matrix(np.eye(3), 3),
        "projection_matrix": _ros_matrix([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], 3),
    }
    return record.head() + yaml_text(document)


def _decode_ros(text: str) -> CameraRecord:
    document = yaml_document(text)
    if not isinstance(document, dict):
        raise ConfigurationError("no camera_info: the file holds no keys")
    model = document.get("distortion_model")
    if model not in _ROS_COUNTS:
        raise ConfigurationError(
            f"distortion_model {model!r}: plumb_bob and rational_polynomial can be read"
        )
    data = {}
    for key in ("camera_matrix", "distortion_coefficients"):
        node = document.get(key)
        data[key] = node.get("data") if isinstance(node, dict) else None
    K = numbers(data["camera_matrix"], "camera_matrix.data", (9,))
    d = numbers(
        data["distortion_coefficients"], "distortion_coefficients.data", (_ROS_COUNTS[model],)
    )
    values = np.concatenate([K[[0, 4, 2, 5]], d])
    name = str(document.get("camera_name", "camera"))
    return CameraRecord(_size(document), opencv(len(d)), values, name)


ROS = Format(
    "ros", ".yaml", "ROS camera_info", lambda _: opencv(5), _encode_ros, _decode_ros,
    lambda text: "distortion_model:" in text and "image_width:" in text,
)  # fmt: skip


def _encode_kalibr(record: CameraRecord) -> str:
    values = record.values.tolist()
    document = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": values[:4],
            "distortion_model": "radtan",
            "distortion_coeffs": values[4:],
            "resolution": list(record.size),
            "rostopic": f"/{record.name}/image_raw",
        }
    }
    return record.head() + yaml_text(document)


def _decode_kalibr(text: str) -> CameraRecord:
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
    return CameraRecord((int(size[0]), int(size[1])), opencv(len(d)), np.concatenate([f, d]))


KALIBR = Format(
    "kalibr", ".yaml", "Kalibr camchain", lambda _: opencv(4), _encode_kalibr, _decode_kalibr,
    lambda text: "cam0:" in text and "camera_model" in text,
)  # fmt: skip


_MRCAL_COUNTS = {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)} | {"LENSMODEL_PINHOLE": 0}


def _four_or_five(model: CameraModel) -> Family:
    """Without k3 where there is no such term."""
    return opencv(4 if model.interior.A3 == 0 else 5)


def _encode_mrcal(record: CameraRecord) -> str:
    values = ", ".join(map(repr, record.values.tolist()))
    width, height = record.size
    return record.head() + (
        "{\n"
        f"    'lensmodel':  'LENSMODEL_OPENCV{len(record.values) - 4}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': [ {values},],\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],\n\n"
        f"    'imagersize': [ {width}, {height},],\n"
        "}\n"
    )


def _decode_mrcal(text: str) -> CameraRecord:
    try:
        document = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        raise ConfigurationError("no .cameramodel: not a dictionary in Python's notation") from None
    if not isinstance(document, dict):
        raise ConfigurationError("no .cameramodel: not a dictionary")
    lens = document.get("lensmodel")
    if lens not in _MRCAL_COUNTS:
        raise ConfigurationError(
            f"lensmodel {lens!r}: {', '.join(sorted(_MRCAL_COUNTS))} can be read"
        )
    count = _MRCAL_COUNTS[lens]
    values = numbers(document.get("intrinsics"), "intrinsics", (4 + count,))
    size = numbers(document.get("imagersize"), "imagersize", (2,))
    return CameraRecord((int(size[0]), int(size[1])), opencv(count), values)


MRCAL = Format(
    "mrcal", ".cameramodel", "mrcal cameramodel", _four_or_five, _encode_mrcal, _decode_mrcal,
    lambda text: "lensmodel" in text and "imagersize" in text,
)  # fmt: skip


# Where each model's parameters stand in fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6.
_COLMAP_SLOTS: dict[str, tuple[tuple[int, ...], ...]] = {
    "SIMPLE_PINHOLE": ((0, 1), (2,), (3,)),
    "PINHOLE": ((0,), (1,), (2,), (3,)),
    "SIMPLE_RADIAL": ((0, 1), (2,), (3,), (4,)),
    "RADIAL": ((0, 1), (2,), (3,), (4,), (5,)),
    "OPENCV": tuple((i,) for i in range(8)),
    "FULL_OPENCV": tuple((i,) for i in range(12)),
}
_COLMAP_CENTRE = 0.5


def _encode_colmap(record: CameraRecord) -> str:
    model = "OPENCV" if len(record.values) == 8 else "FULL_OPENCV"
    values = np.zeros(len(_COLMAP_SLOTS[model]))
    values[: len(record.values)] = record.values
    values[2:4] += _COLMAP_CENTRE
    fields = ["1", model, *map(repr, record.size), *map(repr, values.tolist())]
    head = record.head() + "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return head + " ".join(fields) + "\n"


def _colmap_cameras(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]


def _decode_colmap(text: str) -> CameraRecord:
    cameras = _colmap_cameras(text)
    if len(cameras) != 1:
        raise ConfigurationError(
            f"the file holds {len(cameras)} cameras: leave the line of the one that is wanted"
        )
    fields = cameras[0]
    if len(fields) < 5 or fields[1] not in _COLMAP_SLOTS:
        shown = fields[1] if len(fields) > 1 else ""
        raise ConfigurationError(f"camera model {shown!r}: {', '.join(_COLMAP_SLOTS)} can be read")
    slots = _COLMAP_SLOTS[fields[1]]
    given = [number(f, f"parameter {i + 1}") for i, f in enumerate(fields[4:])]
    if len(given) != len(slots):
        raise ConfigurationError(f"{fields[1]} has {len(slots)} parameters, not {len(given)}")
    values = np.zeros(12)
    for where, value in zip(slots, given, strict=True):
        values[list(where)] = value
    values[2:4] -= _COLMAP_CENTRE
    size = int(number(fields[2], "WIDTH")), int(number(fields[3], "HEIGHT"))
    return CameraRecord(size, opencv(8), values)


COLMAP = Format(
    "colmap", ".txt", "COLMAP cameras.txt", _four_or_five, _encode_colmap, _decode_colmap,
    lambda text: any(len(f) > 4 and f[1].isupper() for f in _colmap_cameras(text)[:1]),
)  # fmt: skip
