"""Second version: when a row came, what a station says of itself, keys by content, frames checked.

An event or a reading was keyed by its id in the station's store, which a new or restored store
gives to another row; it is keyed by what it says. `received` is the server's own clock.
"""

from alembic import op

revision = "0002"
down_revision = "0001"

_NOW = "extract(epoch FROM clock_timestamp())::double precision"

_UP = f"""
ALTER TABLE epoch ADD COLUMN received double precision;
ALTER TABLE epoch ALTER COLUMN received SET DEFAULT {_NOW};

ALTER TABLE event DROP CONSTRAINT event_pkey;
CREATE UNIQUE INDEX event_content ON event
       (station, utc, kind, md5(text), coalesce(series::text, ''), coalesce(epoch, -1), md5(data));
ALTER TABLE reading DROP CONSTRAINT reading_pkey;
DROP INDEX reading_time;
CREATE UNIQUE INDEX reading_content ON reading (station, thermometer, utc, md5(temperatures));

ALTER TABLE frame ADD COLUMN frame_time double precision NOT NULL;
ALTER TABLE frame ADD COLUMN digest text NOT NULL;
ALTER TABLE frame ADD COLUMN received double precision DEFAULT {_NOW};
ALTER TABLE frame ADD CONSTRAINT frame_whole CHECK (digest = encode(sha256(data), 'hex'));
ALTER TABLE frame ALTER COLUMN data SET STORAGE EXTERNAL;

CREATE TABLE station (
       name text PRIMARY KEY, contact double precision NOT NULL, clock double precision NOT NULL,
       waiting bigint NOT NULL, refused bigint NOT NULL, version text NOT NULL)
"""

# A role that forwards may only insert; it may say how it is through this function alone.
_REPORT = f"""
CREATE FUNCTION thermocald_report(
       name text, clock double precision, waiting bigint, refused bigint, version text)
RETURNS void LANGUAGE sql SECURITY DEFINER SET search_path = public, pg_temp AS $$
  INSERT INTO public.station VALUES ($1, {_NOW}, $2, $3, $4, $5)
  ON CONFLICT (name) DO UPDATE SET contact = excluded.contact, clock = excluded.clock,
    waiting = excluded.waiting, refused = excluded.refused, version = excluded.version
  -- what was under way when a connection broke may come after what was said later
  WHERE excluded.clock >= station.clock OR excluded.contact > station.contact + 600
$$
"""

# Who could read the tables before can read the new one.
_GRANT = """
DO $$
DECLARE reader text;
BEGIN
  FOR reader IN SELECT DISTINCT grantee FROM information_schema.role_table_grants
      WHERE table_name = 'epoch' AND privilege_type = 'SELECT'
      AND grantee NOT IN ('PUBLIC', current_user) LOOP
    EXECUTE format('GRANT SELECT ON station TO %I', reader);
  END LOOP;
END $$
"""


def upgrade() -> None:
    for statement in (*_UP.split(";\n"), _REPORT, _GRANT):
        op.execute(statement)


def downgrade() -> None:
    op.execute("DROP FUNCTION thermocald_report")
    op.execute("DROP TABLE station")
    op.execute("ALTER TABLE frame DROP CONSTRAINT frame_whole")
    for column in ("frame_time", "digest", "received"):
        op.execute(f"ALTER TABLE frame DROP COLUMN {column}")
    op.execute("ALTER TABLE epoch DROP COLUMN received")
    op.execute("DROP INDEX reading_content")
    op.execute("CREATE INDEX reading_time ON reading (station, thermometer, utc)")
    op.execute("DROP INDEX event_content")
