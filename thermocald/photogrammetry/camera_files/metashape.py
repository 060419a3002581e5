"""Agisoft Metashape's camera calibration XML, frame projection.

Also read: a document of exported cameras with one sensor, its covariance included.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from xml.sax.saxutils import escape

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.conversions import Metashape, to_family
from thermocald.photogrammetry.camera_files.camera_record import (
    ForeignCamera,
    Format,
    Record,
    header,
)
from thermocald.photogrammetry.camera_files.file_text import number, numbers

_FAMILY = Metashape()


def _encode(record: Record) -> tuple[str, str]:
    result = to_family(record.model, _FAMILY)
    sensor = record.model.sensor
    # a comment must not hold a double hyphen
    words = escape(header(record, result.statement, "  ")).replace("--", "- -")
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<!--\n{words}-->",
        "<calibration>",
        "  <projection>frame</projection>",
        f"  <width>{sensor.width}</width>",
        f"  <height>{sensor.height}</height>",
        *(
            f"  <{tag}>{float(value)!r}</{tag}>"
            for tag, value in zip(_FAMILY.parameters, result.values, strict=True)
        ),
        "</calibration>",
    ]
    return "\n".join(lines) + "\n", result.statement


def _decode(text: str) -> ForeignCamera:
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
    values = np.array(
        [number(calibration.findtext(tag, "0"), f"<{tag}>") for tag in _FAMILY.parameters]
    )
    for tag in ("p3", "p4"):
        if number(calibration.findtext(tag, "0"), f"<{tag}>") != 0:
            raise ConfigurationError(f"<{tag}> has no counterpart in this model")
    return ForeignCamera(
        (int(number(size[0], "width")), int(number(size[1], "height"))),
        _FAMILY, values, covariance=_covariance(root),
    )  # fmt: skip


def _covariance(root: ET.Element) -> np.ndarray[tuple[int, int], np.dtype[np.float64]] | None:
    """The covariance of a sensor in the order of the family, zero for what was held."""
    node = root.find(".//sensor/covariance")
    if node is None:
        return None
    names = (node.findtext("params") or "").split()
    n = len(names)
    C = numbers((node.findtext("coeffs") or "").split(), "covariance", (n * n,)).reshape(n, n)
    full = np.zeros((len(_FAMILY.parameters),) * 2)
    rows = [_FAMILY.parameters.index(name) for name in names if name in _FAMILY.parameters]
    if len(rows) != n:
        raise ConfigurationError("the covariance names parameters that this model does not have")
    full[np.ix_(rows, rows)] = C
    return full


FORMAT = Format(
    "metashape", ".xml", "Agisoft Metashape calibration XML", _encode, _decode,
    lambda text: "<calibration" in text,
)  # fmt: skip
