"""Observations and covariances as compact bytes.

An observation is 18 bytes: target row uint16, x and y int32 in units of 1e-5 px, their standard
deviations float32; 4 more for the covariance of x and y where it is known, 4 for each quality.
The rounding of 3e-6 px (rms) is a thousandth of the best measurement and the digits of
observations.csv. A covariance is the 136 float64 of its upper triangle. All little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import StoreError
from thermocald.photogrammetry.field.testfield import Observations

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = [
    "POINT_QUANTUM_PX",
    "ObservationRows",
    "pack_covariance",
    "pack_observations",
    "unpack_covariance",
    "unpack_observations",
    "unpack_rows",
]

POINT_QUANTUM_PX = 1e-5

_HEADER = struct.Struct("<BBIH")  # layout, flags, number of observations, bytes of the names
_LAYOUT = 1
_COVARIANCES, _LONG_ROWS, _FLOAT_POINTS = 1, 2, 4
_UPPER = np.triu_indices(16)


@dataclass(frozen=True, slots=True, eq=False)
class ObservationRows:
    """Observations of many epochs, a row each, in any order.

    numbers, targets (n,): their epochs and rows of the test field; points, sigmas (n, 2) px;
    covariances (n,) px² of x with y, 0 where it is not known, None where it nowhere is.
    """

    numbers: NDArray[np.int64]
    targets: NDArray[np.int64]
    points: Array
    sigmas: Array
    covariances: Array | None


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


def unpack_rows(packed: Mapping[int, bytes]) -> ObservationRows:
    """The observations of many epochs {number: bytes}, without their quality.

    What would be taken epoch by epoch is taken from the bytes of all epochs at once. Raises
    StoreError for bytes that are none.
    """
    kinds: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for number, data in packed.items():
        if len(data) < _HEADER.size or data[0] != _LAYOUT:
            raise StoreError(f"epoch {number}: its observations in the store are broken")
        _, flags, n, names_size = _HEADER.unpack_from(data)
        kinds.setdefault(flags, []).append((number, n, _HEADER.size + names_size, data))
    parts = [_rows_of(flags, epochs) for flags, epochs in kinds.items()] or [_rows_of(0, [])]
    correlated = any(part.covariances is not None for part in parts)
    return ObservationRows(
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.targets for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate(
            [np.zeros(len(p.numbers)) if p.covariances is None else p.covariances for p in parts]
        )
        if correlated
        else None,
    )


def _rows_of(flags: int, epochs: list[tuple[int, int, int, bytes]]) -> ObservationRows:
    """The rows of epochs of one layout: their number, how many, where they begin, the bytes."""
    sizes = [4 if flags & _LONG_ROWS else 2, 16 if flags & _FLOAT_POINTS else 8, 8]
    if flags & _COVARIANCES:
        sizes.append(4)
    columns: list[list[bytes]] = [[] for _ in sizes]
    for number, n, position, data in epochs:
        if len(data) < position + n * sum(sizes):
            raise StoreError(f"epoch {number}: its observations in the store are broken")
        for column, size in zip(columns, sizes, strict=True):
            column.append(data[position : position + n * size])
            position += n * size
    whole = [b"".join(column) for column in columns]
    points = np.frombuffer(whole[1], "<f8" if flags & _FLOAT_POINTS else "<i4").astype(np.float64)
    if not flags & _FLOAT_POINTS:
        points /= round(1 / POINT_QUANTUM_PX)  # as `unpack_observations` does
    numbers, counts = (np.array([e[k] for e in epochs], dtype=np.int64) for k in (0, 1))
    return ObservationRows(
        np.repeat(numbers, counts),
        np.frombuffer(whole[0], "<u4" if flags & _LONG_ROWS else "<u2").astype(np.int64),
        points.reshape(-1, 2),
        np.frombuffer(whole[2], "<f4").astype(np.float64).reshape(-1, 2),
        np.frombuffer(whole[3], "<f4").astype(np.float64) if flags & _COVARIANCES else None,
    )
