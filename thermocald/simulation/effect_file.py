"""Effects in files: entries of a model file, and files of their own, such as a proposal.

format: thermocald-effect/1
statement: x0 follows ∫ (T − 30.2 °C)₊ dt    # for people
effects:                                     # as in a model file
- effect: integral(above(temperature, k))    # a name of the catalogue, or a formula
  parameters: {k: {value: 30.2, sd: 0.1, unit: degC}, x0: {value: 1.1e-06, unit: mm/(K s)}}

A formula is plain text that is read and never executed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.atomic_file import write_text
from thermocald.errors import ConfigurationError
from thermocald.simulation import effects
from thermocald.simulation.model import ModelEffect
from thermocald.simulation.quantities import QuantityReader, written
from thermocald.yaml_file import dump_yaml, read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

__all__ = ["EFFECT_FORMAT", "effect_document", "effect_of", "read_effects", "write_effects"]

EFFECT_FORMAT = "thermocald-effect/1"


def read_effects(path: Path) -> list[ModelEffect]:
    """The effects of an effect file; ConfigurationError names file and key."""
    top = QuantityReader(path, read_yaml(path))
    found = top.text("format")
    if found != EFFECT_FORMAT:
        raise top.fail("format", f"is {found[:60]!r}; an effect file is {EFFECT_FORMAT!r}")
    top.only(("format", "statement", "effects", "evidence"))
    out = [effect_of(entry) for entry in top.items("effects")]
    if not out:
        raise top.fail("effects", "holds no effect")
    return out


def write_effects(
    path: Path, found: Sequence[ModelEffect], statement: str, evidence: Mapping[str, Any]
) -> None:
    """Write an effect file, as a whole or not at all."""
    document = {
        "format": EFFECT_FORMAT,
        "statement": statement,
        "effects": [effect_document(e) for e in found],
        "evidence": dict(evidence),
    }
    write_text(path, dump_yaml(document))


def effect_of(reader: QuantityReader) -> ModelEffect:
    """The effect in one entry of a list of effects; ConfigurationError names file and key."""
    reader.only(("effect", "parameters", "evidence"))
    name = reader.text("effect")
    try:
        effect = effects.get(name)
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
        quantity = parameters.quantity(key, units[key])
        values[key] = quantity.value
        if quantity.sd is not None:
            own[key] = quantity.sd
    try:
        effect.check(values)
    except ConfigurationError as error:
        raise reader.fail("parameters", str(error)) from error
    return ModelEffect(name, values, own)


def effect_document(effect: ModelEffect) -> dict[str, Any]:
    """The mapping that a file holds for an effect."""
    units = effects.get(effect.name).units()
    parameters: dict[str, Any] = {}
    for key, value in effect.values.items():
        if isinstance(value, str | tuple | list):
            parameters[key] = list(value) if not isinstance(value, str) else value
        else:
            parameters[key] = written(value, units[key], effect.sds.get(key))
    return {"effect": effect.name, "parameters": parameters}
