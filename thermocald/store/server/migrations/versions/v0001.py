"""The first version: stations, series, epochs by month, events, readings, frames.

Written out in full: a version must not change when the program does.
"""

from alembic import op

revision = "0001"
down_revision = None

_TABLES = """
CREATE TABLE testfield (digest text PRIMARY KEY, csv text NOT NULL);

CREATE TABLE series (
       key uuid PRIMARY KEY, station text NOT NULL, camera text NOT NULL, name text NOT NULL,
       start text NOT NULL, created_utc double precision NOT NULL, digest text NOT NULL,
       head text NOT NULL, identity text NOT NULL, settings text NOT NULL);
CREATE INDEX series_station ON series (station, camera, name);

CREATE TABLE epoch (
       series uuid NOT NULL, number bigint NOT NULL, revision integer NOT NULL,
       frame_time double precision NOT NULL, temperature_time double precision,
       clock_trusted boolean NOT NULL, status text NOT NULL, sigma0 double precision,
       redundancy integer NOT NULL, n_observations integer NOT NULL, n_rejected integer NOT NULL,
       measured integer,
       "c" double precision, "sd_c" double precision,
       "x0" double precision, "sd_x0" double precision,
       "y0" double precision, "sd_y0" double precision,
       "A1" double precision, "sd_A1" double precision,
       "A2" double precision, "sd_A2" double precision,
       "A3" double precision, "sd_A3" double precision,
       "B1" double precision, "sd_B1" double precision,
       "B2" double precision, "sd_B2" double precision,
       "C1" double precision, "sd_C1" double precision,
       "C2" double precision, "sd_C2" double precision,
       "omega" double precision, "sd_omega" double precision,
       "phi" double precision, "sd_phi" double precision,
       "kappa" double precision, "sd_kappa" double precision,
       "centre_X0" double precision, "sd_centre_X0" double precision,
       "centre_Y0" double precision, "sd_centre_Y0" double precision,
       "centre_Z0" double precision, "sd_centre_Z0" double precision,
       temperatures text NOT NULL, extra text NOT NULL, rejected text NOT NULL,
       frame text NOT NULL, note text NOT NULL, reason text NOT NULL,
       covariance bytea, observations bytea,
       PRIMARY KEY (series, number, revision, frame_time)) PARTITION BY RANGE (frame_time);
CREATE TABLE epoch_other PARTITION OF epoch DEFAULT;
CREATE INDEX epoch_revised ON epoch (series, number) WHERE revision > 0;
CREATE INDEX epoch_latest ON epoch (series, frame_time DESC);

CREATE TABLE event (
       station text NOT NULL, id bigint NOT NULL, utc double precision NOT NULL,
       kind text NOT NULL, text text NOT NULL, series uuid, epoch bigint, data text NOT NULL,
       PRIMARY KEY (station, id));
CREATE TABLE reading (
       station text NOT NULL, id bigint NOT NULL, thermometer text NOT NULL,
       utc double precision NOT NULL, clock_trusted boolean NOT NULL, temperatures text NOT NULL,
       PRIMARY KEY (station, id));
CREATE INDEX reading_time ON reading (station, thermometer, utc);
CREATE TABLE frame (
       series uuid NOT NULL, number bigint NOT NULL, name text NOT NULL, data bytea NOT NULL,
       PRIMARY KEY (series, number));
"""

# A month is made by whoever first writes into it; the role that forwards may only insert, so the
# function runs with its owner's rights. What came before its month's table stays in epoch_other.
_MONTH = """
CREATE FUNCTION thermocald_month(at double precision) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER SET search_path = public, pg_temp AS $$
DECLARE
  low timestamptz := date_trunc('month', to_timestamp(at) AT TIME ZONE 'UTC') AT TIME ZONE 'UTC';
  high timestamptz := (date_trunc('month', to_timestamp(at) AT TIME ZONE 'UTC')
                       + interval '1 month') AT TIME ZONE 'UTC';
  part text := 'epoch_' || to_char(to_timestamp(at) AT TIME ZONE 'UTC', 'YYYY_MM');
BEGIN
  IF at < 946684800 OR at > 4102444800 OR to_regclass('public.' || part) IS NOT NULL THEN
    RETURN;
  END IF;
  PERFORM pg_advisory_xact_lock(7496050);
  IF to_regclass('public.' || part) IS NULL AND NOT EXISTS (
      SELECT 1 FROM public.epoch_other WHERE frame_time >= extract(epoch FROM low)
      AND frame_time < extract(epoch FROM high)) THEN
    EXECUTE format('CREATE TABLE public.%I PARTITION OF public.epoch FOR VALUES FROM (%s) TO (%s)',
                   part, extract(epoch FROM low), extract(epoch FROM high));
  END IF;
END $$;
"""


def upgrade() -> None:
    for statement in _TABLES.split(";\n"):
        if statement.strip():
            op.execute(statement)
    op.execute(_MONTH)


def downgrade() -> None:
    for table in ("frame", "reading", "event", "epoch", "series", "testfield"):
        op.execute(f"DROP TABLE {table}")
    op.execute("DROP FUNCTION thermocald_month(double precision)")
