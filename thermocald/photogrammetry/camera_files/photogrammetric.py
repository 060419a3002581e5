"""Files of photogrammetric programs: AICON and Agisoft Metashape.

AICON's .ior holds photogrammetric terms in mm, radial ones balanced by R0.

Written is the record that TU Dresden's FlowVeloTool (github.com/AnetteEltner/FlowVeloTool,
photogrammetry_functions.py) reads as an AICON .ior, the one public reader there is: one line of
numbers between single blanks,

    camera type Ck Xh Yh A1 A2 R0 A3 B1 B2 C1 C2 width height columns rows

with Ck < 0 and mm; the first two are skipped by it. With R0 ≠ 0 it has, ideal points (x̂, ŷ) of
principal distance -Ck, x' = Xh + (1 + C1)(x̂ + Δx) + C2 (ŷ + Δy), y' = Yh + ŷ + Δy: exact without
affinity and shear. (With R0 = 0 it takes the terms as numbers without unit: never written here,
and refused.) Comments follow the record, where its reader does not look.

Read are both this record and `name value [sd]` per line, as calibration sheets are typed over;
there the terms are those of the measured point (Luhmann et al. 2014, section 3.3.2).

Metashape's camera calibration is XML with the frame projection; a document of exported cameras with
one sensor is read too, its covariance included.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import METASHAPE as METASHAPE_FRAME
from thermocald.photogrammetry.camera.conversions import Family, aicon, measured_point
from thermocald.photogrammetry.camera_files.camera_record import (
    CameraRecord,
    Format,
    number,
    numbers,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import CameraModel

# In the order of our ten: c x0 y0 A1 A2 A3 B1 B2 C1 C2.
_AICON_NAMES = ("Ck", "Xh", "Yh", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
_AICON_LINES = ("Ck", "Xh", "Yh", "A1", "A2", "R0", "A3", "B1", "B2", "C1", "C2")
_AICON_SIZES = ("sensor_width_mm", "sensor_height_mm", "pixels_x", "pixels_y")
_AICON_FIELDS = ("camera", "type", *_AICON_LINES, *_AICON_SIZES)
_TAGS = METASHAPE_FRAME.parameters


def _aicon_family(model: CameraModel) -> Family:
    """The radial correction vanishes at two thirds of the way to the corner, as is usual."""
    return aicon(_usual_r0((model.sensor.width, model.sensor.height), model.sensor.pixel_pitch))


def _usual_r0(size: tuple[int, int], pitch: float) -> float:
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
    fields = _aicon_record(text)
    if fields is None:
        return _typed(text)
    found = dict(zip(_AICON_FIELDS, fields, strict=True))
    spread, name = {}, "camera"
    for line in text.splitlines():
        words = line.split()
        if words[:2] == ["#", "name:"]:
            name = " ".join(words[2:]) or name
        if words[:2] == ["#", "sd"] and len(words) == 4:
            spread[words[2]] = number(words[3], f"standard deviation of {words[2]}")
    r0 = number(found["R0"], "R0")
    if r0 == 0 and any(number(found[n], n) for n in _AICON_NAMES[3:8]):
        raise ConfigurationError(
            "R0 is 0: programs differ in the unit of such terms; type the numbers over, one name "
            "and value per line"
        )
    return _aicon_record_of(found, spread, aicon(r0), name)


def _aicon_record(text: str) -> list[str] | None:
    """The fields of a record, or None where the text is none."""
    words = [w for line in text.splitlines() for w in line.split("#")[0].split()]
    if len(words) != len(_AICON_FIELDS):
        return None
    try:
        values = [float(w) for w in words]
    except ValueError:
        return None
    return words if values[2] < 0 else None


def _typed(text: str) -> CameraRecord:
    """One `name value [sd]` per line."""
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
        raise ConfigurationError(f"{', '.join(missing)} missing")
    r0 = number(found.get("R0", 0.0), "R0")
    return _aicon_record_of(found, spread, measured_point(r0), name)


def _aicon_record_of(
    found: dict[str, str], spread: dict[str, float], family: Family, name: str
) -> CameraRecord:
    values = np.array([number(found.get(key, 0.0), key) for key in _AICON_NAMES])
    values[0] = abs(values[0])
    sizes = [number(found[key], key) for key in _AICON_SIZES]
    r0 = number(found.get("R0", 0.0), "R0")
    if not 0 <= r0 < 1000:
        raise ConfigurationError(f"R0 is {r0:g} mm; it is a radius in the image")
    if not 1 <= sizes[2] < 1e6:
        raise ConfigurationError(f"{sizes[2]:g} columns of pixels are impossible")
    covariance = None
    if spread:
        covariance = np.diag([spread.get(key, 0.0) ** 2 for key in _AICON_NAMES])
    size = int(sizes[2]), int(sizes[3])
    return CameraRecord(size, family, values, name, covariance, sizes[0] / sizes[2])


def _is_aicon(text: str) -> bool:
    typed = any(line.split()[:1] == ["Ck"] for line in text.splitlines())
    return typed or _aicon_record(text) is not None


AICON = Format(
    "aicon",
    ".ior",
    "AICON interior orientation",
    _aicon_family,
    _encode_aicon,
    _decode_aicon,
    _is_aicon,
)


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
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigurationError("a calibration needs no DOCTYPE and no entities")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as cause:
        raise ConfigurationError(f"no valid XML: {cause}") from None
    found = [root] if root.tag == "calibration" else root.findall(".//sensor/calibration")
    found = [c for c in found if c.get("class") != "initial"]
    if len(found) != 1:
        raise ConfigurationError(
            f"the file holds {len(found)} calibrations: one is wanted (Tools, Camera Calibration, "
            "save as XML)"
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
    for tag in ("p3", "p4"):
        if number(calibration.findtext(tag, "0"), f"<{tag}>") != 0:
            raise ConfigurationError(f"<{tag}> has no counterpart in this model")
    width, height = int(number(size[0], "width")), int(number(size[1], "height"))
    covariance = _metashape_covariance(root)
    return CameraRecord((width, height), METASHAPE_FRAME, values, covariance=covariance)


def _metashape_covariance(root: ET.Element) -> Array | None:
    """The covariance of a sensor in the order of the family, zero for what was held."""
    node = root.find(".//sensor/covariance")
    if node is None:
        return None
    names = (node.findtext("params") or "").split()
    n = len(names)
    C = numbers((node.findtext("coeffs") or "").split(), "covariance", (n * n,)).reshape(n, n)
    full = np.zeros((len(_TAGS),) * 2)
    rows = [_TAGS.index(name) for name in names if name in _TAGS]
    if len(rows) != n:
        raise ConfigurationError("the covariance names parameters that this model does not have")
    full[np.ix_(rows, rows)] = C
    return full


METASHAPE = Format(
    "metashape", ".xml", "Agisoft Metashape calibration XML", lambda _: METASHAPE_FRAME,
    _encode_metashape, _decode_metashape,
    lambda text: "<calibration" in text,
)  # fmt: skip
