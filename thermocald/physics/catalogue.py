"""The catalogue of effects, and the chain of drives.

Effects are registered at the entry point `thermocald.effects`, the built-in ones (in
`pyproject.toml`) as well as those of other distributions; an entry has the effect's name. A formula
(`formula`) is an effect too, named by its text.

Effects of kind `drive` (a lag, a delay, a play) form a chain: each acts on the previous one's
output at the times of the readings. Simulation, fit and discovery share this chain, forward and as
the matrix that propagates the readings' errors through it.
"""

from __future__ import annotations

from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from thermocald.errors import ConfigurationError
from thermocald.physics.effect import Effect
from thermocald.physics.formula import GivenFormula, is_formula

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.physics.history import History

    Drives = Sequence[tuple[str, Mapping[str, Any]]]

_GROUP = "thermocald.effects"


@cache
def names() -> tuple[str, ...]:
    """Return the names of the catalogue's effects, sorted.

    Raises ConfigurationError if there are none: the installation is older than the program.
    """
    installed = tuple(sorted({point.name for point in entry_points(group=_GROUP)}))
    if not installed:
        raise ConfigurationError(
            "no effect is installed: thermocald's entry points are older than the program; "
            "install it again (python -m pip install -e .)"
        )
    return installed


@cache
def get(name: str) -> Effect:
    """Return the effect with a name, which may be a formula.

    Raises ConfigurationError if there is none, or if the entry point is not an effect.
    """
    if is_formula(name):
        return GivenFormula(name)
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
    """Return the first effect with a property; ConfigurationError if none has it."""
    for name in names():
        if wanted(get(name)):
            return get(name)
    raise ConfigurationError("no installed effect has the property that was asked for")


def driven_history(history: History, drives: Drives) -> History:
    """Return the history with its reference's readings passed through drives [(effect, values)]."""
    for name, values in drives:
        driven = get(name).drive(history.at(history.reading_times), **values)
        history = replace(history, readings={**history.readings, history.reference: driven})
    return history


def drive(history: History, drives: Drives) -> Array:
    """Return the temperature (E,) °C in the linear terms at the history's times."""
    if not drives:
        return history.temperature()
    name, values = drives[-1]
    return get(name).drive(driven_history(history, drives[:-1]), **values)


def drive_matrix(history: History, drives: Drives, averages: csr_array | None = None) -> csr_array:
    """Return ∂ drive / ∂ readings, (E, R), sparse; of averages (B, E) of the epochs, (B, R)."""
    if not drives:
        matrix = history.temperature_matrix()
        return matrix if averages is None else averages @ matrix
    (name, values), before = drives[-1], drives[:-1]
    here, kind = driven_history(history, before), get(name)
    own = kind.sensitivities(here, averages, **values)[kind.channel(here, **values)]
    return drive_matrix(history.at(history.reading_times), before, own) if before else own
