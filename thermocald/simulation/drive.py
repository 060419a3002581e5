"""The chain from temperature to drive: what the linear terms of a camera follow in place of T.

Effects of kind `drive` (a lag, a delay, a play) act one after the other, each on what the one
before makes of the temperature at the times of the readings. Simulation, fit and discovery use
this one chain, forward and as the matrix that carries the readings' errors through it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.simulation import effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

    Drives = Sequence[tuple[str, Mapping[str, Any]]]

__all__ = ["drive", "drive_matrix", "driven_history"]


def driven_history(history: History, drives: Drives) -> History:
    """The history with the readings of its reference sent through drives [(effect, values)]."""
    for name, values in drives:
        at_readings = history.at(history.reading_times)
        history = history.with_reference(effects.get(name).drive(at_readings, **values))
    return history


def drive(history: History, drives: Drives) -> Array:
    """The temperature (E,) °C behind the linear terms at the history's times."""
    if not drives:
        return history.temperature()
    name, values = drives[-1]
    return effects.get(name).drive(driven_history(history, drives[:-1]), **values)


def drive_matrix(history: History, drives: Drives, at_readings: bool = False) -> csr_array | None:
    """∂ drive / ∂ readings, (E, R), sparse.

    at_readings: of the driven readings (R, R) instead, None (the identity) where there is no
    drive.
    """
    chain: csr_array | None = None
    for name, values in drives if at_readings else drives[:-1]:
        here = history.at(history.reading_times)
        own = effects.get(name).sensitivity(here, **values)
        chain = own if chain is None else own @ chain
        history = history.with_reference(effects.get(name).drive(here, **values))
    if at_readings:
        return chain
    if not drives:
        return history.temperature_matrix()
    name, values = drives[-1]
    last = effects.get(name).sensitivity(history, **values)
    return last if chain is None else last @ chain
