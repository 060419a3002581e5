"""The YAML file of a thermal model, in which every number has its unit; and files of effects.

The model file:

    format: thermocald-model/1
    name: my camera
    version: 2                                   # increases with every change
    camera: {name: rpi-v2.1, width: 3280, height: 2464, pixel_pitch: 0.00112}     # px, px, mm
    reference_temperature: {value: 25.0, unit: degC}                              # T₀
    interior:                                    # at T₀
      c: {value: 3.04, sd: 0.0002, unit: mm}
    distortion: angle                            # or image: what A and B follow while c changes
    rates:                                       # of the base model
      x0: {value: -0.0004, sd: 2.0e-06, unit: mm/K}
    effects:                                     # names and parameters of the catalogue
    - effect: thermal_lag
      parameters: {tau: {value: 84.0, sd: 1.9, unit: s}}
    exterior: {X0: {value: 600.0, unit: mm}, …}  # of the set-up; optional
    image_sigma: {value: 0.04, unit: px}
    validity: {temperature: [21.0, 52.0]}        # °C, of the data
    fitted_on: […]
    covariance: {parameters: [interior.c, …], matrix: [[…], …]}                   # optional

Effects are entries of a model file, or have a file of their own, such as a proposal:

    format: thermocald-effect/1
    statement: x0 follows ∫ (T − 30.2 °C)₊ dt    # for people
    effects:                                     # as in a model file
    - effect: integral(above(temperature, k))    # a name of the catalogue, or a formula
      parameters: {k: {value: 30.2, sd: 0.1, unit: degC}, x0: {value: 1.1e-06, unit: mm/(K s)}}

A formula is plain text that is parsed and never executed.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.files import QuantityReader, dump_yaml, read_yaml, write_quantity, write_text
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics import catalogue
from thermocald.physics.effect import PARAMETER_UNITS
from thermocald.physics.model import BASES, RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


EFFECT_FORMAT = "thermocald-effect/1"


def read_effects(path: Path) -> list[ModelEffect]:
    """Read the effects of an effect file; ConfigurationError names the file and the key."""
    top = QuantityReader(path, read_yaml(path))
    top.require_format(EFFECT_FORMAT, "an effect file is")
    top.only(("format", "statement", "effects", "evidence"))
    out = [effect_of(entry) for entry in top.items("effects")]
    if not out:
        raise top.fail("effects", "holds no effect")
    return out


def write_effects(
    path: Path, found: Sequence[ModelEffect], statement: str, evidence: Mapping[str, Any]
) -> None:
    """Write an effect file, completely or not at all."""
    document = {
        "format": EFFECT_FORMAT,
        "statement": statement,
        "effects": [effect_document(e) for e in found],
        "evidence": dict(evidence),
    }
    write_text(path, dump_yaml(document))


def effect_of(reader: QuantityReader) -> ModelEffect:
    """Read one entry of a list of effects; ConfigurationError names the file and the key."""
    reader.only(("effect", "parameters", "evidence"))
    name = reader.text("effect")
    try:
        effect = catalogue.get(name)
    except ConfigurationError as error:
        raise reader.fail("effect", str(error)) from error
    parameters = reader.inner("parameters")
    units = effect.units()
    parameters.only(units)
    values: dict[str, Any] = {}
    own: dict[str, float] = {}
    for key, raw in parameters.mapping.items():
        if key in effect.nonlinear and effect.nonlinear[key].text:
            plain = raw.get("value") if isinstance(raw, dict) else raw
            values[key] = tuple(plain) if isinstance(plain, list) else str(plain)
            continue
        values[key], sd = parameters.quantity(key, units[key])
        if sd is not None:
            own[key] = sd
    try:
        return ModelEffect(name, values, own)
    except ConfigurationError as error:
        raise reader.fail("parameters", str(error)) from error


def effect_document(effect: ModelEffect) -> dict[str, Any]:
    """Return an effect's mapping for a file."""
    units = catalogue.get(effect.name).units()
    parameters = {
        key: list(value) if isinstance(value, tuple | list)
        else value if isinstance(value, str)
        else write_quantity(value, units[key], effect.sds.get(key))
        for key, value in effect.values.items()
    }  # fmt: skip
    return {"effect": effect.name, "parameters": parameters}


MODEL_FORMAT = "thermocald-model/1"
_KEYS = (
    "format", "name", "version", "camera", "reference_temperature", "interior", "distortion",
    "rates", "effects", "exterior", "image_sigma", "validity", "fitted_on", "evidence",
    "covariance",
)  # fmt: skip


def write_model(path: Path, model: ThermalModel) -> None:
    """Write a model file, completely or not at all."""
    write_text(path, dump_yaml(model_document(model)))


def read_model(path: Path) -> ThermalModel:
    """Read a model file; ConfigurationError names the file and the key."""
    document = read_yaml(path)
    top = QuantityReader(path, document)
    top.require_format(MODEL_FORMAT)
    top.only(_KEYS)
    camera = top.inner("camera")
    sds: dict[str, float] = {}

    def group(key: str, names: tuple[str, ...], per: str = "") -> dict[str, float]:
        if document.get(key) is None:
            return {}
        reader = top.inner(key)
        reader.only(names)
        values: dict[str, float] = {}
        for name in reader.mapping:
            values[name], sd = reader.quantity(name, PARAMETER_UNITS[name] + per)
            if sd is not None:
                sds[f"{key}.{name}"] = sd
        return values

    interior = group("interior", IOP_NAMES)
    if not interior.get("c", 0.0) > 0:
        raise top.fail("interior.c", "is missing or not above 0 mm")
    exterior = group("exterior", EOP_NAMES)
    for name in EOP_NAMES:
        if exterior and name not in exterior:
            raise top.fail(f"exterior.{name}", "is missing")
    rates = group("rates", RATED, "/K")
    given = top.text("distortion", BASES[0])
    distortion = next((basis for basis in BASES if basis == given), None)
    if distortion is None:
        raise top.fail("distortion", f"is {given[:40]!r}; it must be {' or '.join(BASES)}")
    names, matrix = _read_covariance(top)
    return ThermalModel(
        camera=camera.text("name", "camera"),
        sensor=Sensor.read(camera),
        T0=top.number("reference_temperature", "degC", low=-273.15),
        interior=InteriorOrientation(**interior),
        rates=rates,
        effects=tuple(effect_of(reader) for reader in top.items("effects")),
        exterior=ExteriorOrientation(**exterior) if exterior else None,
        distortion=distortion,
        image_sigma=top.number("image_sigma", "px", 0.04, above=0.0),
        sds=sds,
        covariance_names=names,
        covariance=matrix,
        validity=_read_validity(top),
        fitted_on=tuple(document.get("fitted_on") or ()),
        evidence=dict(document.get("evidence") or {}),
        name=top.text("name", ""),
        version=top.whole("version", "1") if "version" in document else 1,
    )


def _read_covariance(
    top: QuantityReader,
) -> tuple[tuple[str, ...], tuple[tuple[float, ...], ...] | None]:
    if top.mapping.get("covariance") is None:
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


def _read_validity(top: QuantityReader) -> dict[str, tuple[float, float]]:
    ranges: dict[str, tuple[float, float]] = {}
    if top.mapping.get("validity") is None:
        return ranges
    reader = top.inner("validity")
    for channel, pair in reader.mapping.items():
        if not isinstance(pair, list) or len(pair) != 2:
            raise reader.fail(str(channel), "must be [lowest, highest] degC")
        low, high = (reader.finite(str(channel), v) for v in pair)
        if low > high:
            raise reader.fail(str(channel), f"begins at {low:g} and ends at {high:g} degC")
        ranges[str(channel)] = (low, high)
    return ranges


def model_document(model: ThermalModel) -> dict[str, Any]:
    """Return a model's mapping for a file."""

    def numbers(key: str, values: Mapping[str, float], per: str = "") -> dict[str, Any]:
        return {
            n: write_quantity(v, PARAMETER_UNITS[n] + per, model.sds.get(f"{key}.{n}"))
            for n, v in values.items()
        }

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
        "reference_temperature": write_quantity(model.T0, "degC"),
        "interior": numbers("interior", asdict(model.interior)),
        "distortion": model.distortion,
        "rates": numbers("rates", {n: model.rates[n] for n in RATED if n in model.rates}, "/K"),
        "effects": [effect_document(effect) for effect in model.effects],
    }
    if model.exterior is not None:
        document["exterior"] = numbers("exterior", asdict(model.exterior))
    document["image_sigma"] = write_quantity(model.image_sigma, "px")
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
