"""The YAML file of a thermal model: readable by hand, every number with its unit.

format: thermocald-model/1
name: my camera
version: 2                                   # goes up with every change
camera: {name: rpi-v2.1, width: 3280, height: 2464, pixel_pitch: 0.00112}     # px, px, mm
reference_temperature: {value: 25.0, unit: degC}                              # T₀
interior:                                    # at T₀
c: {value: 3.04, sd: 0.0002, unit: mm}
rates:                                       # the base model
x0: {value: -0.0004, sd: 2.0e-06, unit: mm/K}
effects:                                     # names and parameters of the catalogue
- effect: thermal_lag
parameters: {tau: {value: 84.0, sd: 1.9, unit: s}}
exterior: {X0: {value: 600.0, unit: mm}, …}  # optional: the set-up
image_sigma: {value: 0.04, unit: px}
validity: {temperature: [21.0, 52.0]}        # °C it was fitted on
fitted_on: […]
covariance: {parameters: [interior.c, …], matrix: [[…], …]}                   # optional
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.atomic_file import write_text
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.simulation.effect_file import effect_document, effect_of
from thermocald.simulation.effects.parameter import PARAMETER_UNITS
from thermocald.simulation.model import RATED, ThermalModel
from thermocald.simulation.quantities import QuantityReader, written
from thermocald.yaml_file import dump_yaml, read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = [
    "MODEL_FORMAT",
    "model_document",
    "parse_model",
    "read_model",
    "read_sensor",
    "write_model",
]

MODEL_FORMAT = "thermocald-model/1"
_KEYS = (
    "format", "name", "version", "camera", "reference_temperature", "interior", "rates", "effects",
    "exterior", "image_sigma", "validity", "fitted_on", "evidence", "covariance",
)  # fmt: skip


def read_model(path: Path) -> ThermalModel:
    """Read a model file; ConfigurationError names file and key."""
    return parse_model(read_yaml(path), path)


def write_model(path: Path, model: ThermalModel) -> None:
    """Write a model file, as a whole or not at all."""
    write_text(path, dump_yaml(model_document(model)))


def parse_model(document: Mapping[str, Any], path: Path | str = "model") -> ThermalModel:
    """The model in a file's mapping; `path` is for the messages."""
    top = QuantityReader(path, document)
    found = top.text("format")
    if found != MODEL_FORMAT:
        raise top.fail("format", f"is {found[:60]!r}; this program reads {MODEL_FORMAT!r}")
    top.only(_KEYS)
    camera = top.inner("camera")
    sds: dict[str, float] = {}

    def group(key: str, names: tuple[str, ...], per: str = "") -> dict[str, float]:
        if document.get(key) is None:
            return {}
        reader = top.inner(key)
        reader.only(names)
        values = {}
        for name in reader.mapping:
            quantity = reader.quantity(name, PARAMETER_UNITS[name] + per)
            values[name] = quantity.value
            if quantity.sd is not None:
                sds[f"{key}.{name}"] = quantity.sd
        return values

    interior = group("interior", IOP_NAMES)
    if not interior.get("c", 0.0) > 0:
        raise top.fail("interior.c", "is missing or not above 0 mm")
    exterior = group("exterior", EOP_NAMES)
    rates = group("rates", RATED, "/K")
    names, matrix = _covariance(top, document)
    return ThermalModel(
        camera=camera.text("name", "camera"),
        sensor=read_sensor(camera),
        T0=top.number("reference_temperature", "degC", low=-273.15),
        interior=InteriorOrientation.from_mapping({"c": 0.0, **interior}),
        rates=rates,
        effects=tuple(effect_of(reader) for reader in top.items("effects")),
        exterior=_exterior(top, exterior),
        image_sigma=top.number("image_sigma", "px", 0.04, above=0.0),
        sds=sds,
        covariance_names=names,
        covariance=matrix,
        validity=_validity(top, document),
        fitted_on=tuple(document.get("fitted_on") or ()),
        evidence=dict(document.get("evidence") or {}),
        name=top.text("name", ""),
        version=top.whole("version", "1") if "version" in document else 1,
    )


def read_sensor(camera: QuantityReader) -> Sensor:
    """Width and height in px, pixel pitch in mm."""
    pitch = camera.number("pixel_pitch", "mm", above=0.0)
    if pitch > 0.1:
        raise camera.fail("pixel_pitch", f"is {pitch:g} mm; pixels are a few thousandths of a mm")
    return Sensor(camera.whole("width", "px"), camera.whole("height", "px"), pitch)


def _exterior(top: QuantityReader, values: dict[str, float]) -> ExteriorOrientation | None:
    if not values:
        return None
    missing = [name for name in EOP_NAMES if name not in values]
    if missing:
        raise top.fail(f"exterior.{missing[0]}", "is missing")
    return ExteriorOrientation.from_mapping(values)


def _covariance(
    top: QuantityReader, document: Mapping[str, Any]
) -> tuple[tuple[str, ...], tuple[tuple[float, ...], ...] | None]:
    if document.get("covariance") is None:
        return (), None
    reader = top.inner("covariance")
    names = tuple(str(n) for n in reader.mapping.get("parameters") or ())
    try:
        matrix = np.array(reader.mapping.get("matrix"), dtype=float)
    except (TypeError, ValueError) as cause:
        raise reader.fail("matrix", "must hold rows of numbers") from cause
    if matrix.shape != (len(names), len(names)) or not np.isfinite(matrix).all():
        raise reader.fail("matrix", f"must be {len(names)} × {len(names)} finite numbers")
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0):
        raise reader.fail("matrix", "is not symmetric")
    return names, tuple(tuple(float(v) for v in row) for row in matrix)


def _validity(top: QuantityReader, document: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    ranges: dict[str, tuple[float, float]] = {}
    if document.get("validity") is None:
        return ranges
    reader = top.inner("validity")
    for channel, pair in reader.mapping.items():
        if not isinstance(pair, list) or len(pair) != 2:
            raise reader.fail(str(channel), "must be [lowest, highest] degC")
        low, high = (reader._float(str(channel), v) for v in pair)
        if low > high:
            raise reader.fail(str(channel), f"begins at {low:g} and ends at {high:g} degC")
        ranges[str(channel)] = (low, high)
    return ranges


def model_document(model: ThermalModel) -> dict[str, Any]:
    """The mapping that a model file holds."""
    interior = model.interior.as_array()
    document: dict[str, Any] = {
        "format": MODEL_FORMAT,
        "name": model.name or model.camera,
        "version": model.version,
        "camera": {
            "name": model.camera,
            "width": model.sensor.width,
            "height": model.sensor.height,
            "pixel_pitch": model.sensor.pixel_pitch,
        },
        "reference_temperature": written(model.T0, "degC"),
        "interior": {
            n: written(v, PARAMETER_UNITS[n], model.sds.get(f"interior.{n}"))
            for n, v in zip(IOP_NAMES, interior, strict=True)
        },
        "rates": {
            n: written(model.rates[n], f"{PARAMETER_UNITS[n]}/K", model.sds.get(f"rates.{n}"))
            for n in RATED
            if n in model.rates
        },
        "effects": [effect_document(effect) for effect in model.effects],
    }
    if model.exterior is not None:
        document["exterior"] = {
            n: written(v, PARAMETER_UNITS[n], model.sds.get(f"exterior.{n}"))
            for n, v in zip(EOP_NAMES, model.exterior.as_array(), strict=True)
        }
    document["image_sigma"] = written(model.image_sigma, "px")
    if model.validity:
        document["validity"] = {k: [float(a), float(b)] for k, (a, b) in model.validity.items()}
    if model.fitted_on:
        document["fitted_on"] = [dict(f) for f in model.fitted_on]
    if model.evidence:
        document["evidence"] = dict(model.evidence)
    if model.covariance is not None:
        document["covariance"] = {
            "parameters": list(model.covariance_names),
            "matrix": [list(row) for row in model.covariance],
        }
    return document
