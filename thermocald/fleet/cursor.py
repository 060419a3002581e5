"""How far a store has been sent: a small file next to it, replaced as a whole.

Losing it costs time and nothing else: the server passes over rows that it has already.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Self

from thermocald.atomic_file import write_text
from thermocald.errors import StoreError
from thermocald.store.database.examination import KEPT

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.store.database.store import Store


_COUNTED = (*KEPT, "frame")


@dataclass(slots=True)
class Cursor:
    """The last ids sent of each growing table, to one server and from one store.

    server: its whole address but a password; identity, inode: of the store and its file, since
    another store under the old name, or a restored one, is sent from its start; sent: {table: id},
    `frame`: the last epoch whose frame was looked at; refused: rows that the server does not take,
    {table: ids}, for a person to look at; day, frame_bytes: what frames have taken on that day
    (UTC, days since 1970).
    """

    server: str
    station: str
    identity: str
    inode: int
    sent: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_COUNTED, 0))
    refused: dict[str, list[int]] = field(default_factory=dict)
    day: int = 0
    frame_bytes: int = 0

    @classmethod
    def read(cls, path: Path, store: Store, server: str, station: str) -> Self:
        """As left by an earlier run, or at the start if there is none, or it is of something else.

        Raises StoreError where the store is missing.
        """
        try:
            inode = store.path.stat().st_ino
        except OSError as error:
            raise StoreError(f"{store.path}: cannot be read: {error.strerror}") from error
        fresh = cls(server, station, store.identity, inode)
        try:
            found = cls(**json.loads(path.read_text(encoding="utf-8")))
            same = (found.server, found.station, found.identity, found.inode) == (
                server, station, fresh.identity, inode,
            )  # fmt: skip
            found.sent = {**fresh.sent, **found.sent}
            sound = {*found.sent} == {*_COUNTED} and all(
                type(n) is int for n in (*found.sent.values(), found.day, found.frame_bytes)
            )
            sound = sound and all(type(ids) is list for ids in found.refused.values())
        except (OSError, ValueError, TypeError, AttributeError):
            return fresh
        return found if same and sound else fresh

    @property
    def rows_refused(self) -> int:
        return sum(map(len, self.refused.values()))

    def write(self, path: Path) -> None:
        """Replace the file as a whole. Raises OutputError where it cannot be written."""
        write_text(path, json.dumps(asdict(self)))
