"""The 16 parameters of an oriented camera: their names, units and places in a vector.

Parameter vectors are ordered as `PARAMETER_NAMES`: the ten of the interior orientation, then the
six of the exterior. Units and signs are those of CONVENTIONS §2.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "EOP",
    "EOP_COLUMNS",
    "EOP_NAMES",
    "IOP",
    "IOP_NAMES",
    "PARAMETER_COUNT",
    "PARAMETER_NAMES",
    "POSITION",
    "PRINCIPAL",
    "PRINCIPAL_POINT",
    "ROTATION",
    "UNITS",
    "free_columns",
]

IOP_NAMES = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
EOP_NAMES = ("omega", "phi", "kappa", "X0", "Y0", "Z0")
PARAMETER_NAMES = IOP_NAMES + EOP_NAMES
PARAMETER_COUNT = len(PARAMETER_NAMES)

IOP = slice(0, 10)
"""Interior orientation."""
EOP = slice(10, 16)
"""Exterior orientation."""
PRINCIPAL = slice(0, 3)
"""c, x0, y0: what thermal drift is reported of."""
PRINCIPAL_POINT = slice(1, 3)
"""x0, y0."""
ROTATION = slice(10, 13)
"""omega, phi, kappa."""
POSITION = slice(13, 16)
"""X0, Y0, Z0."""

EOP_COLUMNS = np.arange(EOP.start, EOP.stop)
"""The exterior orientation as an index array."""
EOP_COLUMNS.flags.writeable = False

UNITS = {
    **dict.fromkeys(("c", "x0", "y0", "X0", "Y0", "Z0"), "mm"),
    "A1": "mm⁻²",
    "A2": "mm⁻⁴",
    "A3": "mm⁻⁶",
    "B1": "mm⁻¹",
    "B2": "mm⁻¹",
    "C1": "1",
    "C2": "1",
    **dict.fromkeys(("omega", "phi", "kappa"), "rad"),
}
"""Unit of each parameter."""


def free_columns(names: tuple[str, ...]) -> list[int]:
    """Positions of the named interior parameters, in the order of `PARAMETER_NAMES`."""
    return [i for i, name in enumerate(IOP_NAMES) if name in names]
