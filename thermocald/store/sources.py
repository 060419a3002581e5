"""Where analyses read series from: a store in a file, or one on a server; both answer alike.

Analyses read times that are corrected where the clock was wrong; the store has them as stamped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermocald.errors import StoreError
from thermocald.files import is_database
from thermocald.store.server.connection import ServerAddress, is_server

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.store.series import SeriesReader


def open_source(source: Path) -> SeriesReader:
    """Open a store for reading: a file, or `postgresql://…?camera=…&series=…`; times are corrected.

    Raises StoreError, for a server also UsageError, ServerGone, ServerError.
    """
    if is_server(source):
        from thermocald.store.server.reader import ServerStore

        opened: SeriesReader = ServerStore.open(source)
    else:
        from thermocald.store.database.store import Store

        opened = Store.open(source)
    opened.corrected = True
    return opened


def is_store(source: Path) -> bool:
    """Whether a source is a store: a server's address, or a file that SQLite wrote."""
    return is_server(source) or is_database(source)


def source_name(source: Path) -> str:
    """A source as messages and results name it: an address without its password."""
    if not is_server(source):
        return str(source)
    parsed = ServerAddress.parse(source)
    chosen = (parsed.station, parsed.camera, parsed.series)
    return " ".join([str(parsed), "/".join(part for part in chosen if part)]).strip()


def require_source(source: Path) -> Path:
    """A recording, a store or a server's address as given; StoreError for a path that is not there.

    A server is asked when it is opened.
    """
    if not is_server(source) and not source.exists():
        raise StoreError(
            f"{source}: does not exist; give a recording (folder), a store (file), or "
            "postgresql://…"
        )
    return source
