"""Checksums of rows: SQLite's own integrity check does not see a bit that changed inside a value.

A CRC-32 is taken over a row's numbers, as little-endian float64 with one NaN for NULL, and then its
texts, joined by a control character. Rows of files older than version 4 have none.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import TYPE_CHECKING, Any

from thermocald.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["DamageError", "require_checksum", "row_checksum"]

_SEPARATOR = "\x1f"


class DamageError(StoreError):
    """A row of the store is not as it was written."""


def row_checksum(numbers: Sequence[Any], texts: Iterable[str] = (), data: bytes = b"") -> int:
    """CRC-32 of a row as SQLite gives it back: numbers or None, texts, bytes.

    Raises TypeError or ValueError where a value is of another type, which is damage too.
    """
    # 0.0 + -0.0 is 0.0: SQLite does not keep the sign of a zero
    plain = [math.nan if v is None or v != v else 0.0 + v for v in numbers]
    found = zlib.crc32(struct.pack(f"<{len(plain)}d", *plain))
    found = zlib.crc32(_SEPARATOR.join(texts).encode(errors="surrogateescape"), found)
    return zlib.crc32(data, found)


def require_checksum(
    kept: int | None,
    what: str,
    numbers: Sequence[Any],
    texts: Iterable[str] = (),
    data: bytes = b"",
) -> None:
    """Raise DamageError naming `what` if a row is not as it was written; kept: None if unknown."""
    if kept is None:
        return
    try:
        good = row_checksum(numbers, texts, data) == kept
    except (TypeError, ValueError, OverflowError, struct.error):
        good = False
    if not good:
        raise DamageError(
            f"{what} is damaged: its checksum does not match; `thermocald check` lists all that "
            "is damaged, a backup has it as it was"
        )
