"""TimescaleDB, used where it is there and never needed: the epochs as a hypertable.

Where the database has the extension (`CREATE EXTENSION timescaledb`) before the first epoch comes,
`thermocald server init` lets it keep the months; else PostgreSQL's own partitions do. What reads
and writes is the same for both.
"""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

__all__ = ["use_timescale"]

log = logging.getLogger(__name__)

# Times from clocks that were not set are anywhere; a chunk's time must be one that it can have.
_STATEMENTS = """
CREATE FUNCTION thermocald_time(at double precision) RETURNS timestamptz LANGUAGE sql IMMUTABLE
  AS $$ SELECT to_timestamp(least(greatest($1, 0), 4102444800)) $$;
CREATE TABLE epoch_whole (LIKE epoch INCLUDING ALL);
DROP TABLE epoch;
ALTER TABLE epoch_whole RENAME TO epoch;
SELECT create_hypertable('epoch', 'frame_time', time_partitioning_func => 'thermocald_time',
  chunk_time_interval => INTERVAL '1 month');
CREATE OR REPLACE FUNCTION thermocald_month(at double precision) RETURNS void LANGUAGE sql
  AS $$ SELECT $$;
CREATE TRIGGER epoch_arrived AFTER INSERT ON epoch REFERENCING NEW TABLE AS arrived
  FOR EACH STATEMENT EXECUTE FUNCTION thermocald_arrived()
"""
_OLDEST = (2, 18)
"""Before, hypertables refused triggers that see all rows of a statement, at the first insert."""


def use_timescale(engine: Engine) -> bool:
    """Make the empty table of epochs a hypertable where that can be done; whether it was.

    What fails is undone and logged: the tables stay as they are.
    """
    from sqlalchemy.exc import SQLAlchemyError

    try:
        with engine.begin() as connection:
            if not _wanted(connection):
                return False
            grants = connection.exec_driver_sql(
                "SELECT privilege_type, grantee FROM information_schema.role_table_grants "
                "WHERE table_name = 'epoch' AND grantee NOT IN (current_user, 'PUBLIC')"
            ).all()
            for statement in _STATEMENTS.split(";\n"):
                connection.exec_driver_sql(statement)
            for privilege, role in grants:
                name = str(role).replace('"', '""')
                connection.exec_driver_sql(f'GRANT {privilege} ON epoch TO "{name}"')
    except SQLAlchemyError as error:
        log.warning("TimescaleDB is not used: %s", str(error).splitlines()[0])
        return False
    return True


def _wanted(connection: Connection) -> bool:
    """Whether the extension is in this database, and the epochs are none and partitioned by us."""
    version = _version(connection)
    if (
        version is None
        or not connection.exec_driver_sql(
            "SELECT EXISTS (SELECT FROM pg_partitioned_table WHERE partrelid = 'epoch'::regclass) "
            "AND NOT EXISTS (SELECT FROM epoch)"
        ).scalar()
    ):
        return False
    found = tuple(int(part) for part in re.findall(r"\d+", version)[:2])
    if found < _OLDEST:
        log.warning("TimescaleDB %s is not used: 2.18 or later is needed", version)
    return found >= _OLDEST


def _version(connection: Connection) -> str | None:
    found = connection.exec_driver_sql(
        "SELECT extversion FROM pg_extension WHERE extname = 'timescaledb'"
    ).scalar()
    return None if found is None else str(found)
