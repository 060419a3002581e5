"""`--effect NAME[:PARAMETER=VALUE,…]`: an effect for a fit, as people write it.

thermal_lag                                          start values and coefficients as usual
thermal_lag:tau=80                                   another start value
radial_distortion_drift:A1,A2                        these coefficients
second_heat_source:channel=board_temperature         a temperature column
target_displacement:targets=x33+y52                  targets of the test field
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.series import ReducedSeries


def parse_effect(text: str) -> ModelEffect:
    """An effect with start values. UsageError says what is wrong, and what it might have been."""
    from thermocald.physics import catalogue
    from thermocald.physics.model import ModelEffect

    name, _, rest = text.partition(":")
    try:
        kind = catalogue.get(name)
    except ConfigurationError as error:
        raise UsageError(f"--effect {text}: {error}") from error
    values: dict[str, Any] = {k: p.default for k, p in kind.nonlinear.items() if not p.text}
    chosen: list[str] = []
    for part in filter(None, rest.split(",")):
        key, equals, value = (w.strip() for w in part.partition("="))
        if key not in kind.units():
            raise UsageError(
                f"--effect {text}: {name} has no parameter {key!r}; {_nearest(key, kind.units())}"
            )
        if key in kind.linear:
            chosen.append(key)
        elif not equals:
            raise UsageError(f"--effect {text}: write {key}=VALUE")
        if not equals:
            continue
        if key in kind.nonlinear and kind.nonlinear[key].text:
            names = kind.nonlinear[key].unit == "names"
            values[key] = tuple(value.split("+")) if names else value
        else:
            values[key] = _number(text, key, value)
    for key, parameter in kind.nonlinear.items():
        if parameter.text and not values.get(key):
            example = "x33+y52" if parameter.unit == "names" else "board_temperature"
            raise UsageError(f"--effect {text}: say which: --effect {name}:{key}={example}")
    coefficients = dict.fromkeys(chosen or kind.usual, 0.0)
    try:
        return ModelEffect(name, {**coefficients, **values})
    except ConfigurationError as error:
        raise UsageError(f"--effect {text}: {error}") from error


def effect_with(name: str, values: Mapping[str, Any]) -> ModelEffect:
    """Return an effect with some values given, the others as usual.

    Of its coefficients those that are given, or the usual ones. Raises ConfigurationError.
    """
    from thermocald.physics import catalogue
    from thermocald.physics.model import ModelEffect

    kind = catalogue.get(name)
    usual: dict[str, Any] = {k: p.default for k, p in kind.nonlinear.items() if not p.text}
    if not set(values) & set(kind.linear):
        usual |= dict.fromkeys(kind.usual, 0.0)
    return ModelEffect(name, {**usual, **values})


def check_names(listed: Iterable[ModelEffect], series: Iterable[ReducedSeries]) -> None:
    """UsageError where an effect names a channel or a target that a series does not have."""
    effects = list(listed)
    for s in series:
        for effect in effects:
            channel = effect.values.get("channel")
            if channel is not None and channel not in s.source.readings:
                raise UsageError(
                    f"effect {effect.name}: {s.source.name} has no temperature column {channel!r}; "
                    f"{_nearest(channel, s.source.readings)}"
                )
            targets = effect.values.get("targets", ())
            for target in (targets,) if isinstance(targets, str) else targets:
                if target not in s.source.field.index:
                    raise UsageError(
                        f"effect {effect.name}: the test field of {s.source.name} has no target "
                        f"{target!r}; {_nearest(target, s.source.field.index)}"
                    )


def _number(text: str, key: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise UsageError(f"--effect {text}: {key}={value} is not a number") from None


def _nearest(name: str, known: Iterable[str]) -> str:
    names = list(known)
    near = get_close_matches(name, names, 1)
    if near:
        return f"did you mean {near[0]!r}?"
    shown = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
    return f"there are: {shown}"
