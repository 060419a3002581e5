"""Third version: a summary of every series in slots of six hours, kept with each row that arrives.

The trigger runs in the transaction of the rows and sees only those that were inserted, so that
what is sent twice counts once. Of revised epochs the latest counts: their slots are made again.
"""

from alembic import op

revision = "0003"
down_revision = "0002"

# sample: of the slot's first epoch with a result and a temperature: frame_time, number, °C of the
# reference, c, sd, x0, sd, y0, sd; arrays are compared element by element, so `least` is the first.
# A clock that was not set may say anything: the first and last slot hold what is outside of them.
_TABLE = """
CREATE TABLE summary (
       series uuid NOT NULL, slot integer NOT NULL, epochs bigint NOT NULL, ok bigint NOT NULL,
       first double precision NOT NULL, last double precision NOT NULL, last_ok double precision,
       low double precision, high double precision, sample double precision[],
       PRIMARY KEY (series, slot)) WITH (fillfactor = 80);

CREATE FUNCTION thermocald_slot(at double precision) RETURNS integer
LANGUAGE sql IMMUTABLE PARALLEL SAFE
AS $$ SELECT floor(least(greatest($1, 0), 4102444800) / 21600)::integer $$
"""

# rows of epochs -> rows of the summary; {channel}: the name of the reference temperature; OFFSET 0:
# JSON is parsed once an epoch and not in every aggregate
_SUMMARY = """
SELECT series, slot, count(*), count(*) FILTER (WHERE status = 'ok'),
    min(frame_time), max(frame_time), max(frame_time) FILTER (WHERE status = 'ok'),
    min(read) FILTER (WHERE status = 'ok'), max(read) FILTER (WHERE status = 'ok'),
    min(ARRAY[frame_time, number, read, "c", "sd_c", "x0", "sd_x0", "y0", "sd_y0"])
      FILTER (WHERE status = 'ok' AND read IS NOT NULL)
  FROM (SELECT thermocald_slot(frame_time) AS slot,
      (temperatures::json->>{channel})::double precision AS read, e.* FROM {rows} e
      OFFSET 0) reads
  GROUP BY series, slot"""

_LATEST = """
(SELECT * FROM public.epoch e WHERE {rows} AND NOT EXISTS (SELECT FROM public.epoch later
    WHERE later.series = e.series AND later.number = e.number AND later.revision > e.revision
    AND later.revision > 0))"""

_CHANNEL = """(SELECT json_object_keys(head::json->'temperatures') FROM public.series s
    WHERE s.key = {key} LIMIT 1)"""

_AGAIN = f"""
CREATE FUNCTION thermocald_summarise(one uuid, slots integer[]) RETURNS void
LANGUAGE plpgsql SET search_path = public, pg_temp AS $$
DECLARE
  reference text := {_CHANNEL.format(key="one")};
  wanted integer;
BEGIN
  DELETE FROM summary WHERE series = one AND slot = ANY(slots);
  FOREACH wanted IN ARRAY slots LOOP
    INSERT INTO summary {
    _SUMMARY.format(
        channel="reference",
        rows=_LATEST.format(
            rows='''
        e.series = one AND thermocald_slot(e.frame_time) = wanted
        AND e.frame_time >= CASE WHEN wanted = 0 THEN '-Infinity' ELSE wanted * 21600.0 END
        AND e.frame_time <= CASE WHEN wanted = 189928 THEN 'NaN' ELSE (wanted + 1) * 21600.0 END'''
        ),
    )
};
  END LOOP;
END $$
"""

_ARRIVED = f"""
CREATE FUNCTION thermocald_arrived() RETURNS trigger
LANGUAGE plpgsql SECURITY DEFINER SET search_path = public, pg_temp AS $$
DECLARE
  one uuid;
  reference text;
  revised boolean;
BEGIN
  FOR one IN SELECT DISTINCT series FROM arrived ORDER BY series LOOP
    -- who sends the same series at the same time counts after us, and sees our rows then
    PERFORM pg_advisory_xact_lock(hashtextextended(one::text, 7496050));
    SELECT EXISTS (SELECT FROM epoch e WHERE e.series = one AND e.revision > 0 AND e.number
        BETWEEN (SELECT min(number) FROM arrived a WHERE a.series = one)
        AND (SELECT max(number) FROM arrived a WHERE a.series = one)) INTO revised;
    IF revised THEN
      PERFORM thermocald_summarise(one, ARRAY(
        SELECT DISTINCT thermocald_slot(e.frame_time) FROM epoch e WHERE e.series = one
        AND e.number IN (SELECT number FROM arrived a WHERE a.series = one)));
    ELSE
      reference := {_CHANNEL.format(key="one")};
      INSERT INTO summary {
    _SUMMARY.format(channel="reference", rows="(SELECT * FROM arrived a WHERE a.series = one)")
}
      ON CONFLICT (series, slot) DO UPDATE SET
        epochs = summary.epochs + excluded.epochs, ok = summary.ok + excluded.ok,
        first = least(summary.first, excluded.first), last = greatest(summary.last, excluded.last),
        last_ok = greatest(summary.last_ok, excluded.last_ok),
        low = least(summary.low, excluded.low), high = greatest(summary.high, excluded.high),
        sample = least(summary.sample, excluded.sample);
    END IF;
  END LOOP;
  RETURN NULL;
END $$
"""

_TRIGGER = """
CREATE TRIGGER epoch_arrived AFTER INSERT ON epoch REFERENCING NEW TABLE AS arrived
FOR EACH STATEMENT EXECUTE FUNCTION thermocald_arrived()
"""

_FILL = f"""
DO $$
DECLARE
  one uuid;
  reference text;
BEGIN
  FOR one IN SELECT key FROM series LOOP
    reference := {_CHANNEL.format(key="one")};
    INSERT INTO summary {
    _SUMMARY.format(channel="reference", rows=_LATEST.format(rows="e.series = one"))
};
  END LOOP;
END $$
"""

# Who could read the tables before can read the new one.
_GRANT = """
DO $$
DECLARE reader text;
BEGIN
  FOR reader IN SELECT DISTINCT grantee FROM information_schema.role_table_grants
      WHERE table_name = 'epoch' AND privilege_type = 'SELECT'
      AND grantee NOT IN ('PUBLIC', current_user) LOOP
    EXECUTE format('GRANT SELECT ON summary TO %I', reader);
  END LOOP;
END $$
"""


def upgrade() -> None:
    for statement in (*_TABLE.split(";\n"), _AGAIN, _ARRIVED, _TRIGGER, _FILL, _GRANT):
        op.execute(statement)


def downgrade() -> None:
    op.execute("DROP TRIGGER epoch_arrived ON epoch")
    for one in ("arrived()", "summarise(uuid, integer[])"):
        op.execute(f"DROP FUNCTION thermocald_{one}")
    op.execute("DROP TABLE summary")
    op.execute("DROP FUNCTION thermocald_slot(double precision)")
