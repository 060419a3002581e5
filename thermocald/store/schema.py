"""The tables of a store in a file (SQLite) and on a server (PostgreSQL), and their version.

A database of version n has had the first n steps. The same steps create a new database and upgrade
an old one. A released step is frozen: it depends on nothing that may change, and each change of the
tables is a further step for both databases.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    Steps = Sequence[Sequence[str]]

# columns of an epoch: name in SQL, SQLite's type, PostgreSQL's
_PARAMETERS = (
    "c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2", "omega", "phi", "kappa",
    "centre_X0", "centre_Y0", "centre_Z0",
)  # fmt: skip
_REAL = ("REAL", "double precision")
_COUNT = ("INTEGER NOT NULL", "integer NOT NULL")
_TEXT = ("TEXT NOT NULL", "text NOT NULL")
_EPOCH: tuple[tuple[str, tuple[str, str]], ...] = (
    ("number", ("INTEGER NOT NULL", "bigint NOT NULL")),
    ("revision", _COUNT),  # a later calibration of the same epoch is a new row
    ("frame_time", ("REAL NOT NULL", "double precision NOT NULL")),
    ("temperature_time", _REAL),
    ("clock_trusted", ("INTEGER NOT NULL", "boolean NOT NULL")),
    ("status", _TEXT),
    ("sigma0", _REAL),
    ("redundancy", _COUNT),
    ("n_observations", _COUNT),
    ("n_rejected", _COUNT),
    ("measured", ("INTEGER", "integer")),
    *((f"{prefix}{name}", _REAL) for name in _PARAMETERS for prefix in ("", "sd_")),
    *((name, _TEXT) for name in ("temperatures", "extra", "rejected", "frame", "note", "reason")),
)
EPOCH_TEXTS = tuple(name for name, types in _EPOCH if types == _TEXT)
EPOCH_NUMBERS = tuple(name for name, types in _EPOCH if types != _TEXT)
_INTERNAL = ("number", "revision", "measured")
COLUMN_NAMES = (
    "epoch",
    *(name.replace("centre_", "") for name in EPOCH_NUMBERS if name not in _INTERNAL),
    "status",
)
"""The columns over a series by the names that the program uses."""


def sql_name(name: str) -> str:
    """Return the column in the tables: SQL ignores case, and X0 must differ from x0."""
    if name == "epoch":
        return "number"
    return f"{name[:-2]}centre_{name[-2:]}" if name[-2:] in ("X0", "Y0", "Z0") else name


def _epoch_columns(kind: int) -> str:
    return ", ".join(f'"{name}" {types[kind]}' for name, types in _EPOCH)


_APPEND_ONLY = ("store", "testfield", "series", "epoch", "detail", "event", "reading")

_FILE_1 = (
    # identifies the store whatever the file is called or copied to
    "CREATE TABLE store (id INTEGER PRIMARY KEY CHECK (id = 1), identity TEXT NOT NULL)",
    """CREATE TABLE testfield (
        id INTEGER PRIMARY KEY, digest TEXT NOT NULL UNIQUE, csv TEXT NOT NULL)""",
    """CREATE TABLE series (
        id INTEGER PRIMARY KEY, camera TEXT NOT NULL, name TEXT NOT NULL, start TEXT NOT NULL,
        created_utc REAL NOT NULL, testfield_id INTEGER NOT NULL REFERENCES testfield(id),
        head TEXT NOT NULL, identity TEXT NOT NULL, settings TEXT NOT NULL,
        checksum INTEGER NOT NULL, UNIQUE (camera, name))""",
    f"""CREATE TABLE epoch (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        {_epoch_columns(0)}, detail_checksum INTEGER NOT NULL, checksum INTEGER NOT NULL,
        UNIQUE (series_id, number, revision))""",
    # id = epoch.id * 1024 + part: covariance and observations, cut so that pages fill
    "CREATE TABLE detail (id INTEGER PRIMARY KEY, data BLOB NOT NULL)",
    """CREATE TABLE event (
        id INTEGER PRIMARY KEY, utc REAL NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL,
        series_id INTEGER, epoch INTEGER, data TEXT NOT NULL, checksum INTEGER NOT NULL)""",
    """CREATE TABLE reading (
        id INTEGER PRIMARY KEY, thermometer TEXT NOT NULL, utc REAL NOT NULL,
        clock_trusted INTEGER NOT NULL, temperatures TEXT NOT NULL, checksum INTEGER NOT NULL)""",
    "CREATE INDEX reading_thermometer ON reading (thermometer, utc)",
    # the file itself, not only this program, refuses changes
    *(
        f"""CREATE TRIGGER {table}_{change} BEFORE {change.upper()} ON {table}
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END"""
        for table in _APPEND_ONLY
        for change in ("update", "delete")
    ),
    "CREATE INDEX epoch_revised ON epoch (series_id, number) WHERE revision > 0",
    """CREATE INDEX epoch_deferred ON epoch (series_id, number)
        WHERE status = 'not_calibrated' AND frame <> ''""",
    # derived from `epoch`: whole columns as arrays, up to the row `last_id`
    """CREATE TABLE column_chunk (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        name TEXT NOT NULL, first_row INTEGER NOT NULL, last_number INTEGER NOT NULL,
        last_id INTEGER NOT NULL, data BLOB NOT NULL, checksum INTEGER NOT NULL,
        UNIQUE (series_id, name, first_row))""",
    "CREATE TABLE status_code (code INTEGER PRIMARY KEY, status TEXT NOT NULL UNIQUE)",
)

_NOW = "extract(epoch FROM clock_timestamp())::double precision"

# The first writer into a month creates its table. The role that forwards may only insert, so the
# function runs with its owner's rights. Rows from before the month's table stay in epoch_other.
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
END $$"""

# The role that forwards may only insert; it reports its state through this function alone.
_REPORT = f"""
CREATE FUNCTION thermocald_report(name text, identity uuid, clock double precision,
  waiting bigint, refused bigint, version text)
RETURNS void LANGUAGE sql SECURITY DEFINER SET search_path = public, pg_temp AS $$
  INSERT INTO public.station VALUES ($1, $2, {_NOW}, $3, $4, $5, $6)
  ON CONFLICT ON CONSTRAINT station_pkey DO UPDATE SET contact = excluded.contact,
    clock = excluded.clock, waiting = excluded.waiting, refused = excluded.refused,
    version = excluded.version
  -- a report delayed by a broken connection may arrive after a later one
  WHERE excluded.clock >= station.clock OR excluded.contact > station.contact + 600
$$"""

# Rows of epochs to rows of the summary. OFFSET 0: JSON is parsed once per epoch, not in every
# aggregate.
_SUMMARY = """
SELECT series, slot, count(*), count(*) FILTER (WHERE status = 'ok'),
    min(frame_time), max(frame_time), max(frame_time) FILTER (WHERE status = 'ok'),
    min(read) FILTER (WHERE status = 'ok'), max(read) FILTER (WHERE status = 'ok'),
    min(ARRAY[frame_time, number, read, "c", "sd_c", "x0", "sd_x0", "y0", "sd_y0"])
      FILTER (WHERE status = 'ok' AND read IS NOT NULL)
  FROM (SELECT thermocald_slot(frame_time) AS slot,
      (temperatures::json->>reference)::double precision AS read, e.* FROM {rows} e
      OFFSET 0) reads
  GROUP BY series, slot"""
_ARRIVED_ROWS = "(SELECT * FROM arrived a WHERE a.series = one)"
_SLOT_ROWS = """
(SELECT * FROM public.epoch e WHERE e.series = one AND thermocald_slot(e.frame_time) = wanted
    AND e.frame_time >= CASE WHEN wanted = 0 THEN '-Infinity' ELSE wanted * 21600.0 END
    AND e.frame_time <= CASE WHEN wanted = 189928 THEN 'NaN' ELSE (wanted + 1) * 21600.0 END
    AND NOT EXISTS (SELECT FROM public.epoch later WHERE later.series = e.series
      AND later.number = e.number AND later.revision > e.revision AND later.revision > 0))"""
_REFERENCE = """(SELECT json_object_keys(head::json->'temperatures') FROM public.series s
    WHERE s.key = one LIMIT 1)"""

_AGAIN = f"""
CREATE FUNCTION thermocald_summarise(one uuid, slots integer[]) RETURNS void
LANGUAGE plpgsql SET search_path = public, pg_temp AS $$
DECLARE
  reference text := {_REFERENCE};
  wanted integer;
BEGIN
  DELETE FROM summary WHERE series = one AND slot = ANY(slots);
  FOREACH wanted IN ARRAY slots LOOP
    INSERT INTO summary {_SUMMARY.format(rows=_SLOT_ROWS)};
  END LOOP;
END $$"""

# Runs in the transaction that inserts and sees only the rows that were inserted, so that a row sent
# twice counts once. Of a revised epoch only the latest revision counts: its slots are summed again.
_ARRIVED = f"""
CREATE FUNCTION thermocald_arrived() RETURNS trigger
LANGUAGE plpgsql SECURITY DEFINER SET search_path = public, pg_temp AS $$
DECLARE
  one uuid;
  reference text;
  revised boolean;
BEGIN
  FOR one IN SELECT DISTINCT series FROM arrived ORDER BY series LOOP
    -- another sender of the same series waits for this one, and then sees its rows
    PERFORM pg_advisory_xact_lock(hashtextextended(one::text, 7496050));
    SELECT EXISTS (SELECT FROM epoch e WHERE e.series = one AND e.revision > 0 AND e.number
        BETWEEN (SELECT min(number) FROM arrived a WHERE a.series = one)
        AND (SELECT max(number) FROM arrived a WHERE a.series = one)) INTO revised;
    IF revised THEN
      PERFORM thermocald_summarise(one, ARRAY(
        SELECT DISTINCT thermocald_slot(e.frame_time) FROM epoch e WHERE e.series = one
        AND e.number IN (SELECT number FROM arrived a WHERE a.series = one)));
    ELSE
      reference := {_REFERENCE};
      INSERT INTO summary {_SUMMARY.format(rows=_ARRIVED_ROWS)}
      ON CONFLICT (series, slot) DO UPDATE SET
        epochs = summary.epochs + excluded.epochs, ok = summary.ok + excluded.ok,
        first = least(summary.first, excluded.first), last = greatest(summary.last, excluded.last),
        last_ok = greatest(summary.last_ok, excluded.last_ok),
        low = least(summary.low, excluded.low), high = greatest(summary.high, excluded.high),
        sample = least(summary.sample, excluded.sample);
    END IF;
  END LOOP;
  RETURN NULL;
END $$"""

_SERVER_1 = (
    "CREATE TABLE testfield (digest text PRIMARY KEY, csv text NOT NULL)",
    """CREATE TABLE series (
        key uuid PRIMARY KEY, station text NOT NULL, store uuid NOT NULL, camera text NOT NULL,
        name text NOT NULL, start text NOT NULL, created_utc double precision NOT NULL,
        digest text NOT NULL, head text NOT NULL, identity text NOT NULL,
        settings text NOT NULL)""",
    "CREATE INDEX series_station ON series (station, camera, name)",
    f"""CREATE TABLE epoch (
        series uuid NOT NULL, {_epoch_columns(1)}, covariance bytea, observations bytea,
        received double precision DEFAULT {_NOW},
        PRIMARY KEY (series, number, revision, frame_time)) PARTITION BY RANGE (frame_time)""",
    "CREATE TABLE epoch_other PARTITION OF epoch DEFAULT",
    "CREATE INDEX epoch_revised ON epoch (series, number) WHERE revision > 0",
    "CREATE INDEX epoch_latest ON epoch (series, frame_time DESC)",
    # keyed by content: a new or restored store of a station assigns the same ids again
    """CREATE TABLE event (
        station text NOT NULL, id bigint NOT NULL, utc double precision NOT NULL,
        kind text NOT NULL, text text NOT NULL, series uuid, epoch bigint, data text NOT NULL)""",
    """CREATE UNIQUE INDEX event_content ON event (station, utc, kind, md5(text),
        coalesce(series::text, ''), coalesce(epoch, -1), md5(data))""",
    """CREATE TABLE reading (
        station text NOT NULL, id bigint NOT NULL, thermometer text NOT NULL,
        utc double precision NOT NULL, clock_trusted boolean NOT NULL,
        temperatures text NOT NULL)""",
    """CREATE UNIQUE INDEX reading_content
        ON reading (station, thermometer, utc, md5(temperatures))""",
    f"""CREATE TABLE frame (
        series uuid NOT NULL, number bigint NOT NULL, frame_time double precision NOT NULL,
        name text NOT NULL, digest text NOT NULL, data bytea NOT NULL,
        received double precision DEFAULT {_NOW}, PRIMARY KEY (series, number),
        CONSTRAINT frame_whole CHECK (digest = encode(sha256(data), 'hex')))""",
    "ALTER TABLE frame ALTER COLUMN data SET STORAGE EXTERNAL",
    """CREATE TABLE station (
        name text, identity uuid, contact double precision NOT NULL,
        clock double precision NOT NULL, waiting bigint NOT NULL, refused bigint NOT NULL,
        version text NOT NULL, PRIMARY KEY (name, identity))""",
    # sample: the slot's first epoch with a result and a temperature: frame_time, number, °C of the
    # reference, c, sd, x0, sd, y0, sd. Arrays are compared element by element, so `least` gives
    # the first. A clock that was not set may show any time: the outer slots hold the rest.
    """CREATE TABLE summary (
        series uuid NOT NULL, slot integer NOT NULL, epochs bigint NOT NULL, ok bigint NOT NULL,
        first double precision NOT NULL, last double precision NOT NULL, last_ok double precision,
        low double precision, high double precision, sample double precision[],
        PRIMARY KEY (series, slot)) WITH (fillfactor = 80)""",
    """CREATE FUNCTION thermocald_slot(at double precision) RETURNS integer
        LANGUAGE sql IMMUTABLE PARALLEL SAFE
        AS $$ SELECT floor(least(greatest($1, 0), 4102444800) / 21600)::integer $$""",
    _MONTH,
    _REPORT,
    _AGAIN,
    _ARRIVED,
    """CREATE TRIGGER epoch_arrived AFTER INSERT ON epoch REFERENCING NEW TABLE AS arrived
        FOR EACH STATEMENT EXECUTE FUNCTION thermocald_arrived()""",
)

FILE_STEPS: Steps = (_FILE_1,)
SERVER_STEPS: Steps = (_SERVER_1,)


def upgrade(execute: Callable[[str], object], version: int, steps: Steps) -> int:
    """Run the steps that a database of `version` (0: empty) lacks; return its new version.

    execute: runs one statement in the caller's transaction, which must be the only one.
    """
    for step in steps[version:]:
        for statement in step:
            execute(statement)
    return max(version, len(steps))
