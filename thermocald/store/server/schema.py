"""The server's tables: made and brought up to date, and the roles that may use them."""

from __future__ import annotations

from importlib.resources import as_file, files
from typing import TYPE_CHECKING

from thermocald.errors import UsageError
from thermocald.store.server.connection import REVISION, connect, in_words
from thermocald.store.server.timescale import use_timescale

if TYPE_CHECKING:
    from thermocald.store.server.address import ServerAddress

__all__ = ["create_tables", "grant"]

_TABLES = ("testfield", "series", "epoch", "event", "reading", "frame")
_FUNCTIONS = (
    "thermocald_month(float8)",
    "thermocald_report(text, float8, bigint, bigint, text)",
)


def create_tables(address: ServerAddress, revision: str = REVISION) -> None:
    """Bring an empty or older database to this program's tables, all or nothing."""
    from alembic import command
    from alembic.config import Config

    engine = connect(address)
    try:
        with (
            in_words(address, "its tables cannot be made"),
            engine.begin() as connection,
            as_file(files("thermocald.store.server") / "migrations") as folder,
        ):
            config = Config()
            config.set_main_option("script_location", str(folder).replace("%", "%%"))
            config.attributes["connection"] = connection
            command.upgrade(config, revision)
        if revision == REVISION:
            use_timescale(engine)
    finally:
        engine.dispose()


def grant(address: ServerAddress, role: str, *, writes: bool) -> None:
    """Let a role that exists read, or (writes) insert and nothing else.

    A role that forwards sees no row of any station: what leaks with a stolen Pi is its own.
    """
    if not role or "\0" in role:
        raise UsageError("a role must have a name")
    name = '"' + role.replace('"', '""') + '"'
    statements = [f"GRANT SELECT ON alembic_version TO {name}"]
    if writes:
        statements.append(f"GRANT INSERT ON {', '.join(_TABLES)} TO {name}")
        statements += [f"GRANT EXECUTE ON FUNCTION {one} TO {name}" for one in _FUNCTIONS]
    else:
        statements.append(f"GRANT SELECT ON {', '.join(_TABLES)}, station, summary TO {name}")
    engine = connect(address)
    try:
        with in_words(address, f"role {role!r} was not granted"), engine.begin() as connection:
            for statement in statements:
                connection.exec_driver_sql(statement)
    finally:
        engine.dispose()
