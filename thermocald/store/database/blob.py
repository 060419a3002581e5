"""Observations and covariances as compact bytes.

An observation is 18 bytes: target row uint16, x and y int32 in units of 1e-5 px, their standard
deviations float32; 4 more for the covariance of x and y where it is known, 4 for each quality.
The rounding of 3e-6 px (rms) is a thousandth of the best measurement and the digits of
observations.csv. A covariance is the 136 float64 of its upper triangle. All little-endian.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import StoreError
from thermocald.photogrammetry.field.testfield import Observations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = [
    "POINT_QUANTUM_PX",
    "pack_covariance",
    "pack_observations",
    "unpack_covariance",
    "unpack_observations",
]

POINT_QUANTUM_PX = 1e-5

_HEADER = struct.Struct("<BBIH")  # layout, flags, number of observations, bytes of the names
_LAYOUT = 1
_COVARIANCES, _LONG_ROWS, _FLOAT_POINTS = 1, 2, 4
_UPPER = np.triu_indices(16)


def pack_covariance(covariance: Array) -> bytes:
    """(16, 16) → 1088 bytes."""
    upper: Array = covariance[_UPPER]
    return upper.astype("<f8").tobytes()


def unpack_covariance(data: bytes) -> Array:
    """The inverse of `pack_covariance`; raises StoreError for another length."""
    if len(data) != 8 * len(_UPPER[0]):
        raise StoreError(f"a covariance of {len(data)} bytes in the store is broken")
    covariance = np.zeros((16, 16))
    covariance[_UPPER] = np.frombuffer(data, "<f8")
    covariance.T[_UPPER] = covariance[_UPPER]
    return covariance


def pack_observations(seen: Observations) -> bytes:
    """Observations → bytes; points rounded to 1e-5 px, the rest to float32."""
    quanta = np.rint(seen.points / POINT_QUANTUM_PX)
    flags = 0
    if seen.covariances is not None:
        flags |= _COVARIANCES
    if len(seen) and int(seen.targets.max()) > 0xFFFF:
        flags |= _LONG_ROWS
    if not bool(np.all(np.abs(quanta) < 2**31)):
        flags |= _FLOAT_POINTS  # beyond ±21474 px, or no number: kept as it is
    names = "\n".join(seen.quality).encode()
    parts = [
        _HEADER.pack(_LAYOUT, flags, len(seen), len(names)) + names,
        seen.targets.astype("<u4" if flags & _LONG_ROWS else "<u2").tobytes(),
        seen.points.astype("<f8").tobytes()
        if flags & _FLOAT_POINTS
        else quanta.astype("<i4").tobytes(),
        seen.sigmas.astype("<f4").tobytes(),
    ]
    if seen.covariances is not None:
        parts.append(seen.covariances.astype("<f4").tobytes())
    parts += [values.astype("<f4").tobytes() for values in seen.quality.values()]
    return b"".join(parts)


def unpack_observations(data: bytes) -> Observations:
    """The inverse of `pack_observations`; raises StoreError for bytes that are none."""
    try:
        layout, flags, n, names_size = _HEADER.unpack_from(data)
        if layout != _LAYOUT:
            raise ValueError(f"layout {layout}")
        position = _HEADER.size + names_size
        names = data[_HEADER.size : position].decode()

        def take(kind: str, count: int) -> NDArray[np.generic]:
            nonlocal position
            values: NDArray[np.generic] = np.frombuffer(data, kind, count, position)
            position += values.nbytes
            return values

        targets = take("<u4" if flags & _LONG_ROWS else "<u2", n).astype(np.int64)
        if flags & _FLOAT_POINTS:
            points = take("<f8", 2 * n).astype(np.float64)
        else:
            # dividing by 1e5 gives the decimal number's nearest double, times 1e-5 would not
            points = take("<i4", 2 * n).astype(np.float64) / round(1 / POINT_QUANTUM_PX)
        sigmas = take("<f4", 2 * n).astype(np.float64)
        covariances = take("<f4", n).astype(np.float64) if flags & _COVARIANCES else None
        quality = {name: take("<f4", n).astype(np.float64) for name in names.split("\n") if name}
        return Observations(
            targets, points.reshape(n, 2), sigmas.reshape(n, 2), covariances, quality
        )
    except (struct.error, ValueError) as cause:
        raise StoreError(f"observations in the store are broken: {cause}") from cause
