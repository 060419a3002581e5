"""What an effect changes: the camera's parameters, the object points, the measuring noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = ["Displacement", "Influence"]


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Some targets have moved: rows (k,) of the test field, vector (3,) mm, active (E,) when."""

    rows: NDArray[np.int64]
    vector: Array
    active: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """What an effect changes at E times.

    iop (E, 10), eop (E, 6): added, in the order of IOP_NAMES and EOP_NAMES; scale (E, 3): factors
    of the object coordinates; displacements: of single targets; noise_factor, blur_factor (E,).
    """

    iop: Array
    eop: Array
    scale: Array
    noise_factor: Array
    blur_factor: Array
    displacements: tuple[Displacement, ...] = field(default=())

    @classmethod
    def none(cls, epochs: int) -> Self:
        """Nothing changes."""
        one = np.ones(epochs)
        return cls(np.zeros((epochs, 10)), np.zeros((epochs, 6)), np.ones((epochs, 3)), one, one)

    @classmethod
    def of_parameters(cls, changes: Mapping[str, Array], epochs: int) -> Self:
        """From changes (E,) of IOP and EOP by name."""
        result = cls.none(epochs)
        for name, change in changes.items():
            if name in IOP_NAMES:
                result.iop[:, IOP_NAMES.index(name)] += change
            else:
                result.eop[:, EOP_NAMES.index(name)] += change
        return result

    def __add__(self, other: Influence) -> Influence:
        """Both together."""
        return Influence(
            self.iop + other.iop,
            self.eop + other.eop,
            self.scale * other.scale,
            self.noise_factor * other.noise_factor,
            self.blur_factor * other.blur_factor,
            self.displacements + other.displacements,
        )
