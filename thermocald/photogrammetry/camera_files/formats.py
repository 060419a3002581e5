"""Camera files of OpenCV, ROS, Kalibr, mrcal, COLMAP, AICON, and Agisoft Metashape.

OpenCV: YAML (read also: XML, JSON) as cv2.FileStorage and `calibration` in OpenCV's samples, with
camera_matrix (3, 3), distortion_coefficients (1, 4 … 12) in OpenCV's order, image_width,
image_height. A covariance goes into nodes of our own, which OpenCV's readers ignore:
intrinsics_covariance in the order fx fy cx cy k1 k2 p1 p2 k3, and std_deviation_intrinsics.

ROS: camera_info YAML as camera_calibration_parsers reads it, plumb_bob or rational_polynomial.

Kalibr: camchain YAML, pinhole with radtan, which has no radial term of sixth order.

mrcal: .cameramodel, a Python dictionary literal; LENSMODEL_OPENCV4 or 5, pixel centres at 0.

COLMAP: cameras.txt, `CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]`, pixel centres at 0.5. We write
FULL_OPENCV, or OPENCV if k3 is zero; we read these and the simpler models.

AICON: .ior with photogrammetric terms in mm, the radial ones balanced by R0. We write the record
that TU Dresden's FlowVeloTool (github.com/AnetteEltner/FlowVeloTool, photogrammetry_functions.py)
reads as an AICON .ior; it is the only public reader. The record is one line of numbers separated by
single blanks,

    camera type Ck Xh Yh A1 A2 R0 A3 B1 B2 C1 C2 width height columns rows

with Ck < 0, in mm; FlowVeloTool ignores the first two. If R0 ≠ 0, it maps ideal points (x̂, ŷ) of
principal distance -Ck to x' = Xh + (1 + C1)(x̂ + Δx) + C2 (ŷ + Δy), y' = Yh + ŷ + Δy, which is exact
without affinity and shear. If R0 = 0, it takes the terms as numbers without unit: we never write
that, and refuse to read it. Comments follow the record, where FlowVeloTool does not read.

We read this record, and `name value [sd]` on each line, as people type calibration sheets; there
the terms are those of the measured point (Luhmann et al. 2014, section 3.3.2).

Metashape: XML of a camera calibration with the frame projection. An XML of exported cameras with
one sensor is read too, with its covariance.
"""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.files import parse_yaml
from thermocald.photogrammetry.camera.conversions import METASHAPE as METASHAPE_FRAME
from thermocald.photogrammetry.camera.conversions import Family, aicon, measured_point, opencv
from thermocald.photogrammetry.camera_files.camera_record import (
    ITS_YAML,
    CameraRecord,
    Format,
    among,
    number,
    numbers,
    yaml_text,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import CameraModel


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


def _decode_opencv(text: str) -> CameraRecord:
    # not with cv2.FileStorage, which crashes the process if a file is damaged (OpenCV 5.0.0)
    if text.startswith("<"):
        nodes = _require_unique(_xml_root(text))
        document = {n.tag: n.findtext("data", "").split() or n.text for n in nodes}
    else:  # JSON is YAML; nd: OpenCV 5
        document = parse_yaml(re.sub("^%YAML.*|!!opencv-(nd-)?matrix", "", text), ITS_YAML)
    return _of_matrices(document, (0, 4, 5, 8, 12, 14))


def _of_matrices(document: dict[Any, Any], counts: tuple[int, ...]) -> CameraRecord:
    """Read a camera from OpenCV's matrices; counts: possible numbers of distortion coefficients."""

    def matrix(key: str, counts: tuple[int, ...]) -> Array:
        node = document.get(key, {"data": []})
        if not isinstance(node, dict):
            return numbers(node, key, counts)
        found = numbers(node.get("data"), key, counts)
        if "rows" in node and "cols" in node:  # a decimal comma makes two numbers of one
            rows, cols = (number(node[side], f"{key}.{side}") for side in ("rows", "cols"))
            if rows * cols != len(found):
                raise ConfigurationError(
                    f"{key} has {len(found)} numbers, not {rows:g} × {cols:g}: is a comma wrong?"
                )
        return found

    K, d = matrix("camera_matrix", (9,)), matrix("distortion_coefficients", counts)
    if np.any(d[12:]):
        raise ConfigurationError("a tilted sensor (tau) has no counterpart in this model")
    if np.any(K[[1, 3, 6, 7, 8]] != (0, 0, 0, 0, 1)):  # MATLAB's is transposed
        raise ConfigurationError(
            "camera_matrix is not fx 0 cx, 0 fy cy, 0 0 1, row by row: OpenCV itself ignores a skew"
        )
    values = np.concatenate([K[[0, 4, 2, 5]], d[:12]])
    covariance = None
    if "intrinsics_covariance" in document:
        n = len(values)
        covariance = matrix("intrinsics_covariance", (n * n,)).reshape(n, n)
    size = [number(document.get(key), key) for key in ("image_width", "image_height")]
    name = str(document.get("camera_name", "camera"))
    return CameraRecord(size, opencv(len(values) - 4), values, name, covariance)


OPENCV = Format(
    "opencv", ".yaml", "OpenCV FileStorage", lambda _: opencv(5),
    _encode_opencv, _decode_opencv,
    lambda text: "camera_matrix" in text
    and (text.startswith("%YAML") or "opencv_storage" in text or '"opencv-matrix"' in text),
)  # fmt: skip


_ROS_COUNTS = {"plumb_bob": 5, "rational_polynomial": 8}


def _xml_root(text: str) -> ET.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigurationError("a DOCTYPE and entities are not read: delete them")
    try:
        return ET.fromstring(text)
    except ET.ParseError as cause:
        raise ConfigurationError(f"not valid XML: {cause}") from None


def _require_unique(element: ET.Element) -> ET.Element:
    """Return an element of XML. Raises ConfigurationError if one of its tags is duplicated."""
    tags = [child.tag for child in element]
    if twice := [tag for tag in tags if tags.count(tag) > 1]:
        raise ConfigurationError(f"<{twice[0]}> is duplicated")
    return element


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
    document = parse_yaml(text, ITS_YAML)
    count = among(_ROS_COUNTS, document.get("distortion_model"), "distortion_model")
    return _of_matrices(document, (count,))


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
    document = parse_yaml(text, ITS_YAML)
    camera = document.get("cam0")
    if not isinstance(camera, dict):
        raise ConfigurationError("not a camchain: cam0 is missing")
    if "cam1" in document:
        raise ConfigurationError("the camchain has several cameras: delete all but one")
    kinds = camera.get("camera_model"), camera.get("distortion_model")
    if kinds[0] != "pinhole" or kinds[1] not in ("radtan", "none", None):
        raise ConfigurationError(
            f"camera_model {kinds[0]!r} with distortion_model {kinds[1]!r}: only pinhole "
            "with radtan can be read"
        )
    f = numbers(camera.get("intrinsics"), "intrinsics", (4,))
    d = numbers(camera.get("distortion_coeffs") or [], "distortion_coeffs", (0, 4))
    size = numbers(camera.get("resolution"), "resolution", (2,))
    return CameraRecord(size, opencv(len(d)), np.concatenate([f, d]))


KALIBR = Format(
    "kalibr", ".yaml", "Kalibr camchain", lambda _: opencv(4), _encode_kalibr, _decode_kalibr,
    lambda text: "cam0:" in text and "camera_model" in text,
)  # fmt: skip


_MRCAL_COUNTS = {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)} | {"LENSMODEL_PINHOLE": 0}


def _four_or_five(model: CameraModel) -> Family:
    """Return OpenCV's family with four coefficients, or with five if k3 is not zero."""
    return opencv(4 if model.interior.A3 == 0 else 5)


def _encode_mrcal(record: CameraRecord) -> str:
    values = ", ".join(map(repr, record.values.tolist()))
    width, height = record.size
    return f"""{record.head()}{{
    'lensmodel':  'LENSMODEL_OPENCV{len(record.values) - 4}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ {values},],

    # extrinsics are rt_fromref
    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],

    'imagersize': [ {width}, {height},],
}}
"""


def _decode_mrcal(text: str) -> CameraRecord:
    try:
        tree = ast.parse(text.strip(), mode="eval")
        document = ast.literal_eval(tree)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        raise ConfigurationError("not a dictionary in Python's notation") from None
    if not isinstance(tree.body, ast.Dict):
        raise ConfigurationError("not a dictionary")
    if len(document) < len(tree.body.keys):
        raise ConfigurationError("a key is duplicated")
    count = among(_MRCAL_COUNTS, document.get("lensmodel"), "lensmodel")
    values = numbers(document.get("intrinsics"), "intrinsics", (4 + count,))
    size = numbers(document.get("imagersize"), "imagersize", (2,))
    return CameraRecord(size, opencv(count), values)


MRCAL = Format(
    "mrcal", ".cameramodel", "mrcal cameramodel", _four_or_five, _encode_mrcal, _decode_mrcal,
    lambda text: "lensmodel" in text and "imagersize" in text,
)  # fmt: skip


# places of each model's parameters in fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6
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
        raise ConfigurationError(f"the file has {len(cameras)} cameras: keep the line of one")
    fields = cameras[0]
    slots = among(_COLMAP_SLOTS, fields[1] if len(fields) > 4 else "", "camera model")
    given = [number(f, f"parameter {i}") for i, f in enumerate(fields[4:], 1)]
    if len(given) != len(slots):
        raise ConfigurationError(f"{fields[1]} has {len(slots)} parameters, not {len(given)}")
    values = np.zeros(12)
    for where, value in zip(slots, given, strict=True):
        values[list(where)] = value
    values[2:4] -= _COLMAP_CENTRE
    size = number(fields[2], "WIDTH"), number(fields[3], "HEIGHT")
    return CameraRecord(size, opencv(8), values)


COLMAP = Format(
    "colmap", ".txt", "COLMAP cameras.txt", _four_or_five, _encode_colmap, _decode_colmap,
    lambda text: any(len(f) > 4 and f[1].isupper() for f in _colmap_cameras(text)[:1]),
)  # fmt: skip


# in the order of our ten: c x0 y0 A1 A2 A3 B1 B2 C1 C2
_AICON_NAMES = ("Ck", "Xh", "Yh", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
_AICON_LINES = ("Ck", "Xh", "Yh", "A1", "A2", "R0", "A3", "B1", "B2", "C1", "C2")
_AICON_SIZES = ("sensor_width_mm", "sensor_height_mm", "pixels_x", "pixels_y")
_AICON_FIELDS = ("camera", "type", *_AICON_LINES, *_AICON_SIZES)
_SQUARE = 0.02  # relative difference of a pixel's sides, as the sensor's are often rounded
_TAGS = METASHAPE_FRAME.parameters


def _usual_r0(size: Sequence[float] | Array, pitch: float) -> float:
    """Return the usual R0, mm: two thirds of the way from the centre to a corner."""
    half_diagonal = 0.5 * float(np.hypot(*size)) * pitch
    return float(f"{2 / 3 * half_diagonal:.4g}")


def _encode_aicon(record: CameraRecord) -> str:
    assert record.pixel_pitch is not None
    values = dict(zip(_AICON_NAMES, record.values.tolist(), strict=True))
    values |= {"Ck": -values["Ck"], "R0": _usual_r0(record.size, record.pixel_pitch)}
    extent = [side * record.pixel_pitch for side in record.size]
    numbers = [*(values[n] for n in _AICON_LINES), *extent, *record.size]
    lines = [" ".join(["1", "1", *map(repr, numbers)]) + " "]
    lines += [f"# fields: {' '.join(_AICON_FIELDS)}", f"# name: {' '.join(record.name.split())}"]
    if record.covariance is not None:
        sds = np.sqrt(np.diag(record.covariance)).tolist()
        lines += [f"# sd {n} {sd!r}" for n, sd in zip(_AICON_NAMES, sds, strict=True)]
    return "\n".join(lines) + "\n" + record.head()


def _decode_aicon(text: str) -> CameraRecord:
    record = _aicon_record(text)
    if record is None:
        found, spread, name = _read_sheet(text)
    else:  # the standard deviations and the name are in comments that we write
        found, spread, name = record, {}, "camera"
        for words in map(str.split, text.splitlines()):
            if words[:2] == ["#", "name:"]:
                name = " ".join(words[2:]) or name
            if words[:2] == ["#", "sd"] and len(words) == 4:
                spread[words[2]] = number(words[3], f"standard deviation of {words[2]}")
    r0 = number(found.get("R0", 0.0), "R0")
    values = np.array([number(found.get(key, 0.0), key) for key in _AICON_NAMES])
    if record is not None and r0 == 0 and values[3:8].any():
        raise ConfigurationError(
            "R0 is 0: programs differ in the unit of the terms then; write one name and value per "
            "line instead"
        )
    values[0] = abs(values[0])
    width, height, *pixels = [number(found[key], key) for key in _AICON_SIZES]
    if not 0 <= r0 < 1000:
        raise ConfigurationError(f"R0 is {r0:g} mm: it must be a radius in the image, 0 to 1000 mm")
    if not all(1 <= side < 1e6 for side in pixels):
        raise ConfigurationError(f"{pixels[0]:g} columns, {pixels[1]:g} rows are impossible")
    pitch = width / pixels[0]
    if not np.isclose(height / pixels[1], pitch, rtol=_SQUARE):
        raise ConfigurationError(
            f"a sensor of {width:g} × {height:g} mm with {pixels[0]:g} × {pixels[1]:g} pixels does "
            "not have square ones: are width and height exchanged?"
        )
    covariance = np.diag([spread.get(key, 0.0) ** 2 for key in _AICON_NAMES]) if spread else None
    family = measured_point(r0) if record is None else aicon(r0)
    return CameraRecord(pixels, family, values, name, covariance, pitch)


def _aicon_record(text: str) -> dict[str, str] | None:
    """Return the values of a record; None if the text is not a record."""
    words = [w for line in text.splitlines() for w in line.split("#")[0].split()]
    try:
        found = dict(zip(_AICON_FIELDS, words, strict=True))
        return found if [float(w) for w in words][2] < 0 else None
    except ValueError:
        return None


def _read_sheet(text: str) -> tuple[dict[str, str], dict[str, float], str]:
    """Return values, standard deviations, and name from lines `name value [sd]`."""
    found: dict[str, str] = {}
    spread: dict[str, float] = {}
    name = "camera"
    for i, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        key, rest = words[0], words[1:]
        if key == "camera":
            name = " ".join(rest)
        elif key not in (*_AICON_LINES, *_AICON_SIZES):
            raise ConfigurationError(
                f"line {i}: {key!r} is none of {', '.join(_AICON_LINES + _AICON_SIZES)}"
            )
        elif key in found:
            raise ConfigurationError(f"line {i}: {key} is duplicated")
        elif not rest:
            raise ConfigurationError(f"line {i}: {key} has no value")
        else:
            found[key] = rest[0]
            if len(rest) > 1:
                spread[key] = number(rest[1], f"line {i}: standard deviation of {key}")
    missing = [key for key in ("Ck", *_AICON_SIZES) if key not in found]
    if missing:
        raise ConfigurationError(f"missing: {', '.join(missing)}")
    return found, spread, name


AICON = Format(
    "aicon", ".ior", "AICON interior orientation",
    lambda m: aicon(_usual_r0((m.sensor.width, m.sensor.height), m.sensor.pixel_pitch)),
    _encode_aicon, _decode_aicon,
    lambda text: _aicon_record(text) is not None
    or any(line.split()[:1] == ["Ck"] for line in text.splitlines()),
)  # fmt: skip


def _encode_metashape(record: CameraRecord) -> str:
    # a comment must not hold a double hyphen
    words = escape(record.head("  ")).replace("--", "- -")
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<!--\n{words}-->",
        "<calibration>",
        "  <projection>frame</projection>",
        f"  <width>{record.size[0]}</width>",
        f"  <height>{record.size[1]}</height>",
        *(
            f"  <{tag}>{value!r}</{tag}>"
            for tag, value in zip(_TAGS, record.values.tolist(), strict=True)
        ),
        "</calibration>",
    ]
    return "\n".join(lines) + "\n"


def _decode_metashape(text: str) -> CameraRecord:
    root = _xml_root(text)
    found = [root] if root.tag == "calibration" else root.findall(".//sensor/calibration")
    found = [c for c in found if c.get("class") != "initial"]
    if len(found) != 1:
        raise ConfigurationError(
            f"the file has {len(found)} calibrations instead of one: export it with Tools, Camera "
            "Calibration, save as XML"
        )
    calibration = found[0]
    projection = calibration.findtext("projection") or calibration.get("type") or "frame"
    if projection != "frame":
        raise ConfigurationError(f"projection {projection!r}: only frame cameras can be read")
    resolution = calibration.find("resolution")
    size = [
        calibration.findtext(side) if resolution is None else resolution.get(side)
        for side in ("width", "height")
    ]
    values = np.array([number(calibration.findtext(tag, "0"), f"<{tag}>") for tag in _TAGS])
    for tag, given in ((child.tag, child.text) for child in _require_unique(calibration)):
        if tag not in ("projection", "resolution", "width", "height", "date", *_TAGS) and (
            number(given or 0, f"<{tag}>") != 0  # p3, p4, PhotoScan's skew
        ):
            raise ConfigurationError(f"<{tag}> cannot be read: only {', '.join(_TAGS)} can")
    pixels = number(size[0], "width"), number(size[1], "height")
    covariance = None
    names = root.findtext(".//sensor/covariance/params", "").split()
    if n := len(names):
        stated = root.findtext(".//sensor/covariance/coeffs", "").split()
        rows = [_TAGS.index(name) for name in names if name in _TAGS]
        C = numbers(stated, "covariance", (n * n,)).reshape(n, n)
        if len(rows) != n:
            raise ConfigurationError(
                "the covariance names parameters that this model does not have"
            )
        covariance = np.zeros((len(_TAGS),) * 2)  # zero for parameters held fixed
        covariance[np.ix_(rows, rows)] = C
    return CameraRecord(pixels, METASHAPE_FRAME, values, covariance=covariance)


METASHAPE = Format(
    "metashape", ".xml", "Agisoft Metashape calibration XML", lambda _: METASHAPE_FRAME,
    _encode_metashape, _decode_metashape,
    lambda text: re.search(r"<calibration[\s>/]", text) is not None,
)  # fmt: skip
