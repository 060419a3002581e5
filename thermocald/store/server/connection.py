"""A store on a server: its address, connections, tables, and explanations of its errors.

    postgresql://reader@db.example/thermocald?camera=gauge-7&series=M1&sslmode=verify-full

`station`, `camera` and `series` select series; libpq gets the rest of the address unchanged.
"""

from __future__ import annotations

import os
import re
import threading
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit, urlunsplit

from thermocald.addresses import hide, hide_secrets, without_secrets
from thermocald.errors import (
    DriverMissing,
    ServerError,
    ServerGone,
    StoreError,
    StoreVersionError,
    ThermocaldError,
    UsageError,
)
from thermocald.store import schema

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from psycopg import Connection

_SCHEME = re.compile(r"^postgres(ql)?:/+")
_OURS = ("station", "camera", "series")
_CONNECT_S = 10
# A lost connection is noticed within a minute, during a query or between two.
_SESSION = {
    "connect_timeout": _CONNECT_S, "keepalives": 1, "keepalives_idle": 20,
    "keepalives_interval": 10, "keepalives_count": 3, "tcp_user_timeout": 60_000,
    "application_name": "thermocald",
}  # fmt: skip
# SQLSTATE or its class → what to do. Source: PostgreSQL manual, appendix A.
_ADVICE = {
    "28": "the server refused the user; check name, password or certificate, and its pg_hba.conf",
    "3D": "the server has no such database; create it, then run `thermocald server init`",
    "42501": "this role lacks the permission; grant it, or use another role",
    "42P01": "the database has no thermocald tables; run `thermocald server init`",
    "42703": "the server's tables are of another version; run `thermocald server init`",
    "53100": "the server's disk is full; free some space there; nothing is lost here",
    "53": "the server is short of resources",
    "57": "the server is shutting down or starting",
    "22": "the server refused a value",
    "23": "the server refused a row",
}
_REFUSED = {
    "password authentication|no pg_hba": _ADVICE["28"],
    "certificate|unknown ca": (
        "the certificate is not accepted; is it expired, or of another authority?"
    ),
    "database.*does not exist": _ADVICE["3D"],
}
"""Pattern of libpq's message, for errors without SQLSTATE → what to do."""
_TEMPORARY = ("08", "40", "53", "55", "57", "58")
"""Classes of temporary errors, after which the same batch is sent again."""
_LOCK = 7496051  # of `server init`: two at the same time would both create the tables
_TABLES = ("testfield", "series", "epoch", "event", "reading", "frame")
_FUNCTIONS = (
    "thermocald_month(float8)",
    "thermocald_report(text, uuid, float8, bigint, bigint, text)",
)


def is_server(source: Path | str) -> bool:
    """Return whether a source is a server's address, not a file or folder."""
    return bool(_SCHEME.match(str(source)))


@dataclass(frozen=True, slots=True)
class ServerAddress:
    """A parsed address: `url` for libpq, and the selection of series, None for all."""

    url: str
    station: str | None = None
    camera: str | None = None
    series: str | None = None

    @classmethod
    def parse(cls, source: Path | str) -> Self:
        """Parse an address, also as a path, in which `//` has become `/`. Raises UsageError."""
        if not is_server(source):
            raise UsageError(
                f"{without_secrets(str(source))}: is not a server's address (postgresql://…)"
            )
        text = _SCHEME.sub("postgresql://", str(source))
        try:
            parts = urlsplit(text)
            _ = parts.port
            query = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
        except ValueError as error:
            raise UsageError(
                f"{without_secrets(str(source))}: is not a valid address: "
                f"{without_secrets(str(error))}"
            ) from None
        for secret in (parts.password, os.environ.get("PGPASSWORD")):
            hide(secret and unquote(secret))
        hide_secrets(dict(query))
        selection = {name: value for name, value in query if name in _OURS}
        rest = urlencode([(n, v) for n, v in query if n not in _OURS], quote_via=quote)
        url = urlunsplit(("postgresql", parts.netloc, parts.path, rest, ""))
        return cls(url, **selection)

    def narrowed(self, station: str, camera: str, series: str) -> Path:
        """Return the address as a path that selects one series instead."""
        parts = urlsplit(self.url)
        chosen = zip(_OURS, (station, camera, series), strict=True)
        query = urlencode([*parse_qsl(parts.query), *chosen], quote_via=quote, safe="")
        return Path(urlunsplit(parts._replace(query=query)))

    @property
    def place(self) -> str:
        """The address with its options, without the password: server, database and user."""
        options = sorted((n, v) for n, v in parse_qsl(urlsplit(self.url).query) if n != "password")
        return f"{self}?{urlencode(options)}"

    def __str__(self) -> str:
        """Return the address for messages, without the password."""
        parts = urlsplit(self.url)
        place = parts.netloc.rsplit("@", 1)
        user = place[0].split(":", 1)[0] + "@" if len(place) == 2 else ""
        return f"postgresql://{user}{place[-1]}{parts.path}"


def require_file(source: Path) -> Path:
    """Return the path of a store. Raises UsageError for a server's address."""
    if is_server(source):
        address = ServerAddress.parse(source)
        raise UsageError(f"{address}: is a server; this command needs a store's file")
    return source


@contextmanager
def in_words(address: ServerAddress | str, doing: str) -> Iterator[None]:
    """Turn psycopg's errors into ServerGone (temporary) or ServerError."""
    try:
        import psycopg
    except ImportError as error:
        raise DriverMissing(
            f"a server's store needs psycopg: pip install 'thermocald[server]' ({error})"
        ) from error
    try:
        yield
    except ThermocaldError:
        raise
    except psycopg.Error as error:
        raise _explain(address, doing, error) from error


def _explain(address: ServerAddress | str, doing: str, cause: Any) -> StoreError:
    state = getattr(cause, "sqlstate", None) or ""
    text = without_secrets(" ".join(str(cause).split()))
    advice = _ADVICE.get(state) or _ADVICE.get(state[:2], "")
    if not state:
        # libpq failed without an answer: name resolution, refusal, TLS, a lost connection
        for pattern, advice in _REFUSED.items():
            if re.search(pattern, text, re.IGNORECASE):
                return ServerError(f"{address}: {advice} ({text})")
        return ServerGone(f"{address}: the server cannot be reached ({text})")
    message = f"{address}: {doing}: {advice + ' ' if advice else ''}({text})"
    if state[:2] in _TEMPORARY:
        return ServerGone(message)
    refused = ServerError(message)
    refused.about_values = state[:2] in ("22", "23")
    return refused


class Connected:
    """A server whose tables have this program's version; use it in a `with` block.

    any_version: the tables may be older or missing. Raises ServerGone, ServerError,
    StoreVersionError; DriverMissing without psycopg.
    """

    def __init__(self, address: ServerAddress, *, any_version: bool = False) -> None:
        self.address = address
        self._idle: list[Connection[Any]] = []
        self._pool = threading.Lock()
        if any_version:
            return
        try:
            ((found,),) = self._query("SELECT version FROM thermocald_version")
            if found != (known := len(schema.SERVER_STEPS)):
                remedy = "run `thermocald server init` there"
                raise StoreVersionError(
                    f"{address}: its tables are of version {found}, this program's are {known}; "
                    f"{remedy if found < known else 'update thermocald here'}"
                )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close all connections; may be called twice."""
        with self._pool:
            while self._idle:
                self._idle.pop().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextmanager
    def _transaction(self, doing: str) -> Iterator[Connection[Any]]:
        """Provide a connection in a transaction that is committed at the end of the block."""
        with in_words(self.address, doing):
            connection = self._take()
            try:
                with connection.transaction():
                    yield connection
            except BaseException:
                connection.close()
                raise
            with self._pool:
                self._idle.append(connection)

    def _take(self) -> Connection[Any]:
        """Return a live connection; one that was used before may have been lost since."""
        import psycopg

        while True:
            with self._pool:
                connection = self._idle.pop() if self._idle else None
            if connection is None:
                try:
                    return psycopg.connect(self.address.url, **_SESSION)  # type: ignore[arg-type]
                except psycopg.ProgrammingError as error:  # an option unknown to libpq
                    why = without_secrets(str(error))
                    raise StoreError(f"{self.address}: cannot be used: {why}") from error
            with suppress(psycopg.Error):
                connection.execute("SELECT 1")
                connection.rollback()
                return connection
            connection.close()

    def _query(self, statement: Any, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Return all rows of a statement with placeholders %s."""
        with self._transaction("it cannot be read") as connection:
            return connection.execute(statement, values).fetchall()


def create_tables(address: ServerAddress) -> None:
    """Create the tables, or upgrade older ones, in one transaction."""
    with (
        Connected(address, any_version=True) as server,
        server._transaction("its tables cannot be created") as connection,
    ):
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
        connection.execute("CREATE TABLE IF NOT EXISTS thermocald_version (version integer)")
        found = connection.execute("SELECT version FROM thermocald_version").fetchone()
        before = found[0] if found else 0
        version = schema.upgrade(connection.execute, before, schema.SERVER_STEPS)
        connection.execute("DELETE FROM thermocald_version")
        connection.execute("INSERT INTO thermocald_version VALUES (%s)", (version,))


def grant(address: ServerAddress, role: str, *, writes: bool) -> None:
    """Allow an existing role to read or, with `writes`, only to insert.

    A role that forwards cannot read any station's rows: a stolen Pi only discloses its own data.
    """
    if not role or "\0" in role:
        raise UsageError("give the name of a role, without NUL characters")
    name = '"' + role.replace('"', '""') + '"'
    statements = [f"GRANT SELECT ON thermocald_version TO {name}"]
    if writes:
        statements.append(f"GRANT INSERT ON {', '.join(_TABLES)} TO {name}")
        statements += [f"GRANT EXECUTE ON FUNCTION {one} TO {name}" for one in _FUNCTIONS]
    else:
        statements.append(f"GRANT SELECT ON {', '.join(_TABLES)}, station, summary TO {name}")
    with (
        Connected(address, any_version=True) as server,
        server._transaction(f"role {role!r} was not granted permission") as connection,
    ):
        for statement in statements:
            connection.execute(statement)
