"""The catalogue of effects: one physical cause, one class, one file.

The registry is the entry point `thermocald.effects`, for the built-in effects of this folder (in
`pyproject.toml`) and for those of other distributions alike; an entry's name is the effect's. A
formula (`simulation.formula`) is an effect too, whose name is its text.
"""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from thermocald.errors import ConfigurationError
from thermocald.simulation.effects.base import Effect
from thermocald.simulation.effects.formula import formula_effect, is_formula

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Effect", "find", "get", "names", "seen_in"]

_GROUP = "thermocald.effects"


@cache
def names() -> tuple[str, ...]:
    """The effects of the catalogue, sorted.

    ConfigurationError where there is none: the installation is older than the program.
    """
    found = tuple(sorted({point.name for point in entry_points(group=_GROUP)}))
    if not found:
        raise ConfigurationError(
            "no effect is installed: thermocald's entry points are older than the program; "
            "install it again (python -m pip install -e .)"
        )
    return found


@cache
def get(name: str) -> Effect:
    """An effect by its name, or by the formula that it is.

    ConfigurationError where there is none, or where it is not one.
    """
    if is_formula(name):
        return formula_effect(name)
    if name not in names():
        near = get_close_matches(name, names(), 1)
        hint = f"did you mean {near[0]!r}?" if near else f"known are: {', '.join(names())}"
        raise ConfigurationError(f"unknown effect {name!r}; {hint}")
    (point,) = entry_points(group=_GROUP, name=name)
    try:
        loaded = point.load()
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(f"effect {name!r} cannot be imported: {error}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, Effect) and loaded.name == name):
        raise ConfigurationError(
            f"the entry point {name!r} of {_GROUP} is {point.value}, which is not an Effect with "
            "this name"
        )
    return loaded()


def find(wanted: Callable[[Effect], bool]) -> Effect:
    """The first effect with some property; ConfigurationError where none has it."""
    for name in names():
        if wanted(get(name)):
            return get(name)
    raise ConfigurationError("no installed effect has the property that was asked for")


def seen_in(place: str) -> Effect:
    """The effect that is seen in the measuring noise ("noise") or in single targets ("targets")."""
    return find(lambda effect: effect.seen_in == place)
