"""Connecting to the server's database, and its errors in words."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

from thermocald.errors import (
    DriverMissing,
    ServerError,
    ServerGone,
    StoreError,
    StoreVersionError,
    ThermocaldError,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sqlalchemy import Engine

    from thermocald.store.server.address import ServerAddress

__all__ = ["REVISION", "Connected", "connect", "in_words", "require_revision"]

REVISION = "0003"
"""The schema that this program writes and reads; `thermocald server init` brings a server to it."""

_CONNECT_S = 10
# A network that died is noticed within a minute, in a query or between two.
_SESSION = {
    "connect_timeout": _CONNECT_S,
    "keepalives": 1,
    "keepalives_idle": 20,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 60_000,
    "application_name": "thermocald",
}
# SQLSTATE or its class → what to do. Source: PostgreSQL manual, appendix A.
_ADVICE = {
    "28": "the server refused the user; check the name, the password or certificate, pg_hba.conf",
    "3D": "the server has no such database; create it, then run `thermocald server init`",
    "42501": "this role may not do that; grant it, or use another role",
    "42P01": "the database has no tables of thermocald; run `thermocald server init`",
    "42703": "the server's tables are of another version; run `thermocald server init`",
    "53100": "the server's disk is full; free some space there, nothing is lost here",
    "53": "the server is short of resources",
    "57": "the server is shutting down or starting",
    "22": "the server refused a value",
    "23": "the server refused a row",
}
_PASSES = ("08", "40", "53", "55", "57", "58")
"""Classes of errors that may pass by themselves: the same batch is tried again."""


def connect(address: ServerAddress) -> Engine:
    """An engine for the address; nothing is connected yet. DriverMissing without SQLAlchemy."""
    try:
        from sqlalchemy import create_engine
        from sqlalchemy.exc import ArgumentError
    except ImportError as error:
        raise DriverMissing(
            f"a server's store needs SQLAlchemy and psycopg: pip install 'thermocald[server]' "
            f"({error})"
        ) from error
    try:
        return create_engine(
            address.url, connect_args=_SESSION, pool_pre_ping=True, pool_size=2, max_overflow=2
        )
    except (ArgumentError, ImportError, ValueError) as error:
        raise StoreError(f"{address}: cannot be used: {error}") from error


@contextmanager
def in_words(address: ServerAddress | str, doing: str) -> Iterator[None]:
    """Turn SQLAlchemy's and psycopg's errors into ServerGone (may pass) or ServerError."""
    import psycopg
    from sqlalchemy.exc import DBAPIError, SQLAlchemyError

    try:
        yield
    except ThermocaldError:
        raise
    except (DBAPIError, psycopg.Error) as error:
        cause = error.orig if isinstance(error, DBAPIError) else error
        raise _told(address, doing, cause) from error
    except SQLAlchemyError as error:
        raise ServerError(f"{address}: {doing}: {error}") from error


def _told(address: ServerAddress | str, doing: str, cause: Any) -> StoreError:
    state = getattr(cause, "sqlstate", None) or ""
    text = " ".join(str(cause).split())
    advice = _ADVICE.get(state) or _ADVICE.get(state[:2], "")
    if not state:
        # libpq failed before the server spoke: name resolution, refusal, TLS, a dead connection
        lower = text.lower()
        if "password authentication" in lower or "no pg_hba" in lower:
            return ServerError(f"{address}: {doing}: {_ADVICE['28']} ({text})")
        if "certificate" in lower:
            return ServerError(
                f"{address}: {doing}: the certificate is not accepted; is it expired, or of "
                f"another authority? ({text})"
            )
        if "does not exist" in lower and "database" in lower:
            return ServerError(f"{address}: {doing}: {_ADVICE['3D']} ({text})")
        return ServerGone(f"{address}: {doing}: the server cannot be reached ({text})")
    message = f"{address}: {doing}: {advice + ' ' if advice else ''}({text})"
    if state[:2] in _PASSES:
        return ServerGone(message)
    refused = ServerError(message)
    refused.about_values = state[:2] in ("22", "23")
    return refused


class Connected:
    """A server whose tables are of this program's version; use it in a `with` block.

    Raises ServerGone, ServerError, StoreVersionError.
    """

    def __init__(self, address: ServerAddress) -> None:
        self.address = address
        self._engine = connect(address)
        try:
            require_revision(self._engine, address)
        except BaseException:
            self._engine.dispose()
            raise

    def close(self) -> None:
        """Close all connections; may be called twice."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _query(self, statement: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
        """All rows that psycopg gives for a statement with %s."""
        with in_words(self.address, "it cannot be read"), self._engine.connect() as connection:
            cursor = connection.connection.cursor()
            cursor.execute(statement, values)
            return list(cursor.fetchall())


def require_revision(engine: Engine, address: ServerAddress) -> None:
    """StoreVersionError where the server's tables are not of this program's version."""
    from sqlalchemy import text

    with in_words(address, "its version cannot be read"), engine.connect() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    if found != REVISION:
        older = str(found or "") < REVISION
        remedy = "run `thermocald server init` there" if older else "update thermocald here"
        raise StoreVersionError(
            f"{address}: its tables are of version {found}, this program's are {REVISION}; {remedy}"
        )
