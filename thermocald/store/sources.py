"""Where analyses read series from: a store in a file, or one on a server; both answer alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, Self

from thermocald.errors import StoreError
from thermocald.store.server.address import is_server

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.store.database.epoch_table import StoredEpoch
    from thermocald.store.database.row import StoredSeries

    Array = NDArray[Any]

__all__ = ["SeriesSource", "open_source", "require_source"]


class SeriesSource(Protocol):
    """An open store that is read: `database.store.Store` or `server.reader.ServerStore`."""

    path: Path

    def __enter__(self) -> Self: ...
    def __exit__(self, *error: Any) -> None: ...
    def all_series(self) -> list[StoredSeries]: ...
    def find_series(self, camera: str | None = None, name: str | None = None) -> StoredSeries: ...
    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, Array]: ...
    def temperatures_at_frame(self, series: StoredSeries) -> dict[str, Array]: ...
    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array: ...
    def epochs(
        self,
        series: StoredSeries,
        first: int = 0,
        last: int | None = None,
        *,
        details: bool = True,
    ) -> Iterator[StoredEpoch]: ...


def open_source(source: Path) -> SeriesSource:
    """Open a store for reading: a file, or `postgresql://…?camera=…&series=…`.

    Raises StoreError, for a server also UsageError, ServerGone, ServerError.
    """
    if is_server(source):
        from thermocald.store.server.reader import ServerStore

        return ServerStore.open(source)
    from thermocald.store.database.store import Store

    return Store.open(source)


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
