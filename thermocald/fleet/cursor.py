"""How far a store has been sent: a small file next to it, replaced whole.

Losing it costs time and nothing else: rows that are sent again are passed over by the server.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Self

from thermocald.atomic_file import write_text
from thermocald.errors import StoreError
from thermocald.store.database.changes import KEPT

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Cursor"]


@dataclass(slots=True)
class Cursor:
    """The last ids sent of each growing table, to one server and for one file.

    inode: of the store, since a new file under the old name begins again; refused: rows that the
    server will not take, {table: ids}, which a person should look at.
    """

    server: str
    station: str
    inode: int
    sent: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KEPT, 0))
    refused: dict[str, list[int]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, store: Path, server: str, station: str) -> Self:
        """As left by an earlier run, or at the start if there is none, or it is of something else.

        Raises StoreError where the store is missing.
        """
        try:
            inode = store.stat().st_ino
        except OSError as error:
            raise StoreError(f"{store}: cannot be read: {error.strerror}") from error
        fresh = cls(server, station, inode)
        try:
            found = cls(**json.loads(path.read_text(encoding="utf-8")))
            same = (found.server, found.station, found.inode) == (server, station, inode)
            sound = {*found.sent} == {*KEPT} and all(type(n) is int for n in found.sent.values())
        except (OSError, ValueError, TypeError, AttributeError):
            return fresh
        return found if same and sound else fresh

    def write(self, path: Path) -> None:
        """Replace the file, whole. Raises OutputError where it cannot be written."""
        write_text(path, json.dumps(asdict(self)))
