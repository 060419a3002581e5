"""The catalogue of effects: one physical cause, one class, one file.

The registry is this folder: every module but `base` holds one `Effect` whose name is the module's.
Adding an effect is one file here and one test.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from thermocald.errors import ConfigurationError
from thermocald.simulation.effects.base import Effect

__all__ = ["get", "names"]


@cache
def names() -> tuple[str, ...]:
    """The effects of the catalogue, sorted."""
    return tuple(sorted(m.name for m in iter_modules(__path__) if m.name != "base"))


@cache
def get(name: str) -> Effect:
    """An effect by its name; ConfigurationError where there is none."""
    if name not in names():
        from difflib import get_close_matches

        near = get_close_matches(name, names(), 1)
        hint = f"did you mean {near[0]!r}?" if near else f"known are: {', '.join(names())}"
        raise ConfigurationError(f"unknown effect {name!r}; {hint}")
    module = import_module(f"{__name__}.{name}")
    classes = [
        member
        for member in vars(module).values()
        if isinstance(member, type)
        and issubclass(member, Effect)
        and member.__module__ == module.__name__
    ]
    effect: Effect = classes[0]()
    return effect
